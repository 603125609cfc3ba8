"""Busy intervals of a bus, from which the bus load is computed."""

from __future__ import annotations

import bisect
from array import array


class Occupancy:
    """Record of the busy intervals of a bus.

    Adjacent intervals are merged, so a saturated bus needs a single entry of 24 bytes. In long runs,
    :meth:`forget` limits memory use.
    """

    def __init__(self) -> None:
        self._starts = array("q")
        self._ends = array("q")
        self._busy_before = array("q")

    def add(self, start_ns: int, end_ns: int) -> None:
        """Add a busy interval. It must not start before the end of the last interval.

        Args:
            start_ns: Start of the interval, in ns.
            end_ns: End of the interval, in ns.
        """
        ends = self._ends
        if ends and ends[-1] == start_ns:
            ends[-1] = end_ns
            return
        before = self._busy_before[-1] + ends[-1] - self._starts[-1] if ends else 0
        self._starts.append(start_ns)
        ends.append(end_ns)
        self._busy_before.append(before)

    def end_last_at(self, end_ns: int) -> None:
        """Move the end of the last busy interval to ``end_ns``."""
        self._ends[-1] = end_ns

    def busy_ns(self, from_ns: int, to_ns: int) -> int:
        """Return the busy time (ns) between two times."""
        return self._busy_until(to_ns) - self._busy_until(from_ns)

    def forget(self, before_ns: int) -> None:
        """Discard the intervals that ended before ``before_ns``. Later queries must not go further back."""
        n = bisect.bisect_left(self._ends, before_ns)
        for column in (self._starts, self._ends, self._busy_before):
            del column[:n]

    def _busy_until(self, time_ns: int) -> int:
        at = bisect.bisect_right(self._starts, time_ns) - 1
        if at < 0:
            return self._busy_before[0] if self._busy_before else 0
        return self._busy_before[at] + min(time_ns, self._ends[at]) - self._starts[at]
