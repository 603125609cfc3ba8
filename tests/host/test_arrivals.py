"""When the next scan is looked for."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinnode.config import HandConfig
from skinnode.host.arrivals import APART_NS, MOST, REMEMBERED, ArrivalPredictor
from skinnode.host.dispatcher import Dispatcher
from skinnode.host.patch_stream import StreamOutput
from skinnode.host.publish import Publisher
from skinnode.host.reception import receive_patch
from skinnode.host.sync import Ticks
from skinnode.host.workers import Inline

PERIOD_NS = 50_000_000


def after(ends_ns: Iterable[int]) -> tuple[int, ...]:
    """What is expected after scans that ended then."""
    arrivals = ArrivalPredictor(PERIOD_NS)
    due: tuple[int, ...] = ()
    for t_ns in ends_ns:
        due = arrivals.next_ns(t_ns)
    return due


def test_a_steady_stream_goes_on() -> None:
    assert after([7]) == (7 + PERIOD_NS,)
    assert after(n * PERIOD_NS + n % 3 * 100_000 for n in range(20)) == (20 * PERIOD_NS + 100_000,)


def test_a_scan_that_is_late_every_fifth_time_is_looked_for_at_both() -> None:
    """Twelve milliseconds, as where the frames of four nodes meet."""
    late = [n * PERIOD_NS + (12_000_000 if n % 5 else 0) for n in range(20)]
    for count in range(6, 20):
        assert after(late[:count]) == (count * PERIOD_NS, count * PERIOD_NS + 12_000_000)


def test_it_follows_a_stream_that_was_shifted_and_forgets_what_was() -> None:
    ends = [n * PERIOD_NS for n in range(10)] + [n * PERIOD_NS + 20_000_000 for n in range(10, 30)]
    assert len(after(ends[:11])) == 2
    assert after(ends[: 10 + REMEMBERED]) == ((10 + REMEMBERED) * PERIOD_NS + 20_000_000,)


def test_scans_that_were_missed_do_not_matter() -> None:
    assert after(n * PERIOD_NS for n in (0, 1, 2, 7, 9, 300)) == (301 * PERIOD_NS,)


def test_where_a_scan_comes_at_any_time_nobody_can_say() -> None:
    assert after(n * PERIOD_NS + n * n % 7 * 6_000_000 for n in range(20)) == ()


@given(st.lists(st.integers(0, 200_000_000), min_size=1, max_size=30), st.integers(1_000_000, PERIOD_NS))
def test_what_is_expected_lies_ahead_and_apart(steps_ns: list[int], period_ns: int) -> None:
    arrivals, t_ns = ArrivalPredictor(period_ns), 0
    for step_ns in steps_ns:
        t_ns += step_ns
        due = arrivals.next_ns(t_ns)
        assert len(due) <= MOST
        assert all(t_ns + period_ns // 2 - 1 <= due_ns <= t_ns + period_ns * 3 // 2 + 1 for due_ns in due)
        assert all(later - earlier >= APART_NS for earlier, later in itertools.pairwise(due))


@pytest.mark.parametrize("hiccup_ns", [2_000_000, 20_000_000])
def test_after_a_hiccup_the_next_is_looked_for_in_time(hiccup_ns: int) -> None:
    due = after([n * PERIOD_NS for n in range(10)] + [10 * PERIOD_NS + hiccup_ns])
    assert due == (11 * PERIOD_NS, 11 * PERIOD_NS + hiccup_ns)


class Told(Dispatcher):
    """Remembers what was expected."""

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        self.expected = {**getattr(self, "expected", {}), what: times_ns}


def test_the_first_scan_of_a_patch_may_come_at_any_time(hand: HandConfig) -> None:
    """However well those of the others are known."""
    dispatcher = Told(hand.buses[0], {}, 0)
    names = [patch.name for patch in hand.patches]
    output = StreamOutput(Inline(), Publisher(tuple(names)))
    for patch in hand.patches:
        receive_patch(patch, hand, dispatcher, Ticks(240), output)
    assert dispatcher.expected == dict.fromkeys(names, ())
