"""Conformance cases GUARD-01 to GUARD-06: node guarding and life guarding."""

from __future__ import annotations

from skinnode.conformance.case import case
from skinnode.conformance.dut import GUARD_TIME, LIFE_TIME_FACTOR, RESET_COMMUNICATION, STATES, Dut
from skinnode.conformance.provoked_errors import COMMUNICATION_LOST, expect_emcy, expect_no_emcy, not_before
from skinnode.conformance.tester import Failed

_TOGGLE = 0x80
_GUARD_MS, _FACTOR = 100, 3


def guarded(dut: Dut, state: int, toggle: int | None, what: str) -> None:
    """Check the NMT state and the toggle bit in the response to a remote frame.

    If ``toggle`` is None, the toggle bit is not checked. Raises Failed if the response differs.
    """
    got = dut.guard(what)
    toggle_text = "any toggle bit" if toggle is None else f"toggle bit {toggle}"
    if got is None:
        raise Failed(f"{STATES[state]} and {toggle_text} in response to a remote frame, {what}", "nothing")
    if got & 0x7F != state or (toggle is not None and got >> 7 != toggle):
        raise Failed(
            f"{STATES[state]} and {toggle_text} in response to a remote frame, {what}", f"0x{got:02X}"
        )


@case("GUARD-01", "0x100C and 0x100D are 0 by default, which disables life guarding", "7.5.2.11, 7.5.2.12")
def defaults(dut: Dut) -> None:
    for index in (GUARD_TIME, LIFE_TIME_FACTOR):
        default = dut.need(index).default_bytes(dut.node_id)
        value = dut.sdo.read(index)
        if value != default:
            raise Failed(f"0x{index:04X}:00 to equal the default in the EDS", value.hex(" ").upper())


@case("GUARD-02", "The device answers a remote frame with its NMT state", "7.2.8.3.2.1")
def answered(dut: Dut) -> None:
    dut.need(GUARD_TIME)
    guarded(dut, 127, None, "after a reset")


@case(
    "GUARD-03",
    "The toggle bit starts at 0, alternates, and is 0 again after a communication reset",
    "7.2.8.3.2.1",
)
def toggle(dut: Dut) -> None:
    dut.need(GUARD_TIME)
    for number in range(5):
        guarded(dut, 127, number % 2, f"answer {number + 1}")
    dut.reset(RESET_COMMUNICATION)
    guarded(dut, 127, 0, "after a communication reset")


@case("GUARD-04", "The device does not answer remote frames for other node-IDs", "7.2.8.3.2.1; 7.3.3")
def others(dut: Dut) -> None:
    dut.need(GUARD_TIME)
    for node_id in range(1, 128):
        if node_id != dut.node_id:
            dut.bus.send(0x700 + node_id, remote=True)
    dut.bus.expect_silence(dut.error_control_id, "response to remote frames for other nodes")
    guarded(dut, 127, 0, "after remote frames for other nodes")


@case("GUARD-05", "0x100C and 0x100D can be written and read back", "7.5.2.11, 7.5.2.12")
def written(dut: Dut) -> None:
    dut.need(GUARD_TIME)
    dut.need(LIFE_TIME_FACTOR)
    dut.sdo.write_integer(GUARD_TIME, 0, 0x1234, 2)
    dut.sdo.write_integer(LIFE_TIME_FACTOR, 0, 3, 1)
    got = dut.sdo.integer(GUARD_TIME), dut.sdo.integer(LIFE_TIME_FACTOR)
    if got != (0x1234, 3):
        raise Failed("the written values 0x1234 and 3", f"0x{got[0]:04X} and {got[1]}")


@case("GUARD-06", "Remote frames start life guarding; when they stop, the device sends EMCY 0x8130",
      "7.2.8.2.2.1, 7.5.2.12")  # fmt: skip
def life_guarding(dut: Dut) -> None:
    dut.need(GUARD_TIME)
    dut.need(LIFE_TIME_FACTOR)
    dut.sdo.write_integer(GUARD_TIME, 0, _GUARD_MS, 2)
    dut.sdo.write_integer(LIFE_TIME_FACTOR, 0, _FACTOR, 1)
    dut.operational()
    dut.bus.wait(1.3 * _GUARD_MS * _FACTOR * 1e-3)
    expect_no_emcy(dut, COMMUNICATION_LOST, "before the first remote frame")
    sent_ns = 0
    for _ in range(8):
        sent_ns = dut.bus.send(dut.error_control_id, remote=True)
        dut.bus.wait(0.5 * _GUARD_MS * 1e-3)
    expect_no_emcy(dut, COMMUNICATION_LOST, "while remote frames arrive")
    frame = expect_emcy(dut, COMMUNICATION_LOST, "when remote frames stop")
    not_before(frame, sent_ns, _GUARD_MS * _FACTOR, "EMCY 0x8130")
    if dut.eds.find(0x1029, 1) is None or dut.sdo.integer(0x1029, 1) == 0:
        guarded(dut, 127, None, "after a life guarding event in OPERATIONAL")
