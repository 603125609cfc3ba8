"""Timers by key, served in order of time without searching all timers."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

from skinnode.node.clock import NO_DEADLINE_NS


class Timers:
    """Heap with one time per key. Setting, moving or removing a time costs O(log n), amortised."""

    def __init__(self) -> None:
        self._due: dict[int, int] = {}
        self._heap: list[tuple[int, int]] = []  # also holds times that were moved or cancelled

    @property
    def deadline_ns(self) -> int:
        """Earliest time, ns; NO_DEADLINE_NS if no time is set."""
        heap, due = self._heap, self._due
        while heap and due.get(heap[0][1]) != heap[0][0]:
            heapq.heappop(heap)
        return heap[0][0] if heap else NO_DEADLINE_NS

    def set(self, key: int, t_ns: int) -> None:
        """Set or replace the time of a key.

        Args:
            key: any number.
            t_ns: time, ns; NO_DEADLINE_NS cancels the time of the key.
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
        """Cancel all times."""
        self._due.clear()
        self._heap.clear()

    def take(self, t_ns: int) -> Iterator[int]:
        """Yield the keys that are due at ``t_ns``, earliest first.

        Each key is removed when it is yielded, so an exception in the caller's loop does not lose any other.
        A key set again to a time that has passed is yielded again.
        """
        while self.deadline_ns <= t_ns:
            _, key = heapq.heappop(self._heap)
            del self._due[key]
            yield key
