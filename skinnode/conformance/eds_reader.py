"""Reads the electronic data sheet (CiA 306) of the device under test.

The reader is based on :mod:`configparser` and shares no code with this project's EDS writer or with the
canopen library, so that it does not repeat their errors. Contradictions within a file are collected for case
EDS-01. A file that cannot be parsed raises ProfileError.
"""

from __future__ import annotations

import configparser
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from skinnode.canopen.eds_encoding import MOST_EDS_BYTES, EdsText, for_people, octets, read_eds_text
from skinnode.canopen.eds_form import check_form, no_eds
from skinnode.errors import ProfileError, Shown
from skinnode.files.input_file import read_input
from skinnode.text.printable import printable

SIZES: Final = {
    0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4, 0x08: 4, 0x0C: 6, 0x0D: 6,
    0x10: 3, 0x11: 8, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8, 0x16: 3, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8,
}  # fmt: skip
"""Size in bytes of each fixed-length data type (CiA 301 v4.2.0, table 44)."""

_MOST_ENTRIES: Final = 1 << 16
SIGNED: Final = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)
UNSIGNED: Final = (0x05, 0x06, 0x07, 0x16, 0x18, 0x19, 0x1A, 0x1B)
_REAL: Final = {0x08: "<f", 0x11: "<d"}
_TEXT: Final = 0x09
_UNICODE: Final = 0x0B
_OCTETS: Final = (0x0A, 0x0F)
ACCESS: Final = ("ro", "wo", "rw", "rwr", "rww", "const")
_READABLE: Final = ("ro", "rw", "rwr", "rww", "const")
_WRITABLE: Final = ("wo", "rw", "rwr", "rww")

_SECTION: Final = re.compile(r"([0-9A-Fa-f]{4})(?:sub([0-9A-Fa-f]{1,2}))?")
_VAR, _ARRAY, _RECORD, _DOMAIN = 0x7, 0x8, 0x9, 0x2


@dataclass(frozen=True, slots=True)
class EdsEntry:
    """EDS entry for one value, identified by index and sub-index."""

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    default: str
    """Default value as written in the file; empty if there is none."""
    low: int | None
    high: int | None
    mappable: bool
    flags: int
    """ObjFlags: bit 0 is "refuse write on download", bit 1 is "refuse read on scan"."""
    given: bytes | None = None
    """Exact default value as bytes, which takes precedence over ``default``; None if the file does not
    specify bytes."""

    @property
    def size(self) -> int:
        """Size of the value in bytes; 0 for a variable-length type."""
        return SIZES.get(self.data_type, 0)

    @property
    def readable(self) -> bool:
        """Whether the value can be read."""
        return self.access in _READABLE

    @property
    def writable(self) -> bool:
        """Whether the value can be written."""
        return self.access in _WRITABLE

    @property
    def into_rpdo(self) -> bool:
        """Whether the entry may be mapped into an RPDO: mappable, writable and not a process input (rwr)."""
        return self.mappable and self.access in ("wo", "rww", "rw")

    @property
    def into_tpdo(self) -> bool:
        """Whether the entry may be mapped into a TPDO: mappable, readable and not a process output (rww)."""
        return self.mappable and self.access in ("ro", "rwr", "rw", "const")

    @property
    def mapping(self) -> int:
        """PDO mapping entry for this value: index, sub-index and length in bits."""
        return self.index << 16 | self.subindex << 8 | 8 * self.size

    def default_bytes(self, node_id: int) -> bytes | None:
        """Return the default value as the data of an SDO transfer.

        Args:
            node_id: Value of $NODEID.

        Returns:
            The bytes; None if there is no default, or if the default cannot be converted to the data type.

        Raises:
            ValueError: A number is malformed.
        """
        if self.given is not None or not self.default:
            return self.given
        if self.data_type == _TEXT:
            return octets(self.default)
        if self.data_type == _UNICODE:
            return self.default.encode("utf-16-le") if self.default.isascii() else None
        if self.data_type in _OCTETS:
            return _hex(self.default)
        if not self.size:
            return None
        if self.data_type in _REAL and not self.default.lower().startswith("0x"):
            return struct.pack(_REAL[self.data_type], float(self.default))
        value = number(self.default, node_id)
        return (value & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.subindex:02X} ({self.name})"


@dataclass(frozen=True, slots=True)
class Eds:
    """Parsed EDS; its entries are in ascending order of index and sub-index."""

    source: str
    """File name or other origin of the EDS, for messages."""
    device: Mapping[str, str]
    """Options in the DeviceInfo section, with keys in lower case."""
    dummies: frozenset[int]
    """Data types that may be mapped as dummy entries (section DummyUsage)."""
    entries: Mapping[tuple[int, int], EdsEntry]
    contradictions: tuple[str, ...]
    """Contradictions within the file, as text."""

    def find(self, index: int, subindex: int = 0) -> EdsEntry | None:
        """Return an entry; None if the EDS does not contain it."""
        return self.entries.get((index, subindex))

    def has(self, index: int) -> bool:
        """Return whether the EDS contains an object with this index."""
        return any(key[0] == index for key in self.entries)

    def between(self, first: int, last: int) -> Iterator[EdsEntry]:
        """Return the entries with an index from ``first`` to ``last``."""
        return (entry for key, entry in self.entries.items() if first <= key[0] <= last)

    def indices(self, first: int, last: int) -> list[int]:
        """Return the indices of all objects from ``first`` to ``last``."""
        return sorted({index for index, _ in self.entries if first <= index <= last})


def number(text: str, node_id: int = 0) -> int:
    """Parse a number in CiA 306 notation: decimal, ``0x`` hexadecimal, octal with leading 0, or $NODEID+….

    Raises ValueError if the text is not a number.
    """
    total = 0
    for part in text.replace(" ", "").split("+"):
        if part.upper() == "$NODEID":
            total += node_id
        elif re.fullmatch(r"0[0-7]+", part):
            total += int(part, 8)
        else:
            total += int(part, 0)
    return total


def _hex(text: str) -> bytes | None:
    """Parse hexadecimal text, the CiA 306 notation for an OCTET_STRING; return None if it is malformed."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        return None


def parse_eds_file(path: Path, key: str = "EDS") -> tuple[Eds, EdsText]:
    """Read an EDS or DCF in any common encoding.

    Args:
        path: The file.
        key: Option or key that specifies the file, for messages.

    Returns:
        The EDS and the text of the file. If the encoding is not ASCII, the ``source`` of the EDS names it.

    Raises:
        ConfigError: The file cannot be read.
        ProfileError: The file is not an EDS.
    """
    name, data = str(path), read_input(key, path, MOST_EDS_BYTES)
    try:
        read = read_eds_text(data)
    except UnicodeDecodeError:
        raise ProfileError("EDS", Shown("malformed UTF-16"), "a file in CiA 306 format", where=name) from None
    eds = parse_eds(read.text, name, read.codec)
    return (replace(eds, source=f"{name}, {read.note}") if read.note else eds), read


def parse_eds(text: str, source: str, codec: str = "utf-8") -> Eds:
    """Parse an EDS or DCF.

    Args:
        text: Content of the file.
        source: Name of the file, for messages.
        codec: Codec of the non-ASCII characters in the text.

    Raises:
        ProfileError: The text is not an EDS.
    """
    parser = configparser.ConfigParser(
        interpolation=None, strict=False, comment_prefixes=(";",), delimiters=("=",), allow_no_value=True
    )
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise no_eds(error, source, for_people(text, codec)) from error
    check_form(for_people(text, codec), source)
    sections = {name.lower(): {k: v or "" for k, v in parser.items(name)} for name in parser.sections()}
    for options in sections.values():
        if "parametername" in options:
            options["parametername"] = for_people(options["parametername"], codec)
    if "deviceinfo" not in sections or "1000" not in sections:
        raise ProfileError(
            "EDS", Shown("no section DeviceInfo or 1000"), "a file in CiA 306 format", where=source
        )
    entries, found = _entries(sections, source)
    dummies = sections.get("dummyusage", {})
    try:
        found += _listed(sections, {index for index, _ in entries})
        dummy_types = [kind for kind in range(1, 0x20) if number(dummies.get(f"dummy{kind:04x}", "0") or "0")]
    except ValueError as error:  # an option that must be a number is not one
        allowed = "numbers in CiA 306 format in the lists of objects and dummy entries"
        raise ProfileError("EDS", Shown(str(error)), allowed, where=source) from None
    return Eds(
        source=source,
        device={key: for_people(value, codec) for key, value in sections["deviceinfo"].items()},
        dummies=frozenset(dummy_types),
        entries=dict(sorted(entries.items())),
        contradictions=tuple(found),
    )


def _entries(
    sections: Mapping[str, Mapping[str, str]], source: str
) -> tuple[dict[tuple[int, int], EdsEntry], list[str]]:
    """Return the entries of all sections, and one line for each section with an error."""
    found: list[str] = []
    entries: dict[tuple[int, int], EdsEntry] = {}
    for title in sorted(sections, key=_order):
        match = _SECTION.fullmatch(title)
        if match is None:
            continue
        index, subindex = int(match[1], 16), match[2]
        try:
            if subindex is not None:
                _add(entries, index, int(subindex, 16), sections[title])
            else:
                _object(entries, index, sections[title], found)
        except (ValueError, KeyError) as error:
            found.append(f"[{title}]: {error}")
        if len(entries) > _MOST_ENTRIES:  # with CompactSubObj, 60 characters can declare 255 entries
            got = Shown(f"more than {_MOST_ENTRIES} values in the sections up to {title}")
            raise ProfileError("EDS", got, f"at most {_MOST_ENTRIES}", where=source)
    return entries, found


def _order(title: str) -> tuple[int, str]:
    """Return a sort key that puts objects before their sub-objects."""
    return len(title), title


def _object(
    entries: dict[tuple[int, int], EdsEntry], index: int, options: Mapping[str, str], found: list[str]
) -> None:
    kind = number(options.get("objecttype") or "7")
    if kind in (_VAR, _DOMAIN):
        _add(entries, index, 0, options)
        return
    if kind not in (_ARRAY, _RECORD):
        found.append(f"[{index:04X}]: object type 0x{kind:X}, must be 2, 7, 8 or 9")
    compact = number(options.get("compactsubobj") or "0")
    if compact > 254:
        found.append(f"[{index:04X}]: CompactSubObj={compact}, must be at most 254")
        compact = 0
    if compact:  # CompactSubObj declares identical sub-objects that have no sections of their own
        count = {"parametername": "NrOfObjects", "datatype": "5", "accesstype": "ro", "pdomapping": "0"}
        _add(entries, index, 0, {**count, "defaultvalue": str(compact)})
        for subindex in range(1, compact + 1):
            _add(entries, index, subindex, options)


def _add(
    entries: dict[tuple[int, int], EdsEntry], index: int, subindex: int, options: Mapping[str, str]
) -> None:
    low, high = options.get("lowlimit"), options.get("highlimit")
    data_type = number(options["datatype"])
    entries[index, subindex] = EdsEntry(
        index,
        subindex,
        printable(options.get("parametername", "")),
        data_type,
        options["accesstype"].strip().lower(),
        options.get("defaultvalue", "").strip(),
        number(low) if low and data_type not in _REAL else None,
        number(high) if high and data_type not in _REAL else None,
        bool(number(options.get("pdomapping") or "0")),
        number(options.get("objflags") or "0"),
    )


def _listed(sections: Mapping[str, Mapping[str, str]], described: set[int]) -> Iterator[str]:
    """Yield one line for each object that is listed or described, but not both, and for each wrong count."""
    listed: set[int] = set()
    for name in ("mandatoryobjects", "optionalobjects", "manufacturerobjects"):
        options = sections.get(name, {})
        items = {number(value) for key, value in options.items() if key.isdecimal()}
        count = number(options.get("supportedobjects") or "0")
        if count != len(items):
            yield f"[{name}]: SupportedObjects={count}, but {len(items)} are listed"
        listed |= items
    for index in sorted(listed ^ described):
        yield f"0x{index:04X} is {'listed' if index in listed else 'described'} only"
    for title, options in sections.items():
        if _SECTION.fullmatch(title) and "sub" not in title and options.get("subnumber"):
            subs = sum(1 for other in sections if other.startswith(f"{title}sub"))
            if not options.get("compactsubobj") and subs != number(options["subnumber"]):
                yield f"[{title}]: SubNumber={options['subnumber']}, but {subs} are described"
