"""Provide a bounded queue that drops its oldest items if the reader is slow, so that the writer never waits.

The standard library has no such queue: a full ``queue.Queue`` blocks or rejects a new item;
``collections.deque(maxlen=…)`` drops items without counting them, and its reader cannot wait for an item.
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
    """End marker, appended to a queue when the host closes or is stopped by ``error``."""

    error: SkinError | None = None


class DropOldestQueue(Generic[T]):
    """Queue of up to ``capacity`` items; the end of the stream is marked by an :class:`End`.

    Thread-safe; writing never blocks.

    The end marker is never dropped, and every reader receives the marker because :meth:`get` does not remove
    it.
    """

    def __init__(self, capacity: int) -> None:
        self._items: queue.SimpleQueue[T | End] = clock.simple_queue()
        self._capacity = capacity

    def put(self, item: T | End) -> int:
        """Append an item to the queue, and drop the oldest items if the capacity is exceeded.

        Returns:
            Number of items dropped.
        """
        self._items.put(item)
        dropped, end = 0, None
        while self._items.qsize() > self._capacity:
            try:
                oldest = self._items.get_nowait()
            except queue.Empty:  # another thread has already removed the oldest item
                break
            if isinstance(oldest, End):
                end = oldest
            else:
                dropped += 1
        if end is not None:  # the queue may temporarily exceed its capacity by one item
            self._items.put(end)
        return dropped

    def get(self, timeout_s: float | None = None) -> T | End:
        """Remove and return the oldest item; an end marker is returned but not removed.

        Args:
            timeout_s: Maximum time (s) to wait for an item; None for no limit, 0 to return immediately.

        Raises:
            queue.Empty: if no item arrived before the timeout.
        """
        item = self._items.get(timeout=timeout_s)
        if isinstance(item, End):
            self.put(item)
        return item
