"""Timers of a service, one per key."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

from skinnode.node.pacing import NO_DEADLINE_NS


class Timers:
    """Set of timers, one per key. Operations take amortised O(log n) time."""

    def __init__(self) -> None:
        self._due: dict[int, int] = {}
        self._heap: list[tuple[int, int]] = []  # may contain entries for changed or cancelled timers

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which the earliest timer is due; NO_DEADLINE_NS if no timer is set."""
        heap, due = self._heap, self._due
        while heap and due.get(heap[0][1]) != heap[0][0]:
            heapq.heappop(heap)
        return heap[0][0] if heap else NO_DEADLINE_NS

    def set(self, key: int, t_ns: int) -> None:
        """Set, change or cancel a timer.

        Args:
            key: Number of the timer.
            t_ns: Time at which the timer is due, in ns; NO_DEADLINE_NS to cancel it.
        """
        if t_ns == NO_DEADLINE_NS:
            self._due.pop(key, None)
        elif self._due.get(key) != t_ns:
            self._due[key] = t_ns
            heapq.heappush(self._heap, (t_ns, key))
            if len(self._heap) > 2 * len(self._due) + 16:
                self._heap = [(due_ns, each) for each, due_ns in self._due.items()]
                heapq.heapify(self._heap)

    def clear(self) -> None:
        """Cancel all timers."""
        self._due.clear()
        self._heap.clear()

    def take(self, t_ns: int) -> Iterator[int]:
        """Yield the keys of the timers that are due at ``t_ns``, earliest first.

        Each timer is removed just before its key is yielded, so the remaining timers survive an exception in
        the caller's loop. If the caller sets a timer to ``t_ns`` or earlier, its key is yielded again.
        """
        while self.deadline_ns <= t_ns:
            _, key = heapq.heappop(self._heap)
            del self._due[key]
            yield key
