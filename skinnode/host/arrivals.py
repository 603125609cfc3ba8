"""When the next scan of a patch should have come, so that the receiver may let other frames gather before.

On a full bus that is not always a period after the last: where heartbeats go before the frames of several
nodes, a scan may end at one of two instants of its period, by turns (12 ms apart at every fifth scan in
``bench pipeline``, and not without heartbeats). So each instant at which one of the last ended is looked at.
"""

from __future__ import annotations

from collections import deque
from typing import Final

REMEMBERED: Final = 8
"""Scans whose ends are remembered."""
APART_NS: Final = 1_000_000
"""Ends nearer to each other than that are one: the bits that a controller stuffs into the frames of a scan,
and the clock of whoever sends SYNC, come to less."""
MOST: Final = 3
"""With more instants than that a scan may come at any time, by all that can be told."""


class ArrivalPredictor:
    """The ends of the scans of a patch, ``period_ns`` from one to the next. Owned by one thread."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ends: deque[int] = deque(maxlen=REMEMBERED)

    def next_ns(self, t_ns: int) -> tuple[int, ...]:
        """After a scan that ended at ``t_ns``: when the next may end, ascending; empty where nobody can
        say."""
        period_ns, ends = self._period_ns, self._ends
        ends.appendleft(t_ns)
        due: list[int] = []
        for end_ns in ends:  # the newest first: it knows best
            due_ns = end_ns + ((t_ns - end_ns + period_ns // 2) // period_ns + 1) * period_ns
            for other_ns in due:
                if -APART_NS < due_ns - other_ns < APART_NS:
                    break
            else:
                due.append(due_ns)
        return tuple(sorted(due)) if len(due) <= MOST else ()
