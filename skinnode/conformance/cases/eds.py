"""Conformance case EDS-01: the EDS is consistent with itself, with CiA 301 and with the device's identity."""

from __future__ import annotations

from collections.abc import Iterator

from skinnode.conformance.case import Warned, case
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds_reader import ACCESS, SIZES, Eds, EdsEntry, number
from skinnode.conformance.tester import Failed

_MANDATORY = ((0x1000, 0), (0x1001, 0), (0x1018, 0), (0x1018, 1))
_TEXTS = (0x09, 0x0A, 0x0B, 0x0F)
_DOMAIN = 0x0F
_REALS = (0x08, 0x11)
_IDENTITY = ((1, "vendornumber"), (2, "productnumber"), (3, "revisionnumber"))


@case(
    "EDS-01",
    "The EDS is consistent with itself, with CiA 301 and with the device's identity",
    "CiA 306-1; 7.5.2.21",
)
def sheet(dut: Dut) -> None:
    faults = [*dut.eds.contradictions, *_missing(dut.eds), *_identity(dut)]
    doubts = [*_miscounted(dut.eds)]
    for entry in dut.eds.entries.values():
        faults += _entry(entry, dut.node_id)
        doubts += _doubtful(entry, dut.node_id)
    if faults:
        raise Failed("an EDS without contradictions", _first(faults + doubts))
    if doubts:
        raise Warned(_first(doubts))


def _first(lines: list[str]) -> str:
    more = f" and {len(lines) - 5} more" if len(lines) > 5 else ""
    return "; ".join(lines[:5]) + more


def _missing(eds: Eds) -> Iterator[str]:
    for index, subindex in _MANDATORY:
        if eds.find(index, subindex) is None:
            yield f"0x{index:04X}:{subindex:02X} is mandatory but missing"
    for parameter in (*eds.indices(0x1400, 0x15FF), *eds.indices(0x1800, 0x19FF)):
        if not eds.has(parameter + 0x200):
            yield f"0x{parameter:04X} has no mapping parameter 0x{parameter + 0x200:04X}"


def _miscounted(eds: Eds) -> Iterator[str]:
    """Yield one line for each PDO count in DeviceInfo that differs from the number of PDOs in the EDS."""
    for key, name, first in (("nrofrxpdo", "NrOfRXPDO", 0x1400), ("nroftxpdo", "NrOfTXPDO", 0x1800)):
        stated, count = eds.device.get(key) or "", len(eds.indices(first, first + 0x1FF))
        try:
            right = number(stated or "0") == count
        except ValueError:
            right = False
        if not right:
            yield f"{name}={stated}, but the EDS describes {count}"


def _identity(dut: Dut) -> Iterator[str]:
    for subindex, key in _IDENTITY:
        stated = dut.eds.device.get(key, "")
        if stated and dut.eds.find(0x1018, subindex) is not None:
            value = dut.sdo.integer(0x1018, subindex)
            try:
                same = number(stated) == value
            except ValueError:
                same = False
            if not same:
                yield f"{key}={stated}, but the device reports 0x{value:08X}"


def _entry(entry: EdsEntry, node_id: int) -> Iterator[str]:
    if entry.access not in ACCESS:
        yield f"{entry}: access type {entry.access!r}"
    if entry.data_type not in SIZES and entry.data_type not in _TEXTS:
        yield f"{entry}: data type 0x{entry.data_type:04X} is not defined"
        return
    if entry.mappable and not (entry.into_rpdo or entry.into_tpdo):
        yield f"{entry}: mappable, but its access type forbids both RPDOs and TPDOs"
    if entry.mappable and entry.data_type == _DOMAIN:
        yield f"{entry}: mappable, although it is a DOMAIN"
    try:
        entry.default_bytes(node_id)
        value = _default(entry, node_id)
    except (ValueError, OverflowError):
        yield f"{entry}: default {entry.default!r} does not fit the data type"
        return
    if value is not None and value >= 1 << 8 * entry.size:
        yield f"{entry}: default {entry.default} exceeds the range of its data type"


def _doubtful(entry: EdsEntry, node_id: int) -> Iterator[str]:
    """Yield one line for each entry property that is allowed but not supported by some tools."""
    if entry.mappable and not entry.size and entry.data_type in _TEXTS and entry.data_type != _DOMAIN:
        yield f"{entry}: mappable, but of variable length"
    if entry.low is not None and entry.high is not None and entry.low > entry.high:
        yield f"{entry}: low limit {entry.low} is above high limit {entry.high}"
    try:
        value = _default(entry, node_id)
    except ValueError:
        return  # _entry reports this fault
    if value is None:
        return
    if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
        yield f"{entry}: default {entry.default} is outside the limits"


def _default(entry: EdsEntry, node_id: int) -> int | None:
    """Return the default value of an integer entry; None if the entry has no default or is not an integer.

    Raises ValueError if the default is malformed.
    """
    if not entry.default or entry.data_type in (*_TEXTS, *_REALS):
        return None
    return number(entry.default, node_id)
