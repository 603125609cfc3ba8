"""Count a bus's frames and dispatch them to handlers by COB-ID, without threads or a clock.

In a host, a :class:`~skinnode.host.link.BusLink` feeds the dispatcher; in a replay, a recording does.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.bus_load.stuffing import load_kernels
from skinnode.bus_load.timing import BusLoad
from skinnode.config import BusConfig
from skinnode.errors import CodecError
from skinnode.host.containment import Defects
from skinnode.transport import Frame
from skinnode.transport.bus_state import BusState, bus_state

_log = logging.getLogger(__name__)

Handler = Callable[[bytes, int], None]
"""Function called with the data and the monotonic arrival time (ns) of a frame."""

_MARK_NS: Final = 100_000_000
"""Interval (ns) between updates of the bus load."""
_MARKS: Final = 10
"""Length of the bus load's moving average, in units of ``_MARK_NS``."""

_POLL_NS: Final = 2_000_000
"""Minimum interval (ns) between calls to the pollers. Their shortest timeout is 5 ms, so polling after each
batch, about once a millisecond, is unnecessary.
"""


@dataclass(frozen=True, slots=True)
class BusStats:
    """Counters of the frames on a bus since it was opened."""

    received: int
    """Number of data frames received; the host's own frames are not included."""
    sent: int
    foreign: int
    """Number of data frames with a COB-ID that has no handler."""
    ignored: int
    """Number of remote frames, extended frames and, on a bus without ``fd``, CAN FD frames. All of these are
    ignored.
    """
    error_frames: int
    """Number of error frames, which the interface uses to report bus errors and controller states."""
    bus_offs: int
    """Number of times the CAN controller has gone bus-off."""
    controller: BusState | None
    """Last reported state of the CAN controller; None before the first report."""
    foreign_ids: Mapping[int, int]
    """Number of foreign data frames by COB-ID."""
    read: int
    """Number of frames of all types read from the interface."""
    waiting: int
    """Number of frames read from the interface but not dispatched yet."""
    kernel_dropped: int
    """Number of frames dropped because the kernel's buffer was full; 0 if the interface does not report
    drops.
    """
    dropped: int
    """Number of frames dropped because the receive queue was full."""
    malformed: int
    """Number of frames with an expected COB-ID but a wrong length or format."""
    outages: int
    """Number of times the CAN interface has failed."""
    bits: int
    """Total length (bits, including stuff bits) of the data frames received and sent, updated every 0.1 s."""
    load: float
    """Bus load over the last second, as a fraction of the capacity."""


@dataclass(frozen=True, slots=True)
class PortCounters:
    """Counters kept by the frame source, which is an interface or a recording."""

    sent: int = 0
    dropped: int = 0
    outages: int = 0
    read: int | None = None
    """Number of frames read; None if frames are dispatched as soon as they are read."""
    waiting: int = 0
    kernel_dropped: int = 0


class Dispatcher:
    """Dispatcher for the frames on one bus of the hand.

    Threads: :meth:`count` and :meth:`count_sent` may be called from any thread, the other methods only from
    the mainline.
    """

    def __init__(self, config: BusConfig, handlers: Mapping[int, Handler], now_ns: int) -> None:
        self.config = config
        self.first_malformed: CodecError | None = None
        self._handlers = dict(handlers)
        self._owners: dict[int, Defects] = {}
        self._pollers: tuple[tuple[Callable[[int], None], Defects | None], ...] = ()
        self._listeners: tuple[Callable[[Sequence[Frame]], None], ...] = ()
        self._complained: set[int] = set()
        self._foreign = self._ignored = self._malformed = self._received = 0
        self._error_frames = self._bus_offs = 0
        self._foreign_ids: dict[int, int] = {}
        self._bus_state: BusState | None = None
        if config.fd:
            load_kernels()
        self._meter = BusLoad(config.bitrate_bps, config.data_bitrate_bps)
        self._outgoing: deque[tuple[int, bytes]] = deque()
        self._marks: deque[tuple[int, int]] = deque([(now_ns, 0)], maxlen=_MARKS)
        self._load = 0.0
        self._polled_ns = 0

    def handle(self, cob_id: int, handler: Handler, defects: Defects | None = None) -> None:
        """Pass all data frames with ``cob_id`` to ``handler`` from now on.

        Args:
            cob_id: Identifier of the frames.
            handler: Handler for the frames. It replaces any previous handler.
            defects: Collector of the handler's exceptions; by default, the bus's collector.
        """
        if defects is not None:
            self._owners[cob_id] = defects
        self._handlers[cob_id] = handler

    def listen(self, listener: Callable[[Sequence[Frame]], None]) -> None:
        """Pass each batch of frames, of all types, to ``listener`` before the handlers are called."""
        self._listeners = (*self._listeners, listener)

    def unlisten(self, listener: Callable[[Sequence[Frame]], None]) -> None:
        """Stop passing batches of frames to ``listener``."""
        self._listeners = tuple(each for each in self._listeners if each is not listener)

    def poll_with(self, poller: Callable[[int], None], defects: Defects | None = None) -> None:
        """Call ``poller`` regularly with the monotonic time (ns), even while the bus is idle.

        Args:
            poller: Function to call, at most once every 2 ms.
            defects: Collector of the poller's exceptions; by default, the bus's collector.
        """
        self._pollers = (*self._pollers, (poller, defects))

    def contain(self, owner: Defects | None, doing: str, error: Exception) -> None:
        """Handle ``error``, raised during the operation ``doing``.

        Raises:
            Exception: ``error`` itself, which stops a replay. A live bus overrides this method.
        """
        raise error

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        """Ignore the predicted end times of scans. Only a live bus uses them."""

    def count_sent(self, can_id: int, data: bytes) -> None:
        """Add a sent frame to the bus load. Thread-safe."""
        self._outgoing.append((can_id, data))

    def dispatch(self, batch: Sequence[Frame]) -> None:
        """Pass frames to their handlers, in order of arrival.

        If a handler raises an exception, only the current frame is lost.
        """
        for listener in self._listeners:
            try:
                listener(batch)
            except Exception as defect:
                self.contain(None, "a listener", defect)
        handlers, takes_fd = self._handlers, self.config.fd
        others: list[Frame] = []
        frames = iter(batch)
        going_on = True
        while going_on:
            try:
                for frame in frames:
                    can_id, data, t_ns, remote, error, extended, fd = frame
                    if remote or error or extended or (fd and not takes_fd):
                        others.append(frame)
                        continue
                    handler = handlers.get(can_id)
                    if handler is None:
                        self._foreign += 1
                        self._foreign_ids[can_id] = self._foreign_ids.get(can_id, 0) + 1
                        continue
                    handler(data, t_ns)
                going_on = False
            except Exception as defect:  # ``frames`` continues with the next frame
                self.contain(self._owners.get(can_id), f"frame 0x{can_id:03X}", defect)
        try:
            self._tally(batch, others)
        except Exception as defect:
            self.contain(None, "counting frames", defect)

    def _tally(self, batch: Sequence[Frame], others: Sequence[Frame]) -> None:
        """Count the frames of a batch. ``others`` are the frames whose type no handler accepts."""
        takes_fd = self.config.fd
        if others:
            set_aside = {id(frame) for frame in others}
            batch = [frame for frame in batch if id(frame) not in set_aside]
            for frame in others:
                if frame.error:
                    self._on_error_frame(frame)
                else:
                    self._ignored += 1
        self._received += len(batch)
        if takes_fd:
            self._meter.add_all([frame for frame in batch if frame.fd], fd=True)
            batch = [frame for frame in batch if not frame.fd]
        self._meter.add_all(batch)

    def poll(self, now_ns: int) -> None:
        """Call the pollers, at most once every 2 ms."""
        if not 0 <= now_ns - self._polled_ns < _POLL_NS:
            self._polled_ns = now_ns
            for poll, owner in self._pollers:
                try:
                    poll(now_ns)
                except Exception as defect:
                    self.contain(owner, "polling", defect)

    def measure(self, now_ns: int) -> None:
        """Update the bus load if an update is due.

        The update is slow. A mainline that serves several buses therefore calls this method for one bus per
        iteration.
        """
        if now_ns >= self._marks[-1][0] + _MARK_NS:
            self._mark(now_ns)

    def reject(self, error: CodecError) -> None:
        """Count a malformed frame, and log it if it is the first with its COB-ID."""
        self._malformed += 1
        if self.first_malformed is None:
            self.first_malformed = error
        if error.cob_id not in self._complained:
            self._complained.add(error.cob_id)
            _log.warning(
                "%s: %s; further malformed frames with this COB-ID are counted but not logged",
                self.config.name,
                error,
            )

    def count(self, port: PortCounters = PortCounters()) -> BusStats:
        """Return all counters. Thread-safe.

        Args:
            port: Counters of the frame source.
        """
        return BusStats(
            received=self._received,
            sent=port.sent,
            foreign=self._foreign,
            ignored=self._ignored,
            error_frames=self._error_frames,
            bus_offs=self._bus_offs,
            controller=self._bus_state,
            foreign_ids=dict(self._foreign_ids),
            read=self._received + self._ignored + self._error_frames if port.read is None else port.read,
            waiting=port.waiting,
            kernel_dropped=port.kernel_dropped,
            dropped=port.dropped,
            outages=port.outages,
            malformed=self._malformed,
            bits=self._marks[-1][1],
            load=self._load,
        )

    def _on_error_frame(self, frame: Frame) -> None:
        self._error_frames += 1
        if self.config.interface == "socketcan":  # only SocketCAN encodes the controller state in this way
            state, before = bus_state(frame), self._bus_state
            if state is not None:
                self._bus_state = state
                self._bus_offs += state is BusState.OFF and before is not BusState.OFF

    def _mark(self, now_ns: int) -> None:
        """Update the bus load. Called only on the mainline, because the load meter is not thread-safe."""
        while self._outgoing:
            self._meter.add(*self._outgoing.popleft())
        bits = self._meter.bits
        then_ns, then_bits = self._marks[0]
        self._load = (bits - then_bits) * 1e9 / ((now_ns - then_ns) * self.config.bitrate_bps)
        self._marks.append((now_ns, bits))
