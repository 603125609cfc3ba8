"""Predict when the next scan of a patch ends, so that the receiver may let other frames gather before.

On a full bus that is not always one period after the last: where heartbeats precede the frames of several
nodes, a scan may alternate between two instants of its period (12 ms apart at every fifth scan in ``bench
pipeline``; not without heartbeats). So the prediction covers each instant at which one of the last scans
ended.
"""

from __future__ import annotations

from collections import deque
from typing import Final

REMEMBERED: Final = 8
"""Number of scan ends remembered."""
APART_NS: Final = 1_000_000
"""Time within which two ends count as the same instant: stuffed bits and the clock of the SYNC producer vary
by less."""
MOST: Final = 3
"""Maximum number of instants predicted; with more, a scan may come at any time."""


class ArrivalPredictor:
    """Predicts from the ends of the last scans of a patch, ``period_ns`` apart. Owned by one thread."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ends: deque[int] = deque(maxlen=REMEMBERED)

    def next_ns(self, t_ns: int) -> tuple[int, ...]:
        """Note the end of a scan and predict the end of the next.

        Args:
            t_ns: Monotonic time at which the scan ended.

        Returns:
            Monotonic times in ascending order, one of which should apply; empty if none can be predicted.
        """
        period_ns, ends = self._period_ns, self._ends
        ends.appendleft(t_ns)
        due: list[int] = []
        for end_ns in ends:  # the newest first: it is the best predictor
            due_ns = end_ns + ((t_ns - end_ns + period_ns // 2) // period_ns + 1) * period_ns
            for other_ns in due:
                if -APART_NS < due_ns - other_ns < APART_NS:
                    break
            else:
                due.append(due_ns)
        return tuple(sorted(due)) if len(due) <= MOST else ()
