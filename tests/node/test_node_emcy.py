"""Emergencies: what is told, once, and where it can be read (CiA 301 v4.2, 7.2.7, 0x1001, 0x1003, 0x1014,
0x1015). Frames by hand."""

from __future__ import annotations

import numpy as np

from skinnode.node import NmtState


def test_open_wire_is_told_once_and_its_end_too(operational) -> None:
    desk = operational
    healthy = desk.source.ohm
    broken = healthy.copy()
    broken[1] = np.inf
    desk.source.ohm = broken
    # 0x5000, register: generic and manufacturer, kind 0 (upper open), wire 1, one wire in all
    assert desk.frame(0x80, "01")[0] == (0x084, "00 50 81 00 01 01 00 00")
    desk.run(80)
    desk.take()
    assert all(can_id != 0x084 for can_id, _ in desk.frame(0x80, "02"))
    desk.run(80)
    assert desk.read(0x1001, 0) == 0x81
    assert desk.read(0x1003, 0) == 1
    assert desk.read(0x1003, 1) == 0x0100_5000
    assert desk.read(0x2030, 1) == 0b10
    assert desk.read(0x2031, 1) == 0
    desk.source.ohm = healthy
    desk.take()
    assert desk.frame(0x80, "03")[0] == (0x084, "00 00 00 00 50 00 00 00")
    assert desk.read(0x1001, 0) == 0


def test_pulled_connector_is_one_message(operational) -> None:
    desk = operational
    desk.source.ohm = np.full((2, 6), np.inf)
    emergencies = [data for can_id, data in desk.frame(0x80, "01") if can_id == 0x084]
    assert emergencies == ["00 50 81 00 00 08 00 00"]  # 2 upper and 6 lower wires
    assert desk.read(0x2031, 1) == 0b111111


def test_shorted_lower_wire(operational) -> None:
    desk = operational
    broken = desk.source.ohm.copy()
    broken[:, 5] = 0.0
    desk.source.ohm = broken
    assert desk.frame(0x80, "01")[0] == (0x084, "00 50 81 03 05 01 00 00")
    assert desk.read(0x2031, 2) == 1 << 5


def test_sync_of_the_wrong_length(operational) -> None:
    desk = operational
    assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00")]
    assert desk.frame(0x80, "01 02") == [(0x084, "40 82 11 02 01 00 00 00")]
    assert desk.read(0x1001, 0) == 0  # over as soon as told
    assert desk.read(0x1003, 0) == 2


def test_sync_of_one_wrong_length_is_told_once(operational) -> None:
    """A node that was reset hears the SYNC of its master with a counter it knows nothing of, for ever."""
    desk = operational
    told = [desk.frame(0x80) for _ in range(5)]
    assert told == [[(0x084, "40 82 11 00 01 00 00 00")], [], [], [], []]
    desk.frame(0x80, "01")
    assert desk.frame(0x80) == [(0x084, "40 82 11 00 01 00 00 00")]


def test_history_is_the_newest_first_and_can_be_cleared(operational) -> None:
    desk = operational
    for length in range(2, 9):
        desk.frame(0x80, "00" * length)
    desk.frame(0x80, "00 00 00")
    desk.frame(0x204, "00")
    assert desk.read(0x1003, 0) == 8  # nine happened
    assert desk.read(0x1003, 1) & 0xFFFF == 0x8210
    assert desk.read(0x1003, 2) == 0x0103_8240  # three bytes came, one was expected
    desk.write(0x1003, 0, 0, 1)
    assert desk.read(0x1003, 0) == 0


def test_inhibit_time(operational) -> None:
    desk = operational
    desk.write(0x1015, 0, 100, 2)  # 10 ms
    start_ns = desk.t_ns
    for length in (0, 2, 3):
        desk.node.on_frame(0x80, bytes(length), desk.t_ns)
    desk.run(50)
    assert [t_ns - start_ns for can_id, _, t_ns in desk.sent if can_id == 0x084] == [
        0,
        10_000_000,
        20_000_000,
    ]


def test_disabled_by_its_cob_id(operational) -> None:
    desk = operational
    desk.write(0x1014, 0, 0x80000084, 4)
    assert desk.frame(0x80) == []
    assert desk.read(0x1003, 0) == 1


def test_reset_forgets_errors(operational) -> None:
    desk = operational
    desk.source.ohm = np.full((2, 6), np.inf)
    desk.frame(0x80, "01")
    assert desk.read(0x1003, 0) == 1
    desk.frame(0, "82 00")
    assert desk.read(0x1003, 0) == 0
    assert desk.read(0x1001, 0) == 0
    desk.start()
    assert [data for can_id, data in desk.frame(0x80) if can_id == 0x084] == ["00 50 81 00 00 08 00 00"]


def test_emergency_of_a_stopped_node_waits(operational) -> None:
    desk = operational
    desk.write(0x1029, 1, 2, 1)
    desk.write(0x1016, 1, 0x007F_000A, 4)
    desk.write(0x1015, 0, 10_000, 2)  # 1 s: the second message is held back
    desk.frame(0x80)
    desk.frame(0x77F, "05")
    desk.run(10)
    assert desk.node.nmt_state is NmtState.STOPPED
    desk.run(2000)
    assert desk.take() == []
    assert desk.frame(0, "80 00") == [(0x084, "30 81 11 7f 00 00 00 00")]
