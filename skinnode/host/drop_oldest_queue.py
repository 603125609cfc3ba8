"""Provide a bounded queue that never blocks the writer: a full queue drops its oldest items.

The standard library has no such queue. A full ``queue.Queue`` blocks or rejects the new item.
``collections.deque(maxlen=…)`` does not count the items it drops, and does not let a reader wait for an item.
"""

from __future__ import annotations

import queue
from dataclasses import dataclass
from typing import Generic, TypeVar

from skinnode.errors import SkinError
from skinnode.process import clock

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class End:
    """End marker of a queue; contains the error that stopped the host, if any."""

    error: SkinError | None = None


class DropOldestQueue(Generic[T]):
    """Queue of at most ``capacity`` items, terminated by an :class:`End`. Thread-safe. Writing never blocks.

    The end marker is never dropped. :meth:`get` does not remove it, so every reader gets it.
    """

    def __init__(self, capacity: int) -> None:
        self._items: queue.SimpleQueue[T | End] = clock.simple_queue()
        self._capacity = capacity

    def put(self, item: T | End) -> int:
        """Append an item. If this exceeds the capacity, drop the oldest items.

        Returns:
            Number of items dropped.
        """
        self._items.put(item)
        dropped, end = 0, None
        while self._items.qsize() > self._capacity:
            try:
                oldest = self._items.get_nowait()
            except queue.Empty:  # another thread has emptied the queue
                break
            if isinstance(oldest, End):
                end = oldest
            else:
                dropped += 1
        if end is not None:  # the queue may exceed its capacity by this one item
            self._items.put(end)
        return dropped

    def get(self, timeout_s: float | None = None) -> T | End:
        """Remove and return the oldest item. An end marker is returned but not removed.

        Args:
            timeout_s: Time limit (s); None for no limit, 0 to return immediately.

        Raises:
            queue.Empty: if no item arrives in time.
        """
        item = self._items.get(timeout=timeout_s)
        if isinstance(item, End):
            self.put(item)
        return item
