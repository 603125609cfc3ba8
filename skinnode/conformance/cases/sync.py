"""Conformance cases SYNC-01 to SYNC-10: SYNC producer, consumer and counter."""

from __future__ import annotations

from skinnode.conformance.case import NotApplicable, case
from skinnode.conformance.dut import STORE, Dut
from skinnode.conformance.frame_period import check_period
from skinnode.conformance.pdo import SYNC_ID, Pdo, PdoSetup, drain, mapped, payload_bytes, set_up, sync, tpdos
from skinnode.conformance.sdo import Aborted, expedited
from skinnode.conformance.tester import QUIET_S, Failed, describe
from skinnode.text.words import counted

COB_ID, PERIOD, OVERFLOW = 0x1005, 0x1006, 0x1019
PRODUCE = 1 << 30
PERIOD_MS = 50
_INVALID_VALUE = (0x0609_0030, 0x0609_0031, 0x0609_0032)
_BUSY = (0x0800_0022,)


def consume_only(dut: Dut) -> None:
    """Stop the SYNC producer and set the period to 0, so that the counter overflow value can be written."""
    dut.need(COB_ID)
    dut.sdo.write_integer(COB_ID, 0, SYNC_ID, 4)
    if dut.eds.find(PERIOD) is not None:
        dut.sdo.write_integer(PERIOD, 0, 0, 4)


def produce(dut: Dut, period_ms: int = PERIOD_MS) -> None:
    """Start the SYNC producer. Raises NotApplicable if the device cannot produce SYNC."""
    dut.need(COB_ID)
    dut.need(PERIOD)
    dut.sdo.write_integer(PERIOD, 0, period_ms * 1000, 4)
    try:
        dut.sdo.write_integer(COB_ID, 0, SYNC_ID | PRODUCE, 4)
    except Aborted as abort:
        if abort.code in (*_INVALID_VALUE, 0x0800_0000):
            raise NotApplicable(f"no SYNC producer: the device refuses bit 30 of 0x1005: {abort}") from abort
        raise


@case("SYNC-01", "0x1005 is 0x80: the device is a SYNC consumer", "7.5.2.5; 7.3.3")
def default(dut: Dut) -> None:
    dut.need(COB_ID)
    cob_id = dut.sdo.integer(COB_ID)
    if cob_id & 0x3FFF_FFFF != SYNC_ID:
        raise Failed("0x1005:00 = 0x00000080 (bit 30 is ignored)", f"0x{cob_id:08X}")


@case("SYNC-02", f"The producer sends SYNC every {PERIOD_MS} ms and can be stopped", "7.2.5, 7.5.2.6")
def producer(dut: Dut) -> None:
    produce(dut)
    frames = [dut.bus.expect(SYNC_ID, "SYNC") for _ in range(12)]
    check_period(frames, PERIOD_MS, "SYNC")
    consume_only(dut)
    dut.bus.pending(SYNC_ID)
    dut.bus.expect_silence(SYNC_ID, "SYNC after the producer was stopped", 3 * PERIOD_MS * 1e-3)


@case("SYNC-03", "A TPDO of transmission type 10 is sent three times during 30 SYNCs", "7.2.2.2, 7.5.2.37")
def count(dut: Dut) -> None:
    pdo = _synchronous(dut)
    for other in tpdos(dut):
        if other != pdo:
            dut.sdo.write_integer(other.parameter, 1, dut.sdo.integer(other.parameter, 1) | 1 << 31, 4)
    can_id, length = set_up(dut, pdo, PdoSetup(10)), payload_bytes(mapped(dut, pdo))
    dut.operational()
    drain(dut, can_id)
    for _ in range(30):
        sync(dut)
        dut.bus.wait(0.01)
    dut.bus.wait(QUIET_S)
    frames = dut.bus.pending(can_id)
    if len(frames) != 3 or any(len(frame.data) != length for frame in frames):
        raise Failed(
            f"{pdo} 3 times, {counted(length, 'byte')}",
            f"{len(frames)} times: {describe(frames[0] if frames else None)}",
        )


def _synchronous(dut: Dut) -> Pdo:
    """Return a TPDO that is synchronous by default or, failing that, the first TPDO that maps an object."""
    usable = [pdo for pdo in tpdos(dut) if mapped(dut, pdo)]
    if not usable:
        raise NotApplicable("no TPDO maps an object by default")
    return next((pdo for pdo in usable if dut.sdo.integer(pdo.parameter, 2) <= 240), usable[0])


@case("SYNC-04", "A consumer accepts a communication cycle period of 0", "7.5.2.6")
def no_period(dut: Dut) -> None:
    dut.need(PERIOD)
    consume_only(dut)
    if dut.sdo.integer(PERIOD):
        raise Failed("0x1006:00 = 0", str(dut.sdo.integer(PERIOD)))


@case("SYNC-05", "Counter overflow values 1, 241 and 255 are refused", "7.5.2.22")
def wrong_overflow(dut: Dut) -> None:
    dut.need(OVERFLOW)
    consume_only(dut)
    before = dut.sdo.integer(OVERFLOW)
    for value in (1, 241, 255):
        request = expedited(OVERFLOW, 0, bytes((value,)))
        dut.sdo.aborts(request, OVERFLOW, 0, _INVALID_VALUE, f"write of {value} to 0x1019:00")
    if dut.sdo.integer(OVERFLOW) != before:
        raise Failed(f"0x1019:00 still {before}", str(dut.sdo.integer(OVERFLOW)))


@case(
    "SYNC-06", "With a counter overflow value of 0, the producer sends SYNC without data", "7.2.5, 7.5.2.22"
)
def no_counter(dut: Dut) -> None:
    dut.need(OVERFLOW)
    consume_only(dut)
    dut.sdo.write_integer(OVERFLOW, 0, 0, 1)
    produce(dut)
    for _ in range(3):
        frame = dut.bus.expect(SYNC_ID, "SYNC")
        if frame.data:
            raise Failed("SYNC without data", describe(frame))


def _counted(dut: Dut, values: list[int], what: str) -> None:
    for value in values:
        frame = dut.bus.expect(SYNC_ID, f"SYNC {what}")
        if frame.data != bytes((value,)):
            raise Failed(f"SYNC with counter {value} {what}", describe(frame))


@case(
    "SYNC-07",
    "With a counter overflow value of 5, the producer counts from 1 to 5 repeatedly",
    "7.2.5, 7.5.2.22",
)
def counter(dut: Dut) -> None:
    dut.need(OVERFLOW)
    consume_only(dut)
    dut.sdo.write_integer(OVERFLOW, 0, 5, 1)
    produce(dut)
    _counted(dut, [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1], "(overflow value 5)")


@case(
    "SYNC-08",
    "With parameters stored through 0x1010:01, the producer starts after a node reset and counts from 1",
    "7.5.2.13, 7.5.2.22",
)
def counter_stored(dut: Dut) -> None:
    dut.need(OVERFLOW)
    dut.need_storage(STORE, 1)
    consume_only(dut)
    dut.sdo.write_integer(OVERFLOW, 0, 5, 1)
    produce(dut)
    dut.store(1)
    dut.reset()
    _counted(dut, [1, 2, 3], "after a node reset")


@case("SYNC-09", "The counter overflow value cannot be written while the SYNC period is not 0", "7.5.2.22")
def overflow_in_use(dut: Dut) -> None:
    dut.need(OVERFLOW)
    dut.need(PERIOD)
    consume_only(dut)
    dut.sdo.write_integer(PERIOD, 0, 1000, 4)
    request = expedited(OVERFLOW, 0, b"\x05")
    dut.sdo.aborts(request, OVERFLOW, 0, _BUSY, "write to 0x1019:00 while the period in 0x1006 is not 0")


@case(
    "SYNC-10",
    "The counter overflow value stored through 0x1010:01 survives a node reset",
    "7.5.2.13, 7.5.2.22",
)
def overflow_stored(dut: Dut) -> None:
    dut.need(OVERFLOW)
    dut.need_storage(STORE, 1)
    consume_only(dut)
    dut.sdo.write_integer(OVERFLOW, 0, 5, 1)
    dut.store(1)
    dut.reset()
    value = dut.sdo.integer(OVERFLOW)
    if value != 5:
        raise Failed("0x1019:00 = 5 after a node reset", str(value))
