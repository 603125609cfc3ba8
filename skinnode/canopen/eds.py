"""Writes an object dictionary as an EDS or DCF file (CiA 306).

An EDS (electronic data sheet) describes a type of device. A DCF (device configuration file) describes the
configuration of one device. REAL32 defaults are written as hexadecimal IEEE 754 bit patterns, as CiA 306
tools expect. The Python library ``canopen`` expects decimal numbers and ignores REAL32 defaults other than 0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.dictionary import DataType, Entry, Object, ObjectType

_DATE, _TIME = "01-01-2025", "12:00AM"  # fixed, so that a regenerated EDS is identical
_BIT_RATES_KBPS: Final = (10, 20, 50, 125, 250, 500, 800, 1000)
_MANDATORY: Final = (0x1000, 0x1001, 0x1018)
_DUMMY_TYPES: Final = range(1, 8)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Content of the header sections of an EDS."""

    file_name: str
    description: str
    vendor_name: str
    vendor_number: int
    product_name: str
    product_number: int
    revision_number: int
    bit_rates_bps: tuple[int, ...]
    rpdos: int
    tpdos: int


@dataclass(frozen=True, slots=True)
class Commissioning:
    """Description of a node; present only in a DCF."""

    node_id: int
    bitrate_kbps: int
    node_name: str
    eds_name: str
    """Name of the EDS file from which the DCF is derived."""


def render_eds(info: DeviceInfo, objects: Iterable[Object], device: Commissioning | None = None) -> str:
    """Return the content of an EDS or DCF file, with LF line endings.

    The content depends only on the arguments.

    Args:
        info: description of the device.
        objects: object dictionary of the device.
        device: description of the node for a DCF; None for an EDS.
    """
    listed = tuple(objects)
    lines = [*_head(info, device)]
    mandatory = [item for item in listed if item.index in _MANDATORY]
    manufacturer = [item for item in listed if 0x2000 <= item.index < 0x6000]
    optional = [item for item in listed if item not in mandatory and item not in manufacturer]
    for title, group in (
        ("MandatoryObjects", mandatory),
        ("OptionalObjects", optional),
        ("ManufacturerObjects", manufacturer),
    ):
        numbered = [(str(number), f"0x{item.index:04X}") for number, item in enumerate(group, 1)]
        lines += _section(title, [("SupportedObjects", str(len(group))), *numbered])
        for item in group:
            lines += _object(item, device)
    return "\n".join(lines)


def _section(title: str, options: Iterable[tuple[str, str]]) -> list[str]:
    return [f"[{title}]", *(f"{key}={value}" for key, value in options), ""]


def _head(info: DeviceInfo, device: Commissioning | None) -> Iterator[str]:
    yield from _section(
        "FileInfo",
        [
            ("FileName", info.file_name),
            ("FileVersion", "1"),
            ("FileRevision", "0"),
            ("EDSVersion", "4.0"),
            ("Description", info.description),
            ("CreationTime", _TIME),
            ("CreationDate", _DATE),
            ("CreatedBy", "skinnode"),
            ("ModificationTime", _TIME),
            ("ModificationDate", _DATE),
            ("ModifiedBy", "skinnode"),
            *([("LastEDS", device.eds_name)] if device is not None else []),
        ],
    )
    yield from _section(
        "DeviceInfo",
        [
            ("VendorName", info.vendor_name),
            ("VendorNumber", f"0x{info.vendor_number:08X}"),
            ("ProductName", info.product_name),
            ("ProductNumber", f"0x{info.product_number:08X}"),
            ("RevisionNumber", f"0x{info.revision_number:08X}"),
            ("OrderCode", ""),
            *((f"BaudRate_{rate}", str(int(1000 * rate in info.bit_rates_bps))) for rate in _BIT_RATES_KBPS),
            ("SimpleBootUpMaster", "0"),
            ("SimpleBootUpSlave", "1"),
            ("Granularity", "8"),
            ("DynamicChannelsSupported", "0"),
            ("GroupMessaging", "0"),
            ("NrOfRXPDO", str(info.rpdos)),
            ("NrOfTXPDO", str(info.tpdos)),
            ("LSS_Supported", "1"),
        ],
    )
    if device is not None:
        yield from _section(
            "DeviceComissioning",  # spelled this way in CiA 306
            [
                ("NodeID", str(device.node_id)),
                ("NodeName", device.node_name),
                ("Baudrate", str(device.bitrate_kbps)),
                ("NetNumber", "0"),
                ("NetworkName", ""),
                ("CANopenManager", "0"),
            ],
        )
    yield from _section(
        "DummyUsage", [(f"Dummy{kind:04X}", str(int(kind in od.DUMMY_BITS))) for kind in _DUMMY_TYPES]
    )
    yield from _section(
        "Comments", [("Lines", "1"), ("Line1", "Generated from the patch profile of skinnode; do not edit.")]
    )


def _object(item: Object, device: Commissioning | None) -> Iterator[str]:
    title = f"{item.index:04X}"
    if item.type in (ObjectType.VAR, ObjectType.DOMAIN):
        yield from _section(title, _options(item.entries[0], item.type, device))
        return
    yield from _section(
        title,
        [
            ("ParameterName", item.name),
            ("ObjectType", f"0x{item.type:X}"),
            ("SubNumber", f"0x{len(item.entries):X}"),
        ],
    )
    for entry in item.entries:
        yield from _section(f"{title}sub{entry.subindex:X}", _options(entry, ObjectType.VAR, device))


def _options(entry: Entry, kind: ObjectType, device: Commissioning | None) -> Iterator[tuple[str, str]]:
    yield "ParameterName", entry.name
    yield "ObjectType", f"0x{kind:X}"
    yield "DataType", f"0x{entry.data_type:04X}"
    yield "AccessType", entry.access
    if entry.low is not None:
        yield "LowLimit", str(entry.low)
    if entry.high is not None:
        yield "HighLimit", str(entry.high)
    if entry.default is not None:
        yield "DefaultValue", _default(entry)
    if device is not None and _is_configuration(entry):
        value = entry.value_at_start(device.node_id)
        yield "ParameterValue", _default(replace(entry, default=value, plus_node_id=False))
    yield "PDOMapping", str(int(entry.mappable))


def _is_configuration(entry: Entry) -> bool:
    """Return whether a DCF contains a value for the entry. Commands and the error history are excluded."""
    refused = entry.index in (od.ERROR_FIELD, od.STORE, od.RESTORE)
    return entry.access not in ("ro", "const") and entry.default is not None and not refused


def _default(entry: Entry) -> str:
    value = entry.default
    if entry.data_type is DataType.REAL32 and value:
        (pattern,) = struct.unpack("<I", struct.pack("<f", value))
        return f"0x{pattern:08X}"
    if entry.plus_node_id:
        return f"$NODEID+0x{value:X}"
    if entry.data_type is DataType.UNSIGNED32 and value:
        return f"0x{value:08X}"
    return str(value)
