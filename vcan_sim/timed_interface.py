"""python-can interface ``timed``: endpoints of a simulated CAN bus in virtual time.

Endpoints with the same channel and the same virtual clock are stations on one
:class:`~vcan_sim.timed_bus.TimedBus`. Any python-can program can open such an endpoint.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Final, cast

import can

from skinnode.process import clock as process_clock
from skinnode.transport import Frame
from vcan_sim.timed_bus import (
    BitRates,
    CanFrame,
    Delivered,
    Disturbance,
    Event,
    StationOptions,
    TimedBus,
)
from vcan_sim.virtual_time import Mailbox, VirtualClock

COALESCED_NS: Final = 1_000_000
"""Minimum interval between wake-ups of a thread that reads frames, in ns."""
MOST_STATIONS: Final = 64
"""Maximum number of endpoints that can be open on a bus at the same time."""


class Inbox:
    """Receive queue of a station.

    The first frame after a pause wakes the reader immediately. Frames that arrive within the next
    :data:`COALESCED_NS` wake it once, at the end of that interval, as with interrupt coalescing in CAN
    controllers. The timestamps of the frames are not affected.

    Args:
        clock: Virtual clock of the reader.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self._queue = clock, Mailbox(clock)
        self._quiet_until_ns, self._due = 0, False
        self.on_arrival: Callable[[], object] = lambda: None
        """Function called when the reader is woken."""

    @property
    def quiet_until_ns(self) -> int:
        """Time (ns) before which new frames do not wake the reader."""
        return self._quiet_until_ns

    def put(self, delivered: Delivered) -> None:
        """Append a frame, and wake the reader immediately or at :attr:`quiet_until_ns`."""
        self._queue.store(delivered)
        if self._due:
            return
        if self._clock.now_ns >= self._quiet_until_ns:
            self._wake()
        else:
            self._due = True
            self._clock.call_at(self._quiet_until_ns, self._wake)

    def get(self, timeout_s: float | None) -> Delivered:
        """Return the next frame. Raises :class:`queue.Empty` if no frame arrives within the time-out."""
        return cast(Delivered, self._queue.get(timeout=timeout_s))

    def get_all(self, timeout_s: float, most: int) -> list[Delivered]:
        """Return up to ``most`` frames, after waiting up to ``timeout_s`` for the first one."""
        try:
            frames = [self.get(timeout_s)]
        except queue.Empty:
            return []
        waiting = self._queue.queue
        frames += [waiting.popleft() for _ in range(min(len(waiting), most - 1))]
        return frames

    def hold_until(self, t_ns: int) -> None:
        """Do not wake the reader before ``t_ns``."""
        self._quiet_until_ns = max(self._quiet_until_ns, t_ns)

    def _wake(self) -> None:
        self._due, self._quiet_until_ns = False, self._clock.now_ns + COALESCED_NS
        self._queue.wake()
        self.on_arrival()


class Segment:
    """Simulated bus in virtual time, and its endpoints.

    Args:
        channel: Name of the bus.
        clock: Virtual clock of the bus.
        rates: Bit rates of the bus.

    Attributes:
        listeners: Functions called with each event on the bus.
    """

    def __init__(self, channel: str, clock: VirtualClock, rates: BitRates) -> None:
        self.channel, self.clock, self.rates = channel, clock, rates
        self.bus = TimedBus([StationOptions()] * MOST_STATIONS, rates)
        now_ns = clock.now_ns
        for station in range(MOST_STATIONS):
            self.bus.disconnect(now_ns, station)
        self.listeners: list[Callable[[Event], None]] = []
        self._inboxes: dict[int, Inbox] = {}
        # The station that left first is reused first, so that no frame now on the bus began before it left.
        self._unused = deque(range(MOST_STATIONS))
        self._leaving: set[int] = set()
        self._connected: set[int] = set()
        self._due_ns: int | None = None
        self.cpu_ns: Counter[str] | None = None
        """CPU time (ns) spent on simulating the bus, by thread name; None if it is not measured."""

    def join(self) -> int:
        """Connect a station that is not in use, and return its number."""
        if not self._unused:
            raise can.CanInitializationError(
                f"{self.channel}: cannot open more than {MOST_STATIONS} endpoints at the same time"
            )
        station = self._unused.popleft()
        if station in self._inboxes:  # used before: it must not receive or send frames of the closed endpoint
            self.catch_up()
            self.bus.clear(self.clock.now_ns, station)
        self._inboxes[station] = Inbox(self.clock)
        self._connected.add(station)
        self.bus.connect(self.clock.now_ns, station)
        return station

    def leave(self, station: int) -> None:
        """Disconnect a station once its queued frames have been sent, like a closed socket."""
        self._leaving.add(station)
        self._disconnect()
        self._plan()

    def send(self, station: int, frame: CanFrame) -> None:
        """Queue a frame from a station for transmission."""
        self.bus.send(self.clock.now_ns, station, frame)
        if self._due_ns is None or self.bus.waiting(station) == 1:  # otherwise, already planned
            self._plan()

    def disturb(self, rule: Disturbance) -> None:
        """Add a rule that injects errors, effective immediately."""
        self.catch_up()
        self.bus.disturb(rule)

    def undisturb(self, rule: Disturbance) -> None:
        """Remove a rule added by :meth:`disturb`."""
        self.catch_up()
        self.bus.undisturb(rule)

    def catch_up(self) -> None:
        """Simulate the bus up to the current virtual time.

        Without this call, the simulation catches up when a frame must wake a reader, at most
        :data:`COALESCED_NS` later. Timestamps are exact either way.
        """
        self._deliver()

    def inbox(self, station: int) -> Inbox:
        """Return a station's queue of received frames."""
        return self._inboxes[station]

    def _plan(self) -> None:
        due_ns = self.bus.next_event_ns
        if due_ns is None:
            return
        due_ns = max(due_ns, self._quiet_until_ns())
        if self._due_ns is None or due_ns < self._due_ns:
            self._due_ns = due_ns
            self.clock.call_at(due_ns, self._advance)

    def _quiet_until_ns(self) -> int:
        """Return the earliest time (ns) at which a pending frame can wake a reader."""
        sender = self.bus.only_sender
        inboxes = self._inboxes
        return min(
            [inboxes[station].quiet_until_ns for station in self._connected if station != sender], default=0
        )

    def _advance(self) -> None:
        if self.cpu_ns is None:
            self._deliver()
        else:
            start_ns = time.thread_time_ns()
            self._deliver()
            self.cpu_ns[threading.current_thread().name] += time.thread_time_ns() - start_ns

    def _deliver(self) -> None:
        self._due_ns = None
        inboxes, listeners = self._inboxes, self.listeners
        for event in self.bus.advance(self.clock.now_ns):
            if isinstance(event, Delivered):
                for station in event.receivers:
                    inboxes[station].put(event)
            for listener in listeners:
                listener(event)
        if self._leaving:
            self._disconnect()
        self._plan()

    def _disconnect(self) -> None:
        """Disconnect the closing stations that have sent their frames, or all stations if all are closing."""
        for station in sorted(self._leaving):
            if not self.bus.waiting(station) or self._connected <= self._leaving:
                self.bus.clear(self.clock.now_ns, station)
                self.bus.disconnect(self.clock.now_ns, station)
                self._leaving.remove(station)
                self._connected.remove(station)
                self._unused.append(station)


def segment(channel: str, clock: VirtualClock, rates: BitRates) -> Segment:
    """Return the bus ``channel`` of a virtual clock. The first call creates it.

    Raises:
        can.CanInitializationError: If the bus already exists with different bit rates.
    """
    name = f"bus {channel}"
    if name not in clock.shared:
        clock.shared[name] = Segment(channel, clock, rates)
    found = cast(Segment, clock.shared[name])
    if found.rates != rates:
        raise can.CanInitializationError(
            f"{channel}: got {rates}, must be {found.rates} as in the first call"
        )
    return found


class TimedInterface(can.BusABC):
    """python-can endpoint of a simulated bus in virtual time.

    Args:
        channel: Name of the bus.
        can_filters: Filters for received frames, as in python-can.
        bitrate: Nominal bit rate, in bit/s.
        fd: Whether the bus carries CAN FD frames.
        data_bitrate: Bit rate of the data phase, in bit/s; default: the nominal bit rate.
        **options: Ignored.

    Raises:
        can.CanInitializationError: If the calling thread does not run in virtual time, or if the bus already
            exists with different bit rates.
    """

    def __init__(
        self,
        channel: Any,
        can_filters: Any = None,
        bitrate: int = 1_000_000,
        fd: bool = False,
        data_bitrate: int | None = None,
        **options: object,
    ) -> None:
        clock = process_clock.current()
        if not isinstance(clock, VirtualClock):
            raise can.CanInitializationError(
                "interface timed: the thread runs in real time, must run in a vcan_sim.VirtualClock"
            )
        self.channel_info = f"timed {channel}"
        rates = BitRates(bitrate, (data_bitrate or bitrate) if fd else None)
        self._clock, self._segment = clock, segment(str(channel), clock, rates)
        self._station = self._segment.join()
        self._inbox = self._segment.inbox(self._station)
        super().__init__(channel, can_filters)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame for transmission, and return immediately."""
        self._check_open()
        if msg.is_error_frame:
            raise can.CanOperationError(
                f"{self.channel_info}: got an error frame, must be a data or remote frame"
            )
        self._segment.send(
            self._station,
            CanFrame(
                msg.arbitration_id,
                b"" if msg.is_remote_frame else bytes(msg.data),
                msg.is_extended_id,
                msg.is_remote_frame,
                msg.dlc if msg.is_remote_frame else 0,
                msg.is_fd,
                msg.bitrate_switch,
            ),
        )

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next received frame, or None if no frame arrives within ``timeout`` seconds."""
        end_ns = None if timeout is None else self._clock.monotonic_ns() + round(timeout * 1e9)
        while True:
            self._check_open()
            left_s = None if end_ns is None else max(0.0, (end_ns - self._clock.monotonic_ns()) * 1e-9)
            try:
                message = self._message(self._inbox.get(left_s))
            except queue.Empty:
                return None
            if self._matches_filters(message):
                return message

    def _message(self, delivered: Delivered) -> can.Message:
        frame = delivered.frame
        wall_to_monotonic_ns = self._clock.time_ns() - self._clock.now_ns
        return can.Message(
            timestamp=(delivered.time_ns + wall_to_monotonic_ns) * 1e-9,
            arbitration_id=frame.can_id,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_fd=frame.fd,
            bitrate_switch=frame.brs,
            dlc=frame.dlc if frame.remote else None,
            data=frame.data,
            channel=self._segment.channel,
        )

    # --- methods that CanPort uses instead of send and recv

    def send_frame(self, can_id: int, data: bytes, *, remote: bool, fd: bool) -> None:
        """Queue a frame for transmission. See :class:`FrameInterface` for the arguments."""
        self._check_open()
        self._segment.send(self._station, CanFrame(can_id, data, False, remote, 0, fd, fd))

    def read_frames(self, timeout_s: float, most: int) -> list[Frame]:
        """Return up to ``most`` received frames, without applying the python-can filters."""
        self._check_open()
        return [
            Frame(sent.can_id, sent.data, event.time_ns, sent.remote, False, sent.extended, sent.fd)
            for event in self._inbox.get_all(timeout_s, most)
            for sent in (event.frame,)
        ]

    def call_on_arrival(self, function: Callable[[], object]) -> None:
        """Call ``function`` whenever :class:`Inbox` wakes the reader."""
        self._inbox.on_arrival = function

    def hold_until(self, t_ns: int) -> None:
        """Do not signal the arrival of frames before ``t_ns``."""
        self._inbox.hold_until(t_ns)

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info} is closed")

    def shutdown(self) -> None:
        """Close the endpoint and disconnect its station from the bus."""
        if not self._is_shutdown:
            self._segment.leave(self._station)
        super().shutdown()
