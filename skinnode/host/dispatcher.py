"""Counts the frames of a bus and dispatches them to handlers by COB-ID. No thread, no clock.

A :class:`~skinnode.host.link.BusLink` is fed by a bus; a replay feeds a dispatcher from a recording.
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
"""What happens to a frame: its data and when it was received, monotonic ns."""

_MARK_NS: Final = 100_000_000
_MARKS: Final = 10
"""The load is the mean over the last ten tenths of a second."""

_POLL_NS: Final = 2_000_000
"""How often the pollers are asked: what they wait for takes 5 ms at least, and frames come in batches a
millisecond apart."""


@dataclass(frozen=True, slots=True)
class BusStats:
    """What passed on a bus since the host opened it."""

    received: int
    """Data frames read, the host's own not among them."""
    sent: int
    foreign: int
    """Data frames of a COB-ID that the hand file does not explain."""
    ignored: int
    """Remote and extended frames; on a bus without ``fd`` also CAN FD frames."""
    error_frames: int
    """What the interface says of errors on the bus, and of its controller's state."""
    bus_offs: int
    """Times it said that the controller went off the bus."""
    controller: BusState | None
    """What it said last of its controller; None where it said nothing."""
    foreign_ids: Mapping[int, int]
    """How many frames of each foreign COB-ID."""
    read: int
    """Frames of all kinds read off the interface."""
    waiting: int
    """Frames of those that nobody has looked at yet."""
    kernel_dropped: int
    """Frames that the kernel had no room for; 0 where the interface does not tell."""
    dropped: int
    """Frames that found the receive queue full."""
    malformed: int
    """Frames of a known COB-ID with a length that it does not have."""
    outages: int
    """Times the interface failed and was opened again."""
    bits: int
    """Exact length of all data frames, received and sent, up to a tenth of a second ago."""
    load: float
    """Share of the bus that these took over the last second; 1 is full."""


class Dispatcher:
    """One bus of the hand, as far as its frames go. Owned by one thread, the mainline; only what says so may
    be called from others."""

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
        """Pass the data frames of ``cob_id`` to ``handler`` from now on, on the mainline. Its exceptions are
        reported to ``defects``, by default those of the bus."""
        if defects is not None:
            self._owners[cob_id] = defects
        self._handlers[cob_id] = handler

    def listen(self, listener: Callable[[Sequence[Frame]], None]) -> None:
        """From now on ``listener`` gets every batch of frames whole, of all kinds, before any handler does,
        on the mainline."""
        self._listeners = (*self._listeners, listener)

    def unlisten(self, listener: Callable[[Sequence[Frame]], None]) -> None:
        """From now on ``listener`` gets no more. On the mainline."""
        self._listeners = tuple(each for each in self._listeners if each is not listener)

    def poll_with(self, poller: Callable[[int], None], defects: Defects | None = None) -> None:
        """From now on ``poller`` is told the time, monotonic ns, after a batch of frames and when none come;
        not more often than every 2 ms. Its exceptions are reported to ``defects``, by default those of the
        bus."""
        self._pollers = (*self._pollers, (poller, defects))

    def contain(self, owner: Defects | None, doing: str, error: Exception) -> None:
        """Handle ``error``, raised while ``doing`` something with frames. Raises it if there is no bus to
        continue with, as in a replay."""
        raise error

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        """Whoever is fed by a bus wants the frame that comes at one of these times without delay."""

    def count_sent(self, can_id: int, data: bytes) -> None:
        """Let a frame that was sent count towards the load. From any thread."""
        self._outgoing.append((can_id, data))

    def dispatch(self, batch: Sequence[Frame]) -> None:
        """Pass frames to their handlers, in order. A handler that raises loses only that frame."""
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
            except Exception as defect:  # ``frames`` continues after the lost frame
                self.contain(self._owners.get(can_id), f"frame 0x{can_id:03X}", defect)
        try:
            self._tally(batch, others)
        except Exception as defect:
            self.contain(None, "counting frames", defect)

    def _tally(self, batch: Sequence[Frame], others: Sequence[Frame]) -> None:
        """Count the frames of a batch; ``others`` are those without a handler."""
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
        """Tell the pollers the time, after a batch."""
        if not 0 <= now_ns - self._polled_ns < _POLL_NS:
            self._polled_ns = now_ns
            for poll, owner in self._pollers:
                try:
                    poll(now_ns)
                except Exception as defect:
                    self.contain(owner, "polling", defect)

    def measure(self, now_ns: int) -> None:
        """Work out the load, when that is due. It takes as long as forty frames do, so whoever has several
        buses lets one of them at a time."""
        if now_ns >= self._marks[-1][0] + _MARK_NS:
            self._mark(now_ns)

    def reject(self, error: CodecError) -> None:
        """Count a frame that is not what its COB-ID promises; log the first of a COB-ID. Mainline only."""
        self._malformed += 1
        if self.first_malformed is None:
            self.first_malformed = error
        if error.cob_id not in self._complained:
            self._complained.add(error.cob_id)
            _log.warning("%s: %s; rejected, as are others like it", self.config.name, error)

    def count(
        self,
        *,
        sent: int = 0,
        dropped: int = 0,
        outages: int = 0,
        read: int | None = None,
        waiting: int = 0,
        kernel_dropped: int = 0,
    ) -> BusStats:
        """All counters; the arguments are those of whoever feeds the dispatcher. From any thread."""
        return BusStats(
            received=self._received,
            sent=sent,
            foreign=self._foreign,
            ignored=self._ignored,
            error_frames=self._error_frames,
            bus_offs=self._bus_offs,
            controller=self._bus_state,
            foreign_ids=dict(self._foreign_ids),
            read=self._received + self._ignored + self._error_frames if read is None else read,
            waiting=waiting,
            kernel_dropped=kernel_dropped,
            dropped=dropped,
            outages=outages,
            malformed=self._malformed,
            bits=self._marks[-1][1],
            load=self._load,
        )

    def _on_error_frame(self, frame: Frame) -> None:
        self._error_frames += 1
        if self.config.interface == "socketcan":  # others put other things into them
            state, before = bus_state(frame), self._bus_state
            if state is not None:
                self._bus_state = state
                self._bus_offs += state is BusState.OFF and before is not BusState.OFF

    def _mark(self, now_ns: int) -> None:
        """Work out the bits so far; the meter has one owner, so nobody else may ask it."""
        while self._outgoing:
            self._meter.add(*self._outgoing.popleft())
        bits = self._meter.bits
        then_ns, then_bits = self._marks[0]
        self._load = (bits - then_bits) * 1e9 / ((now_ns - then_ns) * self.config.bitrate_bps)
        self._marks.append((now_ns, bits))
