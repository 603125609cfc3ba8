"""Predict when a patch's next scan will end, so that the receiver can let frames accumulate until then.

On a fully loaded bus, a scan does not always end one period after the previous scan. If heartbeats delay the
frames from several nodes, the end may alternate between two instants within the period. In
``bench pipeline``, every fifth scan ended 12 ms later than the others; without heartbeats, the end did not
alternate. The prediction therefore includes each instant within the period at which one of the most recent
scans ended.
"""

from __future__ import annotations

from collections import deque
from typing import Final

REMEMBERED: Final = 8
"""Number of most recent scan ends used for the prediction."""
APART_NS: Final = 1_000_000
"""Maximum difference between two scan ends that count as the same instant within the period, ns. Stuff bits
and the SYNC producer's clock cause smaller differences."""
MOST: Final = 3
"""Maximum number of predicted instants; if recent scans ended at more instants, no prediction is made."""


class ArrivalPredictor:
    """Predictor of the end of a patch's next scan, given the scan period. Owned by one thread."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ends: deque[int] = deque(maxlen=REMEMBERED)

    def next_ns(self, t_ns: int) -> tuple[int, ...]:
        """Record the end of a scan, and predict when the next scan will end.

        Args:
            t_ns: Monotonic time at which the scan ended, ns.

        Returns:
            Possible monotonic end times in ascending order, ns; empty if no prediction is possible.
        """
        period_ns, ends = self._period_ns, self._ends
        ends.appendleft(t_ns)
        due: list[int] = []
        for end_ns in ends:  # newest first: the newest end is the best predictor
            due_ns = end_ns + ((t_ns - end_ns + period_ns // 2) // period_ns + 1) * period_ns
            for other_ns in due:
                if -APART_NS < due_ns - other_ns < APART_NS:
                    break
            else:
                due.append(due_ns)
        return tuple(sorted(due)) if len(due) <= MOST else ()
