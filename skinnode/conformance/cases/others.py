"""Conformance cases OTHER-01 to OTHER-10: storage, verify configuration (0x1020) and restricted CAN-IDs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.dut import HEARTBEAT, RESTORE, STORE, Dut
from skinnode.conformance.pdo import COB_ID, INVALID
from skinnode.conformance.sdo import expedited
from skinnode.conformance.tester import Failed

_EMCY_INHIBIT, _VERIFY, _EMCY = 0x1015, 0x1020, 0x1014
_WRONG_SIGNATURE = (0x0800_0020,)
_RESTRICTED_VALUE = (0x0609_0030, 0x0609_0031, 0x0609_0032)

RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""Ranges of restricted CAN-IDs (CiA 301, 7.3.5): NMT, default SDO, error control and reserved CAN-IDs."""


def _change(dut: Dut) -> tuple[dict[int, bytes], dict[int, bytes]]:
    """Change 0x1015 and 0x1017; return the old and the new values, keyed by index."""
    before, after = {}, {}
    for index, value in ((_EMCY_INHIBIT, 1000), (HEARTBEAT, 20_000)):
        entry = dut.eds.find(index)
        if entry is not None and entry.writable:
            before[index] = dut.sdo.read(index)
            after[index] = value.to_bytes(2, "little")
            dut.sdo.write(index, 0, after[index])
    if not before:
        raise NotApplicable("neither 0x1015 nor 0x1017 can be written")
    return before, after


def _compare(dut: Dut, wanted: Mapping[int, bytes], when: str) -> None:
    for index, value in wanted.items():
        now = dut.sdo.read(index)
        if now != value:
            raise Failed(f"0x{index:04X}:00 = {value.hex(' ').upper()} {when}", now.hex(" ").upper())


def _wrong_signature(dut: Dut, index: int, subindex: int) -> None:
    """Check that a wrong signature is refused and has no effect, even after a reset."""
    dut.need_storage(index, subindex)
    before, after = _change(dut)
    # A device that accepts a wrong signature may store or restore parameters.
    dut.stored = True
    for signature in (b"wron", b"\0\0\0\0", b"SAVE", b"LOAD"):
        request = expedited(index, subindex, signature)
        what = f"{signature!r} to 0x{index:04X}:{subindex:02X}"
        dut.sdo.aborts(request, index, subindex, _WRONG_SIGNATURE, what)
    _compare(dut, after, "after a wrong signature")
    dut.reset()
    _compare(dut, before, "after a wrong signature and a node reset")


def _store(dut: Dut, subindex: int) -> None:
    dut.need_storage(STORE, subindex)
    _, after = _change(dut)
    dut.store(subindex)
    dut.reset()
    _compare(dut, after, "after storing the value and resetting the node")


def _restore(dut: Dut, subindex: int) -> None:
    """Check that the command to restore defaults takes effect at the next reset, but not earlier."""
    dut.need_storage(RESTORE, subindex)
    if dut.eds.find(STORE, subindex) is not None:
        _store(dut, subindex)
    _, after = _change(dut)
    dut.restore(subindex)
    _compare(dut, after, "after the command to restore defaults, before the reset")
    dut.reset()
    defaults = {index: dut.need(index).default_bytes(dut.node_id) for index in after}
    _compare(
        dut,
        {i: d for i, d in defaults.items() if d is not None},
        "after restoring defaults and resetting the node",
    )


@case("OTHER-01", "0x1010:01 stores nothing if the signature is wrong", "7.5.2.13")
def store_all_wrong(dut: Dut) -> None:
    _wrong_signature(dut, STORE, 1)


@case(
    "OTHER-02",
    "0x1010:01 stores parameters if the signature is 'save', and the values survive a node reset",
    "7.5.2.13",
)
def store_all(dut: Dut) -> None:
    _store(dut, 1)


@case("OTHER-03", "0x1011:01 restores nothing if the signature is wrong", "7.5.2.14")
def restore_all_wrong(dut: Dut) -> None:
    _wrong_signature(dut, RESTORE, 1)


@case(
    "OTHER-04",
    "0x1011:01 restores defaults at the next node reset if the signature is 'load'",
    "7.5.2.14",
)
def restore_all(dut: Dut) -> None:
    _restore(dut, 1)


@case("OTHER-05", "0x1010:02 stores no communication parameters if the signature is wrong", "7.5.2.13")
def store_communication_wrong(dut: Dut) -> None:
    _wrong_signature(dut, STORE, 2)


@case(
    "OTHER-06",
    "0x1010:02 stores communication parameters if the signature is 'save'; they survive a node reset",
    "7.5.2.13",
)
def store_communication(dut: Dut) -> None:
    _store(dut, 2)


@case("OTHER-07", "0x1011:02 restores no communication parameters if the signature is wrong", "7.5.2.14")
def restore_communication_wrong(dut: Dut) -> None:
    _wrong_signature(dut, RESTORE, 2)


@case(
    "OTHER-08",
    "0x1011:02 restores communication defaults at the next node reset if the signature is 'load'",
    "7.5.2.14",
)
def restore_communication(dut: Dut) -> None:
    _restore(dut, 2)


@case("OTHER-09", "0x1020 retains its values across store and reset; a write to another object clears it",
      "7.5.2.23")  # fmt: skip
def verify(dut: Dut) -> None:
    dut.need(_VERIFY, 1)
    dut.need(_VERIFY, 2)
    dut.need_storage(STORE, 1)
    date, time = 15_000, 43_200_000  # date: days since 1984-01-01; time: ms since midnight
    dut.sdo.write_integer(_VERIFY, 1, date, 4)
    dut.sdo.write_integer(_VERIFY, 2, time, 4)
    dut.store(1)
    dut.reset()
    got = dut.sdo.integer(_VERIFY, 1), dut.sdo.integer(_VERIFY, 2)
    if got != (date, time):
        raise Failed(f"date {date} and time {time} after a node reset", f"{got[0]} and {got[1]}")
    _change(dut)
    got = dut.sdo.integer(_VERIFY, 1), dut.sdo.integer(_VERIFY, 2)
    if got != (0, 0):
        raise Failed("date 0 and time 0 after a write to another object", f"{got[0]} and {got[1]}")


@case("OTHER-10", "No COB-ID can be set to a restricted CAN-ID", "7.3.5")
def restricted(dut: Dut) -> None:
    found = False
    for index, subindex in _cob_ids(dut):
        found = True
        if index == _EMCY or index >= 0x1280:  # a valid COB-ID must be disabled before it is changed
            current = dut.sdo.integer(index, subindex)
            dut.sdo.write_integer(index, subindex, current | INVALID, 4)
        for block in RESTRICTED:
            for can_id in block:
                request = expedited(index, subindex, can_id.to_bytes(4, "little"))
                what = f"CAN-ID 0x{can_id:03X} for 0x{index:04X}:{subindex:02X}"
                dut.sdo.aborts(request, index, subindex, _RESTRICTED_VALUE, what)
    if not found:
        raise NotApplicable("no COB-ID in the EDS is writable")


def _cob_ids(dut: Dut) -> Iterator[tuple[int, int]]:
    """Yield the index and sub-index of each writable COB-ID: SYNC, TIME, EMCY, first RPDO, first TPDO."""
    pdos = [indices[0] for first in (0x1400, 0x1800) if (indices := dut.eds.indices(first, first + 0x1FF))]
    for index, subindex in ((0x1005, 0), (0x1012, 0), (_EMCY, 0), *((index, COB_ID) for index in pdos)):
        entry = dut.eds.find(index, subindex)
        if entry is not None and entry.writable:
            yield index, subindex
