"""Response times against the example of Davis et al. (2007) and against a bus played frame by frame."""

from __future__ import annotations

import heapq
from collections.abc import Iterable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skinnode.bus_load.response import Message, response_time_ns

BIT = 1


def response(messages: list[Message], number: int, bit_ns: int = BIT) -> int | None:
    others = [each for each in messages if each is not messages[number]]
    return response_time_ns(messages[number], others, bit_ns)


def test_the_paper_s_own_example() -> None:
    # Section 3.2: A, B, C of 1 ms at 125 kbit/s every 2.5, 3.5 and 3.5 ms. The first instance of C passes
    # within 3 ms; the second of the same busy period takes 3.5, which the older analysis does not see.
    ms = 1_000_000
    messages = [Message(1, ms, 2_500_000), Message(2, ms, 3_500_000), Message(3, ms, 3_500_000)]
    assert [response(messages, i, bit_ns=8_000) for i in range(3)] == [2 * ms, 3 * ms, 3_500_000]


def test_more_than_the_bus_has_no_bound() -> None:
    messages = [Message(1, 6, 10), Message(2, 4, 10), Message(3, 1, 1000)]
    assert response(messages, 0) == 10  # a frame of 4 on the bus, then its own 6
    assert response(messages, 1) is None
    assert response(messages, 2) is None


def test_burst_is_no_more_than_its_frames() -> None:
    # Ten frames of 3 every 5, then silence until 1000. A frame of 4 goes after the first of them, though it
    # does not fit before the second: what is on the bus is not interrupted.
    burst, late = Message(1, 3, 1000, count=10, spacing_ns=5), Message(2, 4, 1000)
    assert response([burst, late], 1) == 3 + 4
    dense = Message(1, 3, 1000, count=10, spacing_ns=3)
    assert response([dense, late], 1) == 10 * 3 + 4
    at_once = Message(1, 3, 1000, count=10)
    assert response([at_once, late], 1) == 10 * 3 + 4


@st.composite
def messages_on_a_bus(draw: st.DrawFn, jitter: int) -> list[Message]:
    messages = []
    for can_id in range(draw(st.integers(2, 5))):
        count, spacing = draw(st.integers(1, 4)), draw(st.integers(0, 12))
        least = max(8, count * spacing)
        messages.append(
            Message(
                can_id,
                draw(st.integers(1, 7)),
                draw(st.integers(least, least + 60)),
                count,
                spacing,
                draw(st.integers(0, jitter)),
            )
        )
    return messages


def play(queued: Iterable[tuple[int, int, int, int]], start: int = 0) -> list[tuple[int, int]]:
    """A bus of (queued at, priority, time, due at): (priority, time from due to passed) of each. Whatever is
    queued when an arbitration begins takes part in it."""
    coming = sorted(queued)
    waiting: list[tuple[int, int, int, int]] = []
    now, at, passed = start, 0, []
    while at < len(coming) or waiting:
        if not waiting:
            now = max(now, coming[at][0])
        while at < len(coming) and coming[at][0] <= now:
            when, priority, time, due = coming[at]
            heapq.heappush(waiting, (priority, when, time, due))
            at += 1
        priority, _, time, due = heapq.heappop(waiting)
        now += time
        passed.append((priority, now - due))
    return passed


def falls_silent(queued: Iterable[tuple[int, int, int, int]], start: int) -> bool:
    """Whether the bus is idle before the last of these frames is queued."""
    now = start
    for at, _, time, _ in sorted(queued):
        if at > now:
            return True
        now += time
    return False


ALMOST_FULL = [
    Message(0, 4, 57, count=4, spacing_ns=8),
    Message(1, 4, 26),
    Message(2, 3, 46),
    Message(3, 2, 12, count=3),
]


@pytest.mark.long
@settings(deadline=None, max_examples=200)
@example(ALMOST_FULL, 3)
@given(messages_on_a_bus(jitter=0), st.integers(0, 4))
def test_the_worst_case_happens(messages: list[Message], number: int) -> None:
    """Without jitter the bound is the time that a frame takes when all of higher priority begin with it, just
    after the longest of lower priority has."""
    number %= len(messages)
    bound = response(messages, number)
    if bound is None:
        return
    blocking, window = max((each.time_ns for each in messages[number + 1 :]), default=0), 200
    queued = []
    while not falls_silent(queued, blocking):  # the worst frame passes before the bus is first idle
        window *= 2
        queued = [
            (each.due_ns(i), each.can_id, each.time_ns, each.due_ns(i))
            for each in messages[: number + 1]
            for i in range(each.most_in(window))
        ]
    seen = [time for priority, time in play(queued, start=blocking) if priority == number]
    assert max(seen) == bound


def nothing_is_worse(messages: list[Message], data: st.DataObject) -> None:
    bounds = [response(messages, i) for i in range(len(messages))]
    queued = []
    for each in messages:
        offset, newest = data.draw(st.integers(0, each.period_ns)), 0
        for i in range(each.count * 12):
            due = offset + each.due_ns(i)
            late = data.draw(st.integers(0, each.jitter_ns)) if each.jitter_ns else 0
            newest = max(newest, due + late)  # a sender queues its frames in order
            queued.append((newest, each.can_id, each.time_ns, due))
    for priority, time in play(queued):
        bound = bounds[priority]
        assert bound is None or time <= bound


@pytest.mark.parametrize("examples", [40, pytest.param(200, marks=pytest.mark.long)])
def test_nothing_is_worse(examples: int) -> None:
    check = given(messages_on_a_bus(jitter=15), st.data())(nothing_is_worse)
    settings(deadline=None, max_examples=examples)(check)()


@pytest.mark.long
@settings(deadline=None)
@given(messages_on_a_bus(jitter=0), st.data())
def test_most_in_a_window_is_counted(messages: list[Message], data: st.DataObject) -> None:
    message, window = messages[0], data.draw(st.integers(1, 300))
    due = [message.due_ns(i) for i in range(message.count * 80)]
    for start in range(2 * message.period_ns):
        assert sum(start <= each < start + window for each in due) <= message.most_in(window)
    assert sum(each < window for each in due) == message.most_in(window)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"time_ns": 0, "period_ns": 5}, "time_ns: got 0, must be at least 1"),
        ({"time_ns": 1, "period_ns": 5, "count": 3, "spacing_ns": 2}, "spacing_ns: got 3 frames 2 ns apart"),
    ],
)
def test_what_is_no_message(arguments: dict[str, int], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        Message(1, **arguments)
