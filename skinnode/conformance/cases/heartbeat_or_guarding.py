"""Conformance cases HBVG-01 to HBVG-07: heartbeat versus node guarding (CiA 301, 7.2.8.2.2).

A device uses only one of these protocols. If both are enabled, it uses the heartbeat.
"""

from __future__ import annotations

from skinnode.conformance.case import case
from skinnode.conformance.cases.guarding import guarded
from skinnode.conformance.dut import GUARD_TIME, HEARTBEAT, LIFE_TIME_FACTOR, Dut
from skinnode.conformance.frame_period import check_period
from skinnode.conformance.provoked_errors import COMMUNICATION_LOST, expect_no_emcy
from skinnode.conformance.tester import Failed, describe

_PERIOD_MS = 50
_CLAUSE = "7.2.8.2.2"


def _both(dut: Dut, heartbeat_ms: int, guard_ms: int) -> None:
    """Set the heartbeat period and the guard time.

    Raises NotApplicable unless the device supports both heartbeat and guarding.
    """
    dut.need(HEARTBEAT)
    dut.need(GUARD_TIME)
    dut.need(LIFE_TIME_FACTOR)
    dut.sdo.write_integer(GUARD_TIME, 0, guard_ms, 2)
    dut.sdo.write_integer(LIFE_TIME_FACTOR, 0, 2 if guard_ms else 0, 1)
    dut.sdo.write_integer(HEARTBEAT, 0, heartbeat_ms, 2)


def _heartbeats(dut: Dut, *, remote: bool) -> None:
    """Check that heartbeats, and no other error-control frames, arrive at the configured period.

    If ``remote`` is set, a guarding request is sent after each heartbeat.
    """
    frames = []
    for _ in range(8):
        frames.append(dut.bus.expect(dut.error_control_id, "a heartbeat"))
        if remote:
            dut.bus.send(dut.error_control_id, remote=True)
    for frame in frames:
        if frame.data != b"\x7f":
            raise Failed("only heartbeats with data 7F, without a toggle bit", describe(frame))
    check_period(frames, _PERIOD_MS, "one frame")


@case(
    "HBVG-01",
    "The device supports heartbeat or guarding; after a reset, at most one of them is active",
    _CLAUSE,
)
def supported(dut: Dut) -> None:
    heartbeat, guarding = dut.eds.find(HEARTBEAT), dut.eds.find(GUARD_TIME)
    if heartbeat is None and guarding is None:
        raise Failed("heartbeat (0x1017) or guarding (0x100C) in the EDS", "neither")
    running = heartbeat is not None and dut.sdo.integer(HEARTBEAT) > 0
    guarded_too = guarding is not None and dut.sdo.integer(GUARD_TIME) > 0
    if running and guarded_too:
        raise Failed(
            "heartbeat or guarding disabled after a reset", "0x1017 and 0x100C are both greater than 0"
        )


@case("HBVG-02", "Heartbeat off, guarding off: the device sends nothing unsolicited", _CLAUSE)
def both_off(dut: Dut) -> None:
    _both(dut, 0, 0)
    dut.bus.expect_silence(dut.error_control_id, "error-control frame", 3 * _PERIOD_MS * 1e-3)


@case("HBVG-03", "Heartbeat off, guarding on: remote frames are answered, and nothing else is sent", _CLAUSE)
def guarding_on(dut: Dut) -> None:
    _both(dut, 0, 1000)
    for number in range(4):
        guarded(dut, 127, number % 2, "heartbeat off")
    dut.bus.expect_silence(dut.error_control_id, "error-control frame")


@case("HBVG-04", "Heartbeat on, guarding off: heartbeats are sent", _CLAUSE)
def heartbeat_on(dut: Dut) -> None:
    _both(dut, _PERIOD_MS, 0)
    _heartbeats(dut, remote=False)


@case("HBVG-05", "Heartbeat on, guarding off: remote frames are not answered", _CLAUSE)
def heartbeat_on_remote(dut: Dut) -> None:
    _both(dut, _PERIOD_MS, 0)
    _heartbeats(dut, remote=True)


@case("HBVG-06", "Heartbeat on, guarding on: heartbeats are sent", _CLAUSE)
def both_on(dut: Dut) -> None:
    _both(dut, _PERIOD_MS, 50)
    _heartbeats(dut, remote=False)


@case(
    "HBVG-07",
    "Heartbeat on, guarding on: remote frames are not answered and do not start life guarding",
    _CLAUSE,
)
def both_on_remote(dut: Dut) -> None:
    _both(dut, _PERIOD_MS, 50)
    dut.bus.send(dut.error_control_id, remote=True)
    _heartbeats(dut, remote=True)
    dut.bus.wait(0.15)
    expect_no_emcy(dut, COMMUNICATION_LOST, "with the heartbeat on")
