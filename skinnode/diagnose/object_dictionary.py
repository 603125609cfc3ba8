"""Reads, decodes and compares the objects of a node.

Names and data types are taken from the node's EDS (CiA 306), or from CiA 301 (``standard_objects``) if there
is no EDS.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode
from skinnode.conformance.eds_reader import SIGNED, UNSIGNED, Eds, EdsEntry, number
from skinnode.diagnose.standard_objects import (
    SERIES,
    SINGLE,
    has_subindices,
    standard_entries,
    standard_entry,
)
from skinnode.errors import ConfigError, SdoAbort
from skinnode.host.sdo_client import MAX_UPLOAD_BYTES, RemoteOd
from skinnode.text.printable import printable

Value = int | float | str

_TYPES: Final = {
    0x01: "BOOLEAN", 0x02: "INTEGER8", 0x03: "INTEGER16", 0x04: "INTEGER32", 0x05: "UNSIGNED8",
    0x06: "UNSIGNED16", 0x07: "UNSIGNED32", 0x08: "REAL32", 0x09: "VISIBLE_STRING", 0x0A: "OCTET_STRING",
    0x0B: "UNICODE_STRING", 0x0C: "TIME_OF_DAY", 0x0D: "TIME_DIFFERENCE", 0x0F: "DOMAIN",
    0x10: "INTEGER24", 0x11: "REAL64", 0x12: "INTEGER40", 0x13: "INTEGER48", 0x14: "INTEGER56",
    0x15: "INTEGER64", 0x16: "UNSIGNED24", 0x18: "UNSIGNED40", 0x19: "UNSIGNED48", 0x1A: "UNSIGNED56",
    0x1B: "UNSIGNED64",
}  # fmt: skip
_BOOLEAN, _TEXT = 0x01, 0x09
_REALS: Final = {0x08: "<f", 0x11: "<d"}
_STRINGS: Final = ("VISIBLE_STRING", "OCTET_STRING", "UNICODE_STRING", "DOMAIN")
NOT_CONFIGURATION: Final = (od.ERROR_REGISTER, od.ERROR_FIELD, od.STORE, od.RESTORE)
"""Indices of objects that contain state or trigger an action. They are not part of the configuration, even if
the EDS specifies a default."""
_LONGEST_SHOWN: Final = 16
_ADDRESS: Final = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,4})(?::(0[xX][0-9A-Fa-f]{1,2}|[0-9]{1,3}))?")


@dataclass(frozen=True, slots=True)
class Reading:
    """Result of reading one value from a node."""

    index: int
    subindex: int
    name: str
    data_type: str
    access: str
    value: Value | None
    """Decoded value; None if the data are neither a number nor text, or if the transfer was aborted."""
    data: bytes | None
    """Data of the SDO transfer; None if it was aborted."""
    refused: str
    """Reason for the abort; empty if the transfer succeeded."""
    refused_code: int = 0
    """SDO abort code; 0 if the transfer succeeded."""

    @property
    def content(self) -> bytes | None:
        """Value as bytes; None if the transfer was aborted.

        Many nodes abort the upload of an empty string with the code "no data available"; the result is then
        ``b""``.
        """
        if self.refused_code == AbortCode.NO_DATA and self.data_type in _STRINGS:
            return b""
        return self.data

    @property
    def text(self) -> str:
        """Value for display, or the reason for the abort."""
        if self.data is None:
            return self.refused
        if isinstance(self.value, str):
            return f"'{self.value}'"
        if isinstance(self.value, int):
            wide = self.value > 255 and len(self.data) >= 2
            return f"{self.value} (0x{self.value:X})" if wide else str(self.value)
        if self.value is not None:
            return f"{self.value:.7g}"
        return hex_text(self.data) or "empty"


@dataclass(frozen=True, slots=True)
class Difference:
    """Object whose value on the node differs from its value in a file."""

    index: int
    subindex: int
    name: str
    node: str
    """Value on the node, or the reason it could not be read."""
    file: str


def parse_address(text: str) -> tuple[int, int | None]:
    """Return the index and sub-index of an address such as ``1018:4`` or ``0x1018``.

    The index is hexadecimal. The sub-index is decimal, or hexadecimal with the prefix ``0x``; it is None if
    the address has none.

    Raises:
        ConfigError: The text is not an address.
    """
    match = _ADDRESS.fullmatch(text)
    subindex = None if match is None or match[2] is None else int(match[2], 0)
    if match is None or (subindex or 0) > 255:
        raise ConfigError("INDEX", text, "a hexadecimal INDEX, such as 1018, or INDEX:SUB with SUB 0 to 255")
    return int(match[1], 16), subindex


def hex_text(data: bytes) -> str:
    """Return ``data`` in hexadecimal; only the first 16 bytes of longer data are shown."""
    shown = data[:_LONGEST_SHOWN].hex(" ")
    return shown if len(data) <= _LONGEST_SHOWN else f"{shown} … ({len(data)} bytes)"


def decode(entry: EdsEntry, data: bytes) -> Value | None:
    """Decode ``data``; None if the type is neither numeric nor text, or if the length is wrong."""
    if entry.data_type == _TEXT:
        return printable(data)
    if entry.size != len(data):
        return None
    if entry.data_type in _REALS:
        return float(struct.unpack(_REALS[entry.data_type], data)[0])
    if entry.data_type in UNSIGNED or entry.data_type in SIGNED or entry.data_type == _BOOLEAN:
        return int.from_bytes(data, "little", signed=entry.data_type in SIGNED)
    return None


def encode(entry: EdsEntry, text: str, node_id: int) -> bytes:
    """Encode a value entered by the user.

    Args:
        entry: The object.
        text: The value.
        node_id: Value of $NODEID in the text.

    Raises:
        ConfigError: The text is not a value of the object's type.
    """
    kind = _TYPES.get(entry.data_type, f"data type 0x{entry.data_type:X}")
    try:
        if entry.data_type == _TEXT:
            return text.encode("latin-1")
        if entry.data_type in _REALS:
            return struct.pack(_REALS[entry.data_type], float(text))
        if entry.data_type == _BOOLEAN and text.lower() in ("true", "false"):
            return bytes((text.lower() == "true",))
        if entry.data_type in SIGNED or entry.data_type in UNSIGNED or entry.data_type == _BOOLEAN:
            value = int(text, 0) if not text.upper().startswith("$NODEID") else number(text, node_id)
            return value.to_bytes(entry.size, "little", signed=entry.data_type in SIGNED)
    except (ValueError, OverflowError, struct.error):
        raise ConfigError("--write", text, f"a value of {entry}: {kind}") from None
    where = (
        f"{entry} is {kind}"
        if entry.data_type
        else f"the type of {entry} is specified only in the node's EDS (--eds FILE)"
    )
    raise ConfigError("--write", text, f"--hex and bytes in hexadecimal, because {where}")


def read_entry(remote: RemoteOd, entry: EdsEntry) -> Reading:
    """Read one value. The result reports an SDO abort; NodeError is raised if the node does not answer."""
    named = entry.index, entry.subindex, entry.name, type_name(entry), entry.access
    try:
        data = remote.read_bytes(entry.index, entry.subindex, MAX_UPLOAD_BYTES)
    except SdoAbort as abort:
        why = "no data" if abort.code == AbortCode.NO_DATA else f"refused: {abort_text(abort)}"
        return Reading(*named, None, None, why, abort.code)
    return Reading(*named, decode(entry, data), data, "")


def type_name(entry: EdsEntry) -> str:
    """Return the name of the entry's data type, as in CiA 301."""
    return _TYPES.get(entry.data_type, "" if not entry.data_type else f"0x{entry.data_type:X}")


def abort_text(abort: SdoAbort) -> str:
    """Return the code and reason of an SDO abort as text."""
    return f"0x{abort.code:08X} {str(abort).rpartition(': ')[2]}"


def unnamed(eds: Eds, index: int, subindex: int) -> EdsEntry:
    """Return an entry for an object that neither the EDS nor CiA 301 describes."""
    why = "not in the EDS" if eds.entries else "named only in its EDS"
    return EdsEntry(index, subindex, why, 0, "", "", None, None, False, 0)


def entries_at(eds: Eds, index: int, subindex: int | None, count: Callable[[], int]) -> list[EdsEntry]:
    """Return the entries at an address.

    Args:
        eds: EDS of the node. For objects not listed there, the description in CiA 301 is used if there is
            one.
        index: Index.
        subindex: Sub-index; None for all sub-indices of the object.
        count: Callback that reads the number of entries from sub-index 0.
    """
    if subindex is None:
        listed = list(eds.between(index, index))
        if not listed:
            listed = list(standard_entries(index, count() if has_subindices(index) else 0))
        return listed or [unnamed(eds, index, 0)]
    found = eds.find(index, subindex) or standard_entry(index, subindex)
    return [found or unnamed(eds, index, subindex)]


def dump_standard(remote: RemoteOd, progress: Callable[[str], None] = lambda _: None) -> Iterator[Reading]:
    """Read all CiA 301 objects of a node without an EDS."""
    progress("objects of CiA 301")
    for index in SINGLE:
        yield from _standard(remote, index)
    for indices in SERIES:
        for index in indices:
            readings = list(_standard(remote, index))
            if not readings:
                break
            yield from readings


def _standard(remote: RemoteOd, index: int) -> Iterator[Reading]:
    """Read all values of an object; yield nothing if the node does not have the object."""
    try:
        count = remote.read_bytes(index, 0)
    except SdoAbort as abort:
        if abort.code == AbortCode.NO_OBJECT:
            return
        count = b""
    for entry in standard_entries(index, count[0] if count and has_subindices(index) else 0):
        reading = read_entry(remote, entry)
        if reading.refused_code != AbortCode.NO_SUBINDEX:  # sub-indices need not be contiguous
            yield reading


def dump(remote: RemoteOd, eds: Eds, progress: Callable[[str], None] = lambda _: None) -> Iterator[Reading]:
    """Read every value that the EDS lists as readable."""
    readable = [entry for entry in eds.entries.values() if entry.readable]
    for done, entry in enumerate(readable):
        if done % 20 == 0:
            progress(f"0x{entry.index:04X}: {done} of {len(readable)} values")
        yield read_entry(remote, entry)


def compare(
    remote: RemoteOd, eds: Eds, node_id: int, progress: Callable[[str], None] = lambda _: None
) -> list[Difference]:
    """Compare the values on a node with the values in an EDS or DCF.

    Args:
        remote: The node.
        eds: The file. All readable objects with a value are compared, except :data:`NOT_CONFIGURATION` and
            commands.
        node_id: Value of $NODEID in the file.
        progress: Called with a progress message.

    Returns:
        The objects whose values differ.
    """
    found: list[Difference] = []
    given = [
        entry
        for entry in eds.entries.values()
        if entry.readable and (entry.default or entry.given is not None)
    ]
    for done, entry in enumerate(given):
        if done % 20 == 0:
            progress(f"0x{entry.index:04X}: {done} of {len(given)} values")
        if entry.index in NOT_CONFIGURATION or (entry.index, entry.subindex) in od.COMMANDS:
            continue
        try:
            wanted = entry.default_bytes(node_id)
        except (ValueError, struct.error):
            wanted = None
        if wanted is None:
            continue
        got = read_entry(remote, entry)
        if got.content is None or not _same(entry, got.content, wanted):
            expected = replace(got, value=decode(entry, wanted), data=wanted)
            found.append(Difference(entry.index, entry.subindex, entry.name, *_distinct(got, expected)))
    return found


def _same(entry: EdsEntry, data: bytes, wanted: bytes) -> bool:
    """Return whether the value on the node equals the value in the file.

    Trailing NULs of a string are ignored, because an EDS default cannot express them. They are significant
    if the file specifies the value byte by byte.
    """
    spelt_out = entry.data_type != _TEXT or entry.given is not None
    return data == wanted or (not spelt_out and data.rstrip(b"\0") == wanted)


def _distinct(got: Reading, expected: Reading) -> tuple[str, str]:
    """Format two different values for display.

    If both values would look the same, the bytes from the first difference onwards are appended.
    """
    if got.data is None or expected.data is None or got.text != expected.text:
        return got.text, expected.text
    pairs = enumerate(zip(got.data, expected.data, strict=False))
    at = next((at for at, (one, other) in pairs if one != other), min(len(got.data), len(expected.data)))
    node, file = (hex_text(data[at:]) or "no more" for data in (got.data, expected.data))
    return f"{got.text}, byte {at}: {node}", f"{expected.text}, byte {at}: {file}"
