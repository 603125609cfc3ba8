"""Names and data types of the CiA 301 objects (v4.2, 7.5.2), for devices without an EDS.

The number of entries of an array or record is read from sub-index 0 on the device.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from skinnode.conformance.eds_reader import EdsEntry

_U8, _U16, _U32, _STRING, _DOMAIN = 0x05, 0x06, 0x07, 0x09, 0x0F
_GROUPS: Final = {1: "all", 2: "communication", 3: "application"}
"""Parameter groups of 0x1010 and 0x1011, by sub-index; higher sub-indices are manufacturer-specific."""


class _Object(NamedTuple):
    """Description of an object, or of several objects with the same structure."""

    name: str
    data_type: int
    access: str
    array: bool = False
    subs: tuple[tuple[str, int], ...] = ()
    """Name and data type of each sub-index of a record, starting at sub-index 1."""


_SDO: Final = (
    ("COB-ID client to server", _U32),
    ("COB-ID server to client", _U32),
    ("Node-ID of the other side", _U8),
)
_PDO: Final = (
    ("COB-ID", _U32),
    ("Transmission type", _U8),
    ("Inhibit time", _U16),
    ("Reserved", _U8),
    ("Event timer", _U16),
    ("SYNC start value", _U8),
)
_IDENTITY: Final = (
    ("Vendor-ID", _U32),
    ("Product code", _U32),
    ("Revision number", _U32),
    ("Serial number", _U32),
)
_ONE: Final = {
    0x1000: _Object("Device type", _U32, "ro"),
    0x1001: _Object("Error register", _U8, "ro"),
    0x1002: _Object("Manufacturer status register", _U32, "ro"),
    0x1003: _Object("Pre-defined error field", _U32, "ro", array=True),
    0x1005: _Object("COB-ID SYNC message", _U32, "rw"),
    0x1006: _Object("Communication cycle period", _U32, "rw"),
    0x1007: _Object("Synchronous window length", _U32, "rw"),
    0x1008: _Object("Manufacturer device name", _STRING, "const"),
    0x1009: _Object("Manufacturer hardware version", _STRING, "const"),
    0x100A: _Object("Manufacturer software version", _STRING, "const"),
    0x100C: _Object("Guard time", _U16, "rw"),
    0x100D: _Object("Life time factor", _U8, "rw"),
    0x1010: _Object("Store parameters", _U32, "rw", array=True),
    0x1011: _Object("Restore default parameters", _U32, "rw", array=True),
    0x1012: _Object("COB-ID time stamp message", _U32, "rw"),
    0x1013: _Object("High resolution time stamp", _U32, "rw"),
    0x1014: _Object("COB-ID emergency message", _U32, "rw"),
    0x1015: _Object("Inhibit time EMCY", _U16, "rw"),
    0x1016: _Object("Consumer heartbeat time", _U32, "rw", array=True),
    0x1017: _Object("Producer heartbeat time", _U16, "rw"),
    0x1018: _Object("Identity object", _U32, "ro", subs=_IDENTITY),
    0x1019: _Object("Synchronous counter overflow value", _U8, "rw"),
    0x1020: _Object(
        "Verify configuration", _U32, "rw", subs=(("Configuration date", _U32), ("Configuration time", _U32))
    ),
    0x1021: _Object("Store EDS", _DOMAIN, "ro"),
    0x1022: _Object("Store format", _U8, "ro"),
    0x1028: _Object("Emergency consumer", _U32, "rw", array=True),
    0x1029: _Object("Error behaviour", _U8, "rw", array=True),
}
_MANY: Final = (
    (range(0x1200, 0x1201), _Object("SDO server parameter", _U32, "ro", subs=_SDO)),
    (range(0x1201, 0x1280), _Object("SDO server parameter", _U32, "rw", subs=_SDO)),
    (range(0x1280, 0x1300), _Object("SDO client parameter", _U32, "rw", subs=_SDO)),
    (range(0x1400, 0x1600), _Object("RPDO communication parameter", _U32, "rw", subs=_PDO)),
    (range(0x1600, 0x1800), _Object("RPDO mapping parameter", _U32, "rw", array=True)),
    (range(0x1800, 0x1A00), _Object("TPDO communication parameter", _U32, "rw", subs=_PDO)),
    (range(0x1A00, 0x1C00), _Object("TPDO mapping parameter", _U32, "rw", array=True)),
)
SINGLE: Final = tuple(_ONE)
"""Indices of objects that occur at most once in a device."""
SERIES: Final = tuple(indices for indices, _ in _MANY)
"""Index ranges of objects that may occur several times in a device. A device uses the lowest indices of a
range."""


def standard_entry(index: int, subindex: int) -> EdsEntry | None:
    """Return the CiA 301 description of a value; None if CiA 301 does not define it."""
    item = _find(index)
    if item is None:
        return None
    if not (item.array or item.subs):
        return _entry(index, subindex, item.name, item.data_type, item.access) if subindex == 0 else None
    if subindex == 0:
        writable = "mapping" in item.name or index == 0x1003
        return _entry(index, 0, f"{item.name}: entries", _U8, "rw" if writable else "ro")
    if item.array:
        which = f"{item.name} {subindex}"
        if index in (0x1010, 0x1011):
            which = f"{item.name}: {_GROUPS.get(subindex, 'manufacturer-specific')}"
        return _entry(index, subindex, which, item.data_type, item.access)
    if subindex > len(item.subs):
        return None
    name, data_type = item.subs[subindex - 1]
    return _entry(index, subindex, name, data_type, item.access)


def standard_entries(index: int, count: int) -> Iterator[EdsEntry]:
    """Yield the CiA 301 descriptions of all values of an object.

    Args:
        index: Index.
        count: Number of entries according to sub-index 0; ignored for an object without sub-indices.
    """
    item = _find(index)
    if item is None:
        return
    for subindex in range(count + 1 if has_subindices(index) else 1):
        entry = standard_entry(index, subindex)
        if entry is not None:
            yield entry


def has_subindices(index: int) -> bool:
    """Return whether CiA 301 defines an array or a record at this index."""
    item = _find(index)
    return item is not None and (item.array or bool(item.subs))


def _find(index: int) -> _Object | None:
    return _ONE.get(index) or next((item for indices, item in _MANY if index in indices), None)


def _entry(index: int, subindex: int, name: str, data_type: int, access: str) -> EdsEntry:
    return EdsEntry(index, subindex, name, data_type, access, "", None, None, False, 0)
