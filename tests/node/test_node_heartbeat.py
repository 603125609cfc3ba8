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
