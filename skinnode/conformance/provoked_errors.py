"""Provokes device errors with short RPDOs, missing heartbeats and missing guarding requests."""

from __future__ import annotations

from typing import Final

from skinnode.conformance.case import NotApplicable
from skinnode.conformance.dut import GUARD_TIME, LIFE_TIME_FACTOR, Dut
from skinnode.conformance.pdo import CAN_ID, INVALID, mapped, rpdos
from skinnode.conformance.tester import Failed, describe
from skinnode.transport import Frame

PDO_NOT_PROCESSED, COMMUNICATION_LOST = 0x8210, 0x8130
CONSUMER: Final = 0x1016


def emcy_code(frame: Frame) -> int:
    """Return the error code of an emergency message. Raises Failed if the message is not 8 bytes long."""
    if len(frame.data) != 8:
        raise Failed("an emergency message of 8 bytes", describe(frame))
    return int.from_bytes(frame.data[:2], "little")


def expect_emcy(dut: Dut, code: int, what: str) -> Frame:
    """Wait for an emergency message with the error code ``code``, and return it."""
    return dut.bus.expect(
        dut.emcy_id, f"EMCY 0x{code:04X} {what}", match=lambda frame: emcy_code(frame) == code
    )


def expect_no_emcy(dut: Dut, code: int, what: str) -> None:
    """Raise Failed if an emergency message with the error code ``code`` has arrived."""
    for frame in dut.bus.pending(dut.emcy_id):
        if emcy_code(frame) == code:
            raise Failed(f"no EMCY 0x{code:04X} {what}", describe(frame))


def short_pdo(dut: Dut) -> Frame:
    """Start the device, send it an RPDO without data, and return its emergency message."""
    for pdo in rpdos(dut):
        cob_id = dut.sdo.integer(pdo.parameter, 1)
        if cob_id & INVALID or not mapped(dut, pdo):
            continue
        dut.operational()
        dut.bus.pending(dut.emcy_id)
        dut.bus.send(cob_id & CAN_ID)
        return expect_emcy(dut, PDO_NOT_PROCESSED, f"after {pdo} without data")
    raise NotApplicable("no RPDO is both valid and mapped by default, so no error can be provoked")


def foreign_id(dut: Dut) -> int:
    """Return a node-ID other than the device's."""
    return 0x55 if dut.node_id != 0x55 else 0x56


def consume(dut: Dut, node_id: int, within_ms: int, subindex: int = 1) -> None:
    """Configure the device to monitor the heartbeat of node ``node_id`` (0x1016)."""
    dut.need(CONSUMER, subindex)
    dut.sdo.write_integer(CONSUMER, subindex, node_id << 16 | within_ms, 4)


def beat(dut: Dut, node_id: int, times: int = 1, each_s: float = 0.0, state: int = 5) -> int:
    """Send heartbeats as another node; return the time of the last heartbeat (monotonic clock, ns)."""
    sent_ns = 0
    for number in range(times):
        if number:
            dut.bus.wait(each_s)
        sent_ns = dut.bus.send(0x700 + node_id, bytes((state,)))
    return sent_ns


def lose_partner(dut: Dut, within_ms: int = 100) -> None:
    """Provoke a communication error: start sending heartbeats or guarding requests, then stop.

    Guarding requests are used only if the device has no heartbeat consumer.

    Raises:
        NotApplicable: The device has neither a heartbeat consumer nor life guarding.
    """
    if dut.eds.find(CONSUMER, 1) is not None:
        partner = foreign_id(dut)
        consume(dut, partner, within_ms)
        beat(dut, partner)
    elif dut.eds.find(GUARD_TIME) is not None:
        dut.sdo.write_integer(GUARD_TIME, 0, within_ms, 2)
        dut.sdo.write_integer(LIFE_TIME_FACTOR, 0, 1, 1)
        dut.guard("to begin life guarding")
    else:
        raise NotApplicable("neither heartbeat consumer (0x1016) nor life guarding (0x100C) in the EDS")


def not_before(frame: Frame, since_ns: int, least_ms: int, what: str) -> None:
    """Raise Failed if ``frame`` arrived less than ``least_ms`` milliseconds after ``since_ns``."""
    elapsed_ms = (frame.t_ns - since_ns) * 1e-6
    if elapsed_ms < least_ms - 1:  # 1 ms tolerance for the difference between the clocks
        raise Failed(f"{what} not before {least_ms} ms", f"after {elapsed_ms:.1f} ms")
