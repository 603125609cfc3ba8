"""Conformance cases HB-01 to HB-07: heartbeat producer (0x1017) and consumer (0x1016)."""

from __future__ import annotations

from skinnode.conformance.case import case
from skinnode.conformance.dut import HEARTBEAT, Dut
from skinnode.conformance.frame_period import check_period
from skinnode.conformance.provoked_errors import (
    COMMUNICATION_LOST,
    CONSUMER,
    beat,
    consume,
    expect_emcy,
    expect_no_emcy,
    foreign_id,
    not_before,
)
from skinnode.conformance.sdo import expedited
from skinnode.conformance.tester import QUIET_S, Failed, describe

_PERIOD_MS = 50
_BEHAVIOUR = 0x1029


@case("HB-01", "0x1017 can be written and read back", "7.5.2.20")
def written(dut: Dut) -> None:
    dut.need(HEARTBEAT)
    for value in (1000, 0):
        dut.sdo.write_integer(HEARTBEAT, 0, value, 2)
        if dut.sdo.integer(HEARTBEAT) != value:
            raise Failed(f"0x1017:00 = {value}", str(dut.sdo.integer(HEARTBEAT)))


@case("HB-02", f"Heartbeats arrive every {_PERIOD_MS} ms and contain the NMT state", "7.2.8.3.2.2")
def counted(dut: Dut) -> None:
    dut.need(HEARTBEAT)
    dut.start_heartbeat(_PERIOD_MS)
    frames = [dut.bus.expect(dut.error_control_id, "a heartbeat") for _ in range(12)]
    for frame in frames:
        if frame.data != b"\x7f":
            raise Failed("heartbeats with 7F, PRE-OPERATIONAL", describe(frame))
    check_period(frames, _PERIOD_MS, "a heartbeat")


@case("HB-03", "A producer heartbeat time of 0 stops the heartbeats", "7.5.2.20")
def ended(dut: Dut) -> None:
    dut.need(HEARTBEAT)
    dut.start_heartbeat(_PERIOD_MS)
    dut.bus.expect(dut.error_control_id, "a heartbeat")
    dut.sdo.write_integer(HEARTBEAT, 0, 0, 2)
    dut.bus.pending(dut.error_control_id)
    dut.bus.expect_silence(
        dut.error_control_id, "heartbeat after a producer time of 0", 3 * _PERIOD_MS * 1e-3
    )


@case("HB-04", "A write of the same node-ID to two entries of 0x1016 is refused", "7.5.2.19")
def twice(dut: Dut) -> None:
    dut.need(CONSUMER, 2)
    partner = foreign_id(dut)
    consume(dut, partner, 1000)
    request = expedited(CONSUMER, 2, (partner << 16 | 2000).to_bytes(4, "little"))
    dut.sdo.aborts(
        request, CONSUMER, 2, (0x0604_0043,), f"write of a second entry for node {partner} to 0x1016:02"
    )


@case(
    "HB-05",
    "Heartbeats within the consumer time cause neither an emergency message nor a change of state",
    "7.2.8.2.2.2",
)
def in_time(dut: Dut) -> None:
    partner = foreign_id(dut)
    consume(dut, partner, 300)
    dut.start_heartbeat(_PERIOD_MS)
    dut.operational()
    beat(dut, partner, times=7, each_s=0.1)
    expect_no_emcy(dut, COMMUNICATION_LOST, "while heartbeats arrive within the consumer time")
    dut.expect_state(5, "while heartbeats arrive within the consumer time")


@case(
    "HB-06", "Late heartbeats cause EMCY 0x8130, but not before the consumer time has elapsed", "7.2.8.2.2.2"
)
def too_late(dut: Dut) -> None:
    partner = foreign_id(dut)
    consume(dut, partner, 100)
    dut.operational()
    for _ in range(2):  # a new heartbeat restarts monitoring
        sent_ns = beat(dut, partner)
        frame = expect_emcy(dut, COMMUNICATION_LOST, "when a heartbeat is late")
        not_before(frame, sent_ns, 100, "EMCY 0x8130")


@case(
    "HB-07",
    "After a reset, the first heartbeat starts monitoring; 0x1029 sets the reaction when heartbeats stop",
    "7.2.8.2.2.2, 7.5.2.32",
)
def after_reset(dut: Dut) -> None:
    partner = foreign_id(dut)
    dut.reset()
    consume(dut, partner, 100)
    dut.start_heartbeat(_PERIOD_MS)
    dut.operational()
    dut.bus.wait(0.15 + QUIET_S)
    expect_no_emcy(dut, COMMUNICATION_LOST, "before the first heartbeat")
    dut.expect_state(5, "before the first heartbeat")
    beat(dut, partner)
    expect_emcy(dut, COMMUNICATION_LOST, "when the heartbeats end")
    behaviour = dut.sdo.integer(_BEHAVIOUR, 1) if dut.eds.find(_BEHAVIOUR, 1) is not None else 0
    dut.expect_state({0: 127, 1: 5, 2: 4}.get(behaviour, 127), "when the heartbeats end")
