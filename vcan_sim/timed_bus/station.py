"""Stations of a simulated bus, and the transmission attempt in progress.

Only :mod:`vcan_sim.timed_bus.bus` changes this state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from skinnode.errors import ConfigError
from vcan_sim.timed_bus.attempt import Course
from vcan_sim.timed_bus.confinement import ZERO, ErrorState
from vcan_sim.timed_bus.transmit_queue import FifoQueue, PriorityQueue, TransmitQueue, Waiting


@dataclass(frozen=True, slots=True)
class StationOptions:
    """Options of a station's CAN controller.

    Raises:
        ConfigError: If an option is not valid.
    """

    queue: Literal["fifo", "priority"] = "fifo"
    """Transmission order: ``fifo`` is first in, first out, as in SocketCAN; ``priority`` is highest priority
    first."""
    capacity: int | None = None
    """Maximum number of queued frames, including the frame in transmission; None for no limit."""
    restart_ns: int | None = 0
    """Delay from bus-off to the start of recovery, in ns; None to wait for a call to
    :meth:`vcan_sim.timed_bus.bus.TimedBus.restart`."""

    def __post_init__(self) -> None:
        if self.queue not in ("fifo", "priority"):
            raise ConfigError("queue", self.queue, "fifo or priority")
        if self.capacity is not None and self.capacity < 1:
            raise ConfigError("capacity", self.capacity, "at least 1 frame, or None")
        if self.restart_ns is not None and self.restart_ns < 0:
            raise ConfigError("restart_ns", self.restart_ns, "at least 0 ns, or None")


class Station:
    """State of a station on a simulated bus."""

    __slots__ = (
        "connected",
        "counters",
        "index",
        "options",
        "passive",
        "queue",
        "ready",
        "recovers_from",
        "runs_seen",
        "sending",
    )

    def __init__(self, index: int, options: StationOptions) -> None:
        self.index = index
        self.options = options
        self.queue: TransmitQueue = FifoQueue() if options.queue == "fifo" else PriorityQueue()
        self.sending: Waiting | None = None
        self.counters = ZERO
        self.passive = False
        self.connected = True
        self.ready = 0
        """Earliest start of the next frame, ticks."""
        self.recovers_from: int | None = None
        """Start of the recovery from bus-off, ticks; None if the station is not recovering."""
        self.runs_seen = 0
        """Number of complete recessive runs between the start of the recovery and the last start of frame."""

    @property
    def on_bus(self) -> bool:
        """Whether the station is connected and not in the bus-off state."""
        return self.connected and self.counters.state is not ErrorState.BUS_OFF


class Flight:
    """Transmission attempt in progress."""

    __slots__ = ("course", "receivers", "senders", "side", "start", "waiting")

    def __init__(
        self,
        start: int,
        course: Course,
        waiting: dict[int, Waiting],
        senders: tuple[int, ...],
        receivers: tuple[int, ...],
    ) -> None:
        self.start = start
        self.course = course
        self.waiting = waiting
        """Frames in transmission, by station."""
        self.senders = senders
        """Stations that were sending at the start of frame."""
        self.receivers = receivers
        """Stations that were on the bus at the start of frame and were not sending."""
        self.side = 0
        """Number of ``course.side_errors`` that have occurred so far."""

    @property
    def next(self) -> int:
        """Time of the next event of the attempt, ticks."""
        course = self.course
        if not course.side_errors:
            return self.start + course.end
        side = course.side_errors
        return self.start + (side[self.side].ticks if self.side < len(side) else course.end)
