"""Node guarding and life guarding (CiA 301 v4.2, 7.2.8.3.2.1; objects 0x100C, 0x100D), frames by hand."""

from __future__ import annotations

import pytest

from skinnode.errors import BusError
from skinnode.node import NmtState

LOST = (0x084, "30 81 11 00 00 00 00 00")
RESOLVED = (0x084, "00 00 00 30 81 00 00 00")


def ask(desk) -> list[tuple[int, str]]:
    return desk.frame(0x704, remote=True)


def guarded(desk, guard_ms: int = 100, factor: int = 3) -> None:
    desk.write(0x100C, 0, guard_ms, 2)
    desk.write(0x100D, 0, factor, 1)


def test_answers_toggle_and_name_the_state(desk) -> None:
    """A node without guard time or life time factor answers too."""
    assert [ask(desk) for _ in range(3)] == [[(0x704, "7f")], [(0x704, "ff")], [(0x704, "7f")]]
    desk.start()
    assert ask(desk) == [(0x704, "85")]
    desk.frame(0, "02 00")
    assert [ask(desk) for _ in range(2)] == [[(0x704, "04")], [(0x704, "84")]]
    desk.run(100_000)
    assert desk.take() == []


@pytest.mark.parametrize("reset", ["82 04", "81 00"])
def test_reset_communication_resets_the_toggle_bit(desk, reset: str) -> None:
    ask(desk)
    desk.frame(0, reset)
    assert ask(desk) == [(0x704, "7f")]


def test_no_other_transition_resets_the_toggle_bit(desk) -> None:
    ask(desk)
    for command in ("01 00", "80 00", "02 00", "80 00"):
        desk.frame(0, command)
    assert ask(desk) == [(0x704, "ff")]


def test_other_remote_frames_are_nobodys_business(desk) -> None:
    for can_id in (0x703, 0x705, 0x700, 0x604, 0x584, 0x084, 0x080, 0x000, 0x100):
        assert desk.frame(can_id, remote=True) == []


def test_master_that_stops_asking(operational) -> None:
    desk = operational
    guarded(desk)
    desk.run(1000)
    assert desk.take() == []  # life guarding starts with the first request
    ask(desk)
    desk.run(299)
    ask(desk)
    desk.run(299)
    assert desk.take() == []
    desk.run(1)
    assert desk.take() == [LOST]
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
    assert desk.read(0x1001, 0) == 0x11
    assert desk.read(0x1003, 1) == 0x8130
    desk.run(10_000)
    assert desk.take() == []  # told once


def test_master_that_asks_again(operational) -> None:
    desk = operational
    guarded(desk)
    ask(desk)
    desk.run(300)
    desk.take()
    assert sorted(ask(desk)) == sorted([RESOLVED, (0x704, "ff")])
    assert desk.read(0x1001, 0) == 0
    desk.run(300)
    assert desk.take() == [LOST]


@pytest.mark.parametrize(
    ("behaviour", "state"),
    [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)],
)
def test_error_behaviour(operational, behaviour: int, state: NmtState) -> None:
    desk = operational
    desk.write(0x1029, 1, behaviour, 1)
    guarded(desk)
    ask(desk)
    desk.run(300)
    assert LOST in desk.take()
    assert desk.node.nmt_state is state


def test_error_behaviour_does_not_wait_for_a_bus_that_refuses_the_emergency(operational) -> None:
    desk = operational
    guarded(desk)
    ask(desk)
    desk.bus_refuses = True
    with pytest.raises(BusError):
        desk.run(301)
    assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
    desk.bus_refuses = False
    desk.run(1)
    assert desk.take() == [LOST]


@pytest.mark.parametrize(("guard_ms", "factor"), [(0, 3), (100, 0)])
def test_no_life_time_without_both_factors(operational, guard_ms: int, factor: int) -> None:
    desk = operational
    guarded(desk, guard_ms, factor)
    assert ask(desk) == [(0x704, "05")]
    desk.run(100_000)
    assert desk.take() == []


def test_life_time_changed_on_the_way_counts_from_then(operational) -> None:
    desk = operational
    guarded(desk, 1000, 3)
    ask(desk)
    desk.run(500)
    desk.write(0x100C, 0, 10, 2)
    desk.run(29)
    assert desk.take() == []
    desk.run(1)
    assert desk.take() == [LOST]


def test_guarding_switched_off_ends_its_error(operational) -> None:
    desk = operational
    guarded(desk)
    ask(desk)
    desk.run(300)
    desk.take()
    written = desk.frame(0x604, "2f 0d 10 00 00 00 00 00")
    assert sorted(written) == sorted([RESOLVED, (0x584, "60 0d 10 00 00 00 00 00")])


def test_heartbeat_takes_the_place_of_guarding(operational) -> None:
    desk = operational
    guarded(desk)
    ask(desk)
    desk.write(0x1017, 0, 200, 2)
    desk.run(0)
    assert desk.take() == [(0x704, "05")]
    assert ask(desk) == []
    desk.run(900)
    assert desk.take() == [(0x704, "05")] * 4  # no life guarding event
    desk.write(0x1017, 0, 0, 2)
    desk.run(900)
    assert desk.take() == []
    assert ask(desk) == [(0x704, "85")]
    desk.run(300)
    assert desk.take() == [LOST]


def test_reset_ends_life_guarding(operational) -> None:
    desk = operational
    guarded(desk)
    ask(desk)
    desk.frame(0, "82 00")
    guarded(desk)
    desk.run(1000)
    assert desk.take() == []
