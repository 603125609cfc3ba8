"""The tester beside a device that is not CANopen, on the same bus."""

from __future__ import annotations

from collections.abc import Iterator

import can
import pytest

from skinnode.conformance import tester
from skinnode.process import clock
from skinnode.transport import CanPort

from .conftest import bus_in_this_time

CHANNEL = "foreign"


@pytest.fixture
def other() -> Iterator[can.BusABC]:
    with can.Bus(interface="timed", channel=CHANNEL, ignore_config=True) as bus:
        yield bus


@pytest.fixture
def bus() -> Iterator[tester.Tester]:
    with CanPort(bus_in_this_time(CHANNEL)) as port:
        yield tester.Tester(port)


def send_foreign_then_heartbeat(other: can.BusABC) -> None:
    for _ in range(3):
        other.send(can.Message(arbitration_id=0x18FF0104, is_extended_id=True, data=b"x"))
    other.send(can.Message(arbitration_id=0x704, is_extended_id=False, data=b"\x05"))
    clock.sleep(0.01)


def test_frames_behind_extended_frames_are_discarded(bus: tester.Tester, other: can.BusABC) -> None:
    send_foreign_then_heartbeat(other)
    bus.begin()
    bus.expect_silence(0x704, "heartbeat from before the case")


def test_frames_behind_extended_frames_have_arrived(bus: tester.Tester, other: can.BusABC) -> None:
    send_foreign_then_heartbeat(other)
    assert [frame.data for frame in bus.pending(0x704)] == [b"\x05"]
    assert [line.can_id for line in bus.trace] == [0x704]


def test_extended_frames_do_not_end_a_wait(bus: tester.Tester, other: can.BusABC) -> None:
    send_foreign_then_heartbeat(other)
    assert bus.expect(0x704, "heartbeat").data == b"\x05"
