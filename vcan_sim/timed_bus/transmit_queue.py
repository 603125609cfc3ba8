"""Transmit queues for the stations of a simulated bus."""

from __future__ import annotations

import heapq
from collections import deque
from typing import NamedTuple, Protocol

from vcan_sim.timed_bus.frame import CanFrame


class Waiting(NamedTuple):
    """Frame in a transmit queue. Instances sort by priority, then by age."""

    key: int
    """Arbitration key from :func:`vcan_sim.timed_bus.frame.arbitration_key`."""
    number: int
    """Sequence number among all frames queued on the bus."""
    queued_ns: int
    frame: CanFrame


class TransmitQueue(Protocol):
    """Transmit queue of one station, excluding the frame in transmission."""

    def push(self, waiting: Waiting) -> None:
        """Add a frame to the queue."""

    def put_back(self, waiting: Waiting) -> None:
        """Put back a frame that was removed by :meth:`pop` but not sent."""

    def head(self) -> Waiting:
        """Return the frame to send next. The queue must not be empty."""

    def pop(self) -> Waiting:
        """Remove and return the frame to send next. The queue must not be empty."""

    def clear(self) -> None:
        """Remove all frames from the queue."""

    def __len__(self) -> int: ...


class FifoQueue:
    """First-in, first-out transmit queue, as in SocketCAN."""

    def __init__(self) -> None:
        self._frames: deque[Waiting] = deque()

    def push(self, waiting: Waiting) -> None:
        """Add a frame to the queue."""
        self._frames.append(waiting)

    def put_back(self, waiting: Waiting) -> None:
        """Put back a frame that was removed by :meth:`pop` but not sent."""
        self._frames.appendleft(waiting)

    def head(self) -> Waiting:
        """Return the oldest frame."""
        return self._frames[0]

    def pop(self) -> Waiting:
        """Remove and return the oldest frame."""
        return self._frames.popleft()

    def clear(self) -> None:
        """Remove all frames from the queue."""
        self._frames.clear()

    def __len__(self) -> int:
        return len(self._frames)


class PriorityQueue:
    """Transmit queue ordered by priority. Frames of equal priority are sent in order of arrival."""

    def __init__(self) -> None:
        self._frames: list[Waiting] = []

    def push(self, waiting: Waiting) -> None:
        """Add a frame to the queue."""
        heapq.heappush(self._frames, waiting)

    put_back = push

    def head(self) -> Waiting:
        """Return the frame with the highest priority."""
        return self._frames[0]

    def pop(self) -> Waiting:
        """Remove and return the frame with the highest priority."""
        return heapq.heappop(self._frames)

    def clear(self) -> None:
        """Remove all frames from the queue."""
        self._frames.clear()

    def __len__(self) -> int:
        return len(self._frames)
