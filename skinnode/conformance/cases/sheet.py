"""EDS: the data sheet against itself, and against the identity of the device."""

from __future__ import annotations

from collections.abc import Iterator

from skinnode.conformance.bus import Failed
from skinnode.conformance.case import case
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds import ACCESS, SIZES, Eds, EdsEntry, number

_MANDATORY = ((0x1000, 0), (0x1001, 0), (0x1018, 0), (0x1018, 1))
_TEXTS = (0x09, 0x0A, 0x0B, 0x0F)
_REALS = (0x08, 0x11)
_IDENTITY = ((1, "vendornumber"), (2, "productnumber"), (3, "revisionnumber"))


@case(
    "EDS-01",
    "The EDS does not contradict itself, CiA 301 or the identity of the device",
    "CiA 306-1; 7.5.2.21",
)
def sheet(dut: Dut) -> None:
    faults = [*dut.eds.contradictions, *_missing(dut.eds), *_identity(dut)]
    for entry in dut.eds.entries.values():
        faults += _entry(entry, dut.node_id)
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise Failed("an EDS without contradictions", "; ".join(faults[:5]) + more)


def _missing(eds: Eds) -> Iterator[str]:
    for index, subindex in _MANDATORY:
        if eds.find(index, subindex) is None:
            yield f"0x{index:04X}:{subindex:02X} is mandatory and missing"
    for key, first in (("nrofrxpdo", 0x1400), ("nroftxpdo", 0x1800)):
        count = len(eds.indices(first, first + 0x1FF))
        if number(eds.device.get(key) or "0") != count:
            yield f"{key}={eds.device.get(key)}, but {count} are described"
    for parameter in (*eds.indices(0x1400, 0x15FF), *eds.indices(0x1800, 0x19FF)):
        if not eds.has(parameter + 0x200):
            yield f"0x{parameter:04X} has no mapping parameter 0x{parameter + 0x200:04X}"


def _identity(dut: Dut) -> Iterator[str]:
    for subindex, key in _IDENTITY:
        told = dut.eds.device.get(key, "")
        if told and dut.eds.find(0x1018, subindex) is not None:
            value = dut.sdo.integer(0x1018, subindex)
            if number(told) != value:
                yield f"{key}={told}, the device says 0x{value:08X}"


def _entry(entry: EdsEntry, node_id: int) -> Iterator[str]:
    if entry.access not in ACCESS:
        yield f"{entry}: access type {entry.access!r}"
    if entry.data_type not in SIZES and entry.data_type not in _TEXTS:
        yield f"{entry}: data type 0x{entry.data_type:04X} is not defined"
        return
    if entry.mappable and not (entry.into_rpdo or entry.into_tpdo):
        yield f"{entry}: mappable, but its access fits neither direction"
    if entry.mappable and not entry.size:
        yield f"{entry}: mappable, but of no fixed length"
    if entry.low is not None and entry.high is not None and entry.low > entry.high:
        yield f"{entry}: low limit {entry.low} above high limit {entry.high}"
    try:
        entry.default_bytes(node_id)
        value = (
            None
            if not entry.default or entry.data_type in (*_TEXTS, *_REALS)
            else number(entry.default, node_id)
        )
    except (ValueError, OverflowError):
        yield f"{entry}: default {entry.default!r} is not of its type"
        return
    if value is None:
        return
    if value >= 1 << 8 * entry.size:
        yield f"{entry}: default {entry.default} exceeds its type"
    if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
        yield f"{entry}: default {entry.default} outside its limits"
