"""Predict when the next scan of a patch will end, so that the receiver can read its frames in one batch.

On a fully loaded bus, successive scans do not always end exactly one period apart. If heartbeats delay the
frames of several nodes, the end of a scan may alternate between two phases of the scan period. The prediction
therefore includes every phase at which a recent scan has ended.
"""

from __future__ import annotations

from collections import deque
from typing import Final

REMEMBERED: Final = 8
"""Number of recent scans on which a prediction is based."""
APART_NS: Final = 1_000_000
"""Maximum difference (ns) between scan ends that count as the same phase of the scan period. Stuff bits and
the SYNC producer's clock shift a scan end by less than this.
"""
MOST: Final = 3
"""Maximum number of predicted end times. If recent scans have ended at more phases, no prediction is made."""


class ArrivalPredictor:
    """Predictor for the end of a patch's next scan. Not thread-safe."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ends: deque[int] = deque(maxlen=REMEMBERED)

    def next_ns(self, t_ns: int) -> tuple[int, ...]:
        """Record the end of a scan, and predict the end of the next one.

        Args:
            t_ns: Monotonic time (ns) at which the scan ended.

        Returns:
            Possible end times of the next scan (monotonic, ns), in ascending order; empty if unpredictable.
        """
        period_ns, ends = self._period_ns, self._ends
        ends.appendleft(t_ns)
        due: list[int] = []
        for end_ns in ends:  # newest first, because the newest end is the best predictor
            due_ns = end_ns + ((t_ns - end_ns + period_ns // 2) // period_ns + 1) * period_ns
            for other_ns in due:
                if -APART_NS < due_ns - other_ns < APART_NS:
                    break
            else:
                due.append(due_ns)
        return tuple(sorted(due)) if len(due) <= MOST else ()
