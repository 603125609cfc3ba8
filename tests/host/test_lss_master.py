"""The LSS master against slaves that answer late: an answer is never taken for one to another question."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from skinnode.canopen import indices as od
from skinnode.canopen.lss import NOT_CONFIGURED, LssAddress, LssCommand
from skinnode.host.lss_master import ANSWER_S, LssFailed, LssMaster
from skinnode.node.lss import LssSlave
from skinnode.process import clock

LATE_S = 1.5 * ANSWER_S


def address(serial: int, vendor: int = od.VENDOR_ID) -> LssAddress:
    return LssAddress(vendor, od.PRODUCT_CODE, od.REVISION_NUMBER, serial)


class Line:
    """A master and slaves of ours, whose answers to some commands come late. They are otherwise given before
    the question has been sent to its end."""

    def __init__(self, *slaves: LssSlave) -> None:
        self.master = LssMaster(self._send)
        self.slaves = slaves
        self.late: set[int] = set()
        """Commands whose next answer comes late."""
        self.late_s = LATE_S
        self.resets: list[bytes] = []
        self._timers: list[threading.Thread] = []

    def _send(self, can_id: int, data: bytes) -> None:
        if can_id == od.NMT_COB_ID:
            self.resets.append(data)
            return
        assert can_id == 0x7E5
        assert len(data) == 8
        for slave in self.slaves:
            answer = slave.on_request(data)
            if answer is None:
                continue
            if data[0] in self.late:
                self.late.discard(data[0])
                timer = clock.thread(self._answer_late, "late answer", (answer,))
                timer.start()
                self._timers.append(timer)
            else:
                self.master.on_response(answer, 0)

    def _answer_late(self, answer: bytes) -> None:
        clock.sleep(self.late_s)
        self.master.on_response(answer, 0)

    def close(self) -> None:
        for timer in self._timers:
            timer.join()


@pytest.fixture
def line_of() -> Iterator[Callable[..., Line]]:
    made: list[Line] = []

    def make(*slaves: LssSlave) -> Line:
        made.append(Line(*slaves))
        return made[-1]

    yield make
    for line in made:
        line.close()


def slave(serial: int, node_id: int = NOT_CONFIGURED, vendor: int = od.VENDOR_ID) -> LssSlave:
    return LssSlave(address(serial, vendor), node_id)


def test_a_late_selected_is_not_taken_for_that_of_another(line_of: Callable[..., Line]) -> None:
    line = line_of(slave(7, 5))
    line.late = {0x43}
    assert not line.master.select(address(7))
    assert not line.master.select(address(8))  # there is none, but the answer of before comes now
    assert line.master.select(address(7))


def test_a_late_node_id_is_not_taken_for_that_of_another(line_of: Callable[..., Line]) -> None:
    line = line_of(slave(7, 5), slave(8, 6))
    line.late = {0x5E}
    assert line.master.select(address(7))
    with pytest.raises(LssFailed, match="the node-ID inquiry: no LSS response"):
        line.master.node_id()
    assert line.master.select(address(8))
    line.late, line.late_s = {0x5E}, 0.8 * ANSWER_S
    assert line.master.node_id() == 6


@pytest.mark.parametrize("serial", [0, 7, 0xFFFF_FFFF, 0x5555_5555])
def test_fastscan_finds_every_address(line_of: Callable[..., Line], serial: int) -> None:
    line = line_of(slave(serial), slave(3, 5))
    assert line.master.any_unconfigured()
    assert line.master.find_unconfigured() == address(serial)
    assert line.master.node_id() is None
    line.master.set_node_id(9)
    assert line.slaves[0].node_id == 9 or line.slaves[0].pending_node_id == 9


def test_fastscan_with_a_late_answer_never_finds_what_is_not_there(line_of: Callable[..., Line]) -> None:
    line = line_of(slave(0b1010))
    line.late = {0x51}
    for _ in range(3):
        found = line.master.find_unconfigured()
        assert found in (None, address(0b1010))
        line.late = {0x51}


def test_node_id_for_a_serial_number(line_of: Callable[..., Line]) -> None:
    line = line_of(slave(7, 5), slave(8))
    assert line.master.give_node_id(7, 5)  # has it
    assert line.resets == []
    assert line.master.give_node_id(7, 9)
    assert line.resets == [bytes((0x82, 5))]
    assert line.master.give_node_id(8, 6)  # it boots when it is let go, nobody needs to reset it
    assert not line.master.give_node_id(99, 6)
    assert len(line.resets) == 1


def test_patches_of_both_revisions_are_found(line_of: Callable[..., Line]) -> None:
    old = LssAddress(od.VENDOR_ID, od.PRODUCT_CODE, 0x0001_0000, 7)
    line = line_of(LssSlave(old, NOT_CONFIGURED), slave(8, 5))
    assert line.master.find_unconfigured() == old
    assert line.master.select_patch(7) == old
    assert line.master.select_patch(8) == address(8)
    assert line.master.select_patch(9) is None
    assert line.master.give_node_id(7, 6)


def test_a_frame_that_is_not_of_8_bytes_is_none(line_of: Callable[..., Line]) -> None:
    line = line_of()
    line.master.on_response(bytes((0x50,)), 0)
    assert not line.master.any_unconfigured()


def test_a_bit_rate_that_there_is_not(line_of: Callable[..., Line]) -> None:
    with pytest.raises(ValueError, match="bitrate: got 123, must be one of 1000000, 800000"):
        line_of().master.set_bit_rate(123)


def test_a_node_may_take_longer_to_store_than_to_answer(line_of: Callable[..., Line]) -> None:
    """Flash memory, or a file that is synchronised to disk, takes a while."""
    line = line_of(LssSlave(address(7), NOT_CONFIGURED, store=lambda node_id, bit_rate_bps: None))
    assert line.master.select(address(7))
    line.master.set_node_id(5)
    line.late = {LssCommand.STORE}
    line.master.store()
