"""Timers against a plain dictionary that is looked through."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.timers import Timers

STEPS = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 50) | st.just(NO_DEADLINE_NS)), max_size=200)


@given(STEPS)
def test_the_earliest_comes_first(steps: list[tuple[int, int]]) -> None:
    timers, plain = Timers(), dict[int, int]()
    for number, (key, t_ns) in enumerate(steps):
        timers.set(key, t_ns)
        plain[key] = t_ns
        assert timers.deadline_ns == min(plain.values())
        if number % 7 == 6:
            now_ns = number
            due = sorted((due_ns, key) for key, due_ns in plain.items() if due_ns <= now_ns)
            assert list(timers.take(now_ns)) == [key for _, key in due]
            plain = {key: due_ns for key, due_ns in plain.items() if due_ns > now_ns} or {0: NO_DEADLINE_NS}
    timers.clear()
    assert timers.deadline_ns == NO_DEADLINE_NS


def test_moving_one_for_ever_takes_no_memory() -> None:
    timers = Timers()
    timers.set(1, 10**12)
    for t_ns in range(100_000):
        timers.set(2, 10**9 + t_ns)
        timers.set(2, 10**9 - t_ns)
    assert len(timers._heap) < 50
    assert timers.deadline_ns == 10**9 - 99_999


def test_one_set_again_while_it_is_taken_is_taken_again() -> None:
    timers = Timers()
    timers.set(1, 5)
    timers.set(2, 7)
    taken = []
    for key in timers.take(10):
        taken.append(key)
        if len(taken) == 1:
            timers.set(1, 6)
    assert taken == [1, 1, 2]
