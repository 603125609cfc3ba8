"""Heartbeats: sent (0x1017) and expected of others (0x1016, 0x1029). CiA 301 v4.2, 7.2.8.3.2.2, frames by
hand."""

from __future__ import annotations

import pytest

from skinnode.node import NmtState


def test_heartbeat_names_the_state_and_keeps_its_beat(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    start_ns = desk.t_ns
    desk.run(250)
    desk.node.on_frame(0, b"\x01\x00", desk.t_ns)
    desk.run(100)
    assert [(data[0], t_ns - start_ns) for can_id, data, t_ns in desk.sent if can_id == 0x704] == [
        (0x7F, 0),  # "begins immediately"
        (0x7F, 100_000_000),
        (0x7F, 200_000_000),
        (0x05, 300_000_000),
    ]


def test_heartbeat_served_late_keeps_its_beat_and_sends_no_bursts(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    start_ns = desk.t_ns
    for late_ms in (0, 130, 200, 730):
        desk.t_ns = start_ns + late_ms * 1_000_000
        desk.node.on_timer(desk.t_ns)
    assert desk.take() == [(0x704, "7f")] * 4
    assert desk.node.next_deadline_ns() == start_ns + 830_000_000


def test_heartbeat_ends_when_set_to_zero(desk) -> None:
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x1017, 0, 0, 2)
    desk.run(1000)
    assert desk.take() == []


def test_missing_heartbeat_of_the_manager(operational) -> None:
    desk = operational
    desk.write(0x1016, 1, 0x007F_0064, 4)  # node 127 within 100 ms
    desk.run(500)
    assert desk.node.nmt_state is NmtState.OPERATIONAL  # monitoring starts at the first heartbeat
    desk.frame(0x77F, "05")
    desk.run(99)
    desk.frame(0x77F, "05")
    desk.run(99)
    assert desk.node.nmt_state is NmtState.OPERATIONAL
    desk.take()
    desk.run(1)
    assert desk.take() == [(0x084, "30 81 11 7f 00 00 00 00")]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize(("behaviour", "state"), [(1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)])
def test_error_behaviour(operational, behaviour: int, state: NmtState) -> None:
    desk = operational
    desk.write(0x1029, 1, behaviour, 1)
    desk.write(0x1016, 2, 0x0001_000A, 4)
    desk.frame(0x701, "05")
    desk.run(10)
    assert desk.node.nmt_state is state


def test_heartbeat_goes_on_at_once_with_a_new_time(desk) -> None:
    desk.write(0x1017, 0, 60_000, 2)
    desk.run(1000)
    desk.take()
    start_ns = desk.t_ns
    desk.write(0x1017, 0, 50, 2)
    desk.take()
    desk.run(120)
    assert [t_ns - start_ns for _, _, t_ns in desk.sent] == [0, 50_000_000, 100_000_000]


def test_beats_do_not_drift(desk) -> None:
    desk.write(0x1017, 0, 1, 2)
    start_ns = desk.t_ns
    for beat in range(100_000):
        desk.t_ns = start_ns + beat * 1_000_000 + 700_000  # the timer is always late
        desk.node.on_timer(desk.t_ns)
        desk.sent.clear()
    assert desk.node.next_deadline_ns() == start_ns + 100_000 * 1_000_000


LOST = (0x084, "30 81 11 7f 00 00 00 00")
RESOLVED = (0x084, "00 00 00 30 81 00 00 00")


def monitoring(desk, *node_ids: int) -> None:
    """Each within 100 ms, and none of them can stop the node."""
    desk.write(0x1029, 1, 1, 1)
    for subindex, node_id in enumerate(node_ids, 1):
        desk.write(0x1016, subindex, node_id << 16 | 100, 4)


def test_heartbeat_that_returns(operational) -> None:
    desk = operational
    monitoring(desk, 127)
    desk.frame(0x77F, "05")
    desk.run(5000)
    assert desk.take() == [LOST]  # once
    assert desk.read(0x1001, 0) == 0x11
    assert desk.frame(0x77F, "05") == [RESOLVED]
    assert desk.read(0x1001, 0) == 0
    assert desk.read(0x1003, 0) == 1  # no error is no entry
    desk.run(100)
    assert desk.take() == [LOST]


def test_each_monitored_node_is_told_of(operational) -> None:
    desk = operational
    monitoring(desk, 1, 2, 3, 127)
    for can_id in (0x701, 0x702, 0x703, 0x77F):
        desk.frame(can_id, "05")
    desk.run(50)
    desk.frame(0x702, "7f")
    desk.run(60)
    told = [f"30 81 11 {node_id} 00 00 00 00" for node_id in ("01", "03", "7f")]
    assert [data for _, data in desk.take()] == told
    assert desk.frame(0x701, "04") == [(0x084, "00 00 11 30 81 00 00 00")]  # others are missing still
    desk.frame(0x703, "05")
    assert desk.frame(0x77F, "05") == [RESOLVED]


def test_nobody_is_monitored_before_the_first_heartbeat(operational) -> None:
    desk = operational
    monitoring(desk, 127)
    assert desk.frame(0x77F, "00") == []  # a boot-up promises no heartbeat
    desk.run(5000)
    assert desk.take() == []


def test_monitored_node_that_starts_anew(operational) -> None:
    desk = operational
    monitoring(desk, 127)
    desk.frame(0x77F, "05")
    desk.run(50)
    assert desk.frame(0x77F, "00") == [(0x084, "30 81 11 7f 01 00 00 00"), RESOLVED]
    assert desk.read(0x1001, 0) == 0
    desk.run(99)
    assert desk.take() == []
    desk.run(1)
    assert desk.take() == [LOST]  # it booted, but does not beat any more


@pytest.mark.parametrize(
    ("value", "answer"),
    [
        (0x007F_0064, "80 16 10 02 43 00 04 06"),  # node 127 is in entry 1
        (0x0100_0064, "80 16 10 02 30 00 09 06"),  # reserved bits
        (0x007F_0000, "60 16 10 02 00 00 00 00"),  # no time: not used
        (0x0000_0064, "60 16 10 02 00 00 00 00"),  # no node: not used
        (0x0080_0064, "60 16 10 02 00 00 00 00"),  # no such node: not used
        (0x0001_0064, "60 16 10 02 00 00 00 00"),
    ],
)
def test_entries_of_the_consumer(desk, value: int, answer: str) -> None:
    monitoring(desk, 127)
    assert desk.sdo("23 16 10 02" + value.to_bytes(4, "little").hex()) == answer
    assert desk.read(0x1016, 2) == (value if answer.startswith("60") else 0)


def test_there_are_eight_entries(desk) -> None:
    assert desk.read(0x1016, 0) == 8
    assert desk.sdo("40 16 10 09 00 00 00 00") == "80 16 10 09 11 00 09 06"


def test_all_eight_are_watched(operational) -> None:
    desk = operational
    monitoring(desk, *range(11, 19))
    for node_id in range(11, 19):
        desk.frame(0x700 + node_id, "05")
    desk.run(60)
    for node_id in range(11, 18):
        desk.frame(0x700 + node_id, "05")
    desk.run(60)
    assert desk.take() == [(0x084, "30 81 11 12 00 00 00 00")]


def test_entry_that_is_rewritten_begins_anew_and_the_others_go_on(operational) -> None:
    desk = operational
    monitoring(desk, 1, 2)
    desk.frame(0x701, "05")
    desk.frame(0x702, "05")
    desk.write(0x1016, 2, 0x0002_00C8, 4)
    desk.write(0x1016, 3, 0x0003_00C8, 4)
    desk.run(5000)
    assert desk.take() == [(0x084, "30 81 11 01 00 00 00 00")]


def test_entry_that_is_taken_out_takes_its_error_along(operational) -> None:
    desk = operational
    monitoring(desk, 127)
    desk.frame(0x77F, "05")
    desk.run(100)
    desk.take()
    written = desk.frame(0x604, "23 16 10 01 00 00 00 00")
    assert sorted(written) == sorted([RESOLVED, (0x584, "60 16 10 01 00 00 00 00")])
    assert desk.frame(0x77F, "05") == []


def test_heartbeats_of_a_wrong_length_are_counted_and_keep_nobody_alive(operational) -> None:
    desk = operational
    monitoring(desk, 127)
    desk.frame(0x77F, "05")
    desk.run(60)
    for data in ("", "05 00", "05 00 00 00 00 00 00 00"):
        desk.frame(0x77F, data)
    desk.run(40)
    assert desk.take() == [LOST]
    assert desk.read(0x2040, 4) == 3


def test_a_second_node_with_this_node_id_is_counted(desk) -> None:
    desk.frame(0x704, "00")  # what is told of it is in test_node_lss.py
    assert desk.frame(0x704, "7f") == []
    assert desk.read(0x2040, 7) == 2
