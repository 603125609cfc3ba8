"""The object dictionary of a node as people read and write it: named and typed by its EDS (CiA 306), dumped
to a DCF, compared with an EDS or a DCF."""

from __future__ import annotations

import configparser
import io
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from skinnode.conformance.eds import SIGNED, UNSIGNED, Eds, EdsEntry, number
from skinnode.errors import ConfigError, NodeError, SdoAbort
from skinnode.host.network import RemoteOd
from skinnode.technician.sheet import Sheet
from skinnode.wire import indices as od

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
_NO_DATA: Final = 0x0800_0024
_NOT_CONFIGURATION: Final = (od.ERROR_REGISTER, od.ERROR_FIELD, od.STORE, od.RESTORE)
"""What a node says of itself, whatever its EDS has for a default."""
_LONGEST_SHOWN: Final = 16
_ADDRESS: Final = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,4})(?::(0[xX][0-9A-Fa-f]{1,2}|[0-9]{1,3}))?")


@dataclass(frozen=True, slots=True)
class Reading:
    """One value of a node."""

    index: int
    subindex: int
    name: str
    data_type: str
    access: str
    value: Value | None
    """None for bytes that have no simple value, and where the node refused."""
    data: bytes | None
    """As it travelled; None where the node refused."""
    refused: str
    """Why; empty where it did not."""

    @property
    def text(self) -> str:
        """The value for people."""
        if self.data is None:
            return self.refused
        if isinstance(self.value, str):
            return repr(self.value)
        if isinstance(self.value, int):
            wide = self.value > 255 and len(self.data) >= 2
            return f"{self.value} (0x{self.value:X})" if wide else str(self.value)
        if self.value is not None:
            return f"{self.value:.7g}"
        return hex_text(self.data)


@dataclass(frozen=True, slots=True)
class Difference:
    """An object that is not as a file has it."""

    index: int
    subindex: int
    name: str
    node: str
    """What the node has, or why it does not tell."""
    file: str


def parse_address(text: str) -> tuple[int, int | None]:
    """``1018:4``, ``0x1018``: index in hexadecimal, as CANopen writes it, sub-index decimal or 0x… Raises
    ConfigError."""
    match = _ADDRESS.fullmatch(text)
    subindex = None if match is None or match[2] is None else int(match[2], 0)
    if match is None or (subindex or 0) > 255:
        raise ConfigError("INDEX", text, "an index in hexadecimal, such as 1018, or one with :SUB, 0 to 255")
    return int(match[1], 16), subindex


def hex_text(data: bytes) -> str:
    """Bytes for people; long ones by their beginning."""
    shown = data[:_LONGEST_SHOWN].hex(" ")
    return shown if len(data) <= _LONGEST_SHOWN else f"{shown} … ({len(data)} bytes)"


def decode(entry: EdsEntry, data: bytes) -> Value | None:
    """The value in ``data``; None where it is no number and no text, or not of the length of its type."""
    if entry.data_type == _TEXT:
        text = data.rstrip(b"\0").decode("latin-1")
        return "".join(letter if letter.isprintable() else "�" for letter in text)
    if entry.size != len(data):
        return None
    if entry.data_type in _REALS:
        return float(struct.unpack(_REALS[entry.data_type], data)[0])
    if entry.data_type in UNSIGNED or entry.data_type in SIGNED or entry.data_type == _BOOLEAN:
        return int.from_bytes(data, "little", signed=entry.data_type in SIGNED)
    return None


def encode(entry: EdsEntry, text: str, node_id: int) -> bytes:
    """What a person wrote, as it travels. Raises ConfigError for what does not fit the type."""
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
    raise ConfigError("--write", text, f"--hex and bytes in hexadecimal: {entry} is {kind}")


def read_entry(remote: RemoteOd, entry: EdsEntry) -> Reading:
    """A value of a node; an abort is a reading too. Raises NodeError where the node does not answer."""
    named = entry.index, entry.subindex, entry.name, type_name(entry), entry.access
    try:
        data = remote.read_bytes(entry.index, entry.subindex)
    except SdoAbort as abort:
        why = "no data" if abort.code == _NO_DATA else f"refused: {abort_text(abort)}"
        return Reading(*named, None, None, why)
    return Reading(*named, decode(entry, data), data, "")


def type_name(entry: EdsEntry) -> str:
    """The data type in the words of CiA 301."""
    return _TYPES.get(entry.data_type, "" if not entry.data_type else f"0x{entry.data_type:X}")


def abort_text(abort: SdoAbort) -> str:
    """The reason of an abort."""
    return f"0x{abort.code:08X} {str(abort).rpartition(': ')[2]}"


def unnamed(index: int, subindex: int) -> EdsEntry:
    """An object that no sheet describes."""
    return EdsEntry(index, subindex, "not in the EDS", 0, "", "", None, None, False, 0)


def entries_at(sheet: Eds, index: int, subindex: int | None) -> list[EdsEntry]:
    """What an address means: a value, or all of an object. One that the sheet does not have is tried as it
    is."""
    if subindex is None:
        listed = list(sheet.between(index, index))
        return listed or [unnamed(index, 0)]
    return [sheet.find(index, subindex) or unnamed(index, subindex)]


def dump(remote: RemoteOd, sheet: Eds, progress: Callable[[str], None] = lambda _: None) -> Iterator[Reading]:
    """Every value that can be read."""
    readable = [entry for entry in sheet.entries.values() if entry.readable]
    for done, entry in enumerate(readable):
        if done % 20 == 0:
            progress(f"0x{entry.index:04X}: {done} of {len(readable)} values")
        yield read_entry(remote, entry)


def compare(
    remote: RemoteOd, sheet: Eds, node_id: int, progress: Callable[[str], None] = lambda _: None
) -> list[Difference]:
    """Where the node is not as the file has it: every value that is given there and can be read, but for what
    a node says of its own state."""
    found: list[Difference] = []
    given = [entry for entry in sheet.entries.values() if entry.readable and entry.default]
    for done, entry in enumerate(given):
        if done % 20 == 0:
            progress(f"0x{entry.index:04X}: {done} of {len(given)} values")
        if entry.index in _NOT_CONFIGURATION or (entry.index, entry.subindex) in od.COMMANDS:
            continue
        try:
            wanted = entry.default_bytes(node_id)
        except (ValueError, struct.error):
            wanted = None
        if wanted is None:
            continue
        got = read_entry(remote, entry)
        if got.data is None or (got.data.rstrip(b"\0") if entry.data_type == _TEXT else got.data) != wanted:
            shown = replace(got, value=decode(entry, wanted), data=wanted).text
            found.append(Difference(entry.index, entry.subindex, entry.name, got.text, shown))
    return found


def expected(sheet: Sheet) -> Eds:
    """The EDS with the values of a DCF (ParameterValue) in place of its defaults; as it is where there are
    none."""
    parser = _parser()
    parser.read_string(sheet.text)
    entries = dict(sheet.eds.entries)
    for section in parser.sections():
        match = re.fullmatch(r"([0-9A-Fa-f]{4})(?:sub([0-9A-Fa-f]{1,2}))?", section, re.IGNORECASE)
        key = None if match is None else (int(match[1], 16), int(match[2] or "0", 16))
        value = next((v for k, v in parser.items(section) if k.lower() == "parametervalue"), None)
        if key in entries and value:
            entries[key] = replace(entries[key], default=value.strip())
    return replace(sheet.eds, entries=entries)


def as_dcf(sheet: Sheet, readings: list[Reading], node_id: int, bitrate_bps: int, name: str) -> str:
    """The EDS with the value of each object that can be written, and what makes it the DCF of a device."""
    parser = _parser()
    parser.read_string(sheet.text)
    sections = {title.lower(): title for title in parser.sections()}
    for reading in readings:
        writable = reading.access in ("rw", "rww", "rwr")
        if reading.data is None or not writable or reading.index in (*_NOT_CONFIGURATION, od.BASELINE_DOMAIN):
            continue
        if (reading.index, reading.subindex) in od.COMMANDS:
            continue
        title = sections.get(f"{reading.index:04x}sub{reading.subindex:x}") or (
            sections.get(f"{reading.index:04x}") if reading.subindex == 0 else None
        )
        value = _dcf_value(reading)
        if title is not None and value is not None:
            parser.set(title, "ParameterValue", value)
    commissioning = "DeviceComissioning"  # spelt like this in CiA 306
    if commissioning.lower() not in sections:
        parser.add_section(commissioning)
    for key, value in (
        ("NodeID", str(node_id)),
        ("NodeName", name),
        ("Baudrate", str(bitrate_bps // 1000)),
        ("NetNumber", "0"),
        ("NetworkName", ""),
        ("CANopenManager", "0"),
    ):
        parser.set(commissioning, key, value)
    text = io.StringIO()
    parser.write(text, space_around_delimiters=False)
    return text.getvalue()


def _dcf_value(reading: Reading) -> str | None:
    """Numbers in hexadecimal, reals by their pattern, as conforming tools expect them."""
    assert reading.data is not None
    if isinstance(reading.value, str):
        return reading.value
    if isinstance(reading.value, float):
        return f"0x{int.from_bytes(reading.data, 'little'):0{2 * len(reading.data)}X}"
    if isinstance(reading.value, int):
        return str(reading.value) if reading.value < 10 else f"0x{reading.value:X}"
    return None


def _parser() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(
        interpolation=None, strict=False, comment_prefixes=(";",), delimiters=("=",), allow_no_value=True
    )
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    return parser


def require_answer(remote: RemoteOd) -> None:
    """Raises NodeError where nobody answers, before anything is read at length."""
    if not remote.answers() and not remote.answers():
        raise NodeError(remote.node_id, "does not answer by SDO")
