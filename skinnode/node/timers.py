"""Which of many things is due next, without looking at all of them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

from skinnode.node.clock import NO_DEADLINE_NS


class Timers:
    """One time for each of any number of keys. Setting, moving and taking cost O(log n), amortised."""

    def __init__(self) -> None:
        self._due: dict[int, int] = {}
        self._heap: list[tuple[int, int]] = []  # times that were moved or cancelled are still in it

    @property
    def deadline_ns(self) -> int:
        """The earliest time; NO_DEADLINE_NS if there is none."""
        heap, due = self._heap, self._due
        while heap and due.get(heap[0][1]) != heap[0][0]:
            heapq.heappop(heap)
        return heap[0][0] if heap else NO_DEADLINE_NS

    def set(self, key: int, t_ns: int) -> None:
        """Remind of ``key`` at ``t_ns``, and at no other time; NO_DEADLINE_NS: not at all."""
        if t_ns == NO_DEADLINE_NS:
            self._due.pop(key, None)
        elif self._due.get(key) != t_ns:
            self._due[key] = t_ns
            heapq.heappush(self._heap, (t_ns, key))
            if len(self._heap) > 2 * len(self._due) + 16:
                self._heap = [(due_ns, each) for each, due_ns in self._due.items()]
                heapq.heapify(self._heap)

    def clear(self) -> None:
        """Nothing is due any more."""
        self._due.clear()
        self._heap.clear()

    def take(self, t_ns: int) -> Iterator[int]:
        """The keys that are due at ``t_ns``, the earliest first. Each is taken as it is yielded, so that what
        raises in between loses nothing; one set again to a time that has come is yielded again."""
        while self.deadline_ns <= t_ns:
            _, key = heapq.heappop(self._heap)
            del self._due[key]
            yield key
