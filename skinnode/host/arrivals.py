"""Predict when a patch's next scan will end, so that the receiver can let frames accumulate until then.

On a fully loaded bus, a scan does not always end one period after the previous scan. If heartbeats delay the
frames from several nodes, scans may end alternately at two phases of the scan period. The prediction
therefore covers every phase of the period at which a recent scan has ended.
"""

from __future__ import annotations

from collections import deque
from typing import Final

REMEMBERED: Final = 8
"""Number of recent scans whose end times are used to predict the end of the next scan."""
APART_NS: Final = 1_000_000
"""Maximum difference (ns) between two scan ends that are treated as the same phase of the scan period.
Stuff bits and the SYNC producer's clock shift a scan's end by less than this value.
"""
MOST: Final = 3
"""Maximum number of predicted end times; if recent scans ended at more phases of the period, no prediction is
made.
"""


class ArrivalPredictor:
    """Predictor of the time at which a patch's next scan will end. Not thread-safe."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ends: deque[int] = deque(maxlen=REMEMBERED)

    def next_ns(self, t_ns: int) -> tuple[int, ...]:
        """Record the end of a scan, and predict when the next scan will end.

        Args:
            t_ns: Monotonic time at which the scan ended, ns.

        Returns:
            Possible end times of the next scan (monotonic, ns, ascending); empty if unpredictable.
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
