"""One bus of the hand: its port, its receive thread, and the mainline that deals frames out by COB-ID."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from skinnode.errors import BusError, CodecError, SkinError
from skinnode.host.network import RemoteOd, SkinNetwork
from skinnode.model.config import BusConfig
from skinnode.transport import CanPort, Frame, Receiver
from skinnode.wire.indices import sdo_response_cob_id
from skinnode.wire.timing import BusLoad

_log = logging.getLogger(__name__)

Handler = Callable[[bytes, int], None]
"""What happens to a frame: its data and when it was received, monotonic ns."""

_MARK_NS: Final = 100_000_000
_MARKS: Final = 10
"""The load is the mean over the last ten tenths of a second."""

_WAIT_S: Final = 0.02
"""How long the mainline waits for a frame before it looks at the clock for scans that lack something."""


_REOPEN_S: Final = 0.1
"""Pause before an interface that failed is opened again."""


@dataclass(frozen=True, slots=True)
class BusStats:
    """What passed on a bus since the host opened it."""

    received: int
    """Data frames read, the host's own not among them."""
    sent: int
    foreign: int
    """Data frames of a COB-ID that the hand file does not explain."""
    ignored: int
    """Remote, error and extended frames; on a bus without ``fd`` also CAN FD frames."""
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


class BusLink:
    """An open bus. Its threads run from construction to :meth:`close`.

    ``handlers`` get the data frames of their COB-IDs, on the mainline. ``on_failure`` is called once, from
    the mainline, if a handler fails. Raises BusError where the interface does not open. An interface that
    fails later is opened again and again until it is back.
    """

    def __init__(
        self, config: BusConfig, handlers: Mapping[int, Handler], on_failure: Callable[[SkinError], None]
    ) -> None:
        self.config = config
        self.first_malformed: CodecError | None = None
        self._on_failure = on_failure
        self._handlers = dict(handlers)
        self._pollers: tuple[Callable[[int], None], ...] = ()
        self._listeners: tuple[Callable[[Sequence[Frame]], None], ...] = ()
        self._complained: set[int] = set()
        self._foreign = self._ignored = self._malformed = self._received = 0
        self._meter = BusLoad(config.bitrate_bps, config.data_bitrate_bps)
        self._outgoing: deque[tuple[int, bytes]] = deque()
        self._jobs: deque[Callable[[], None]] = deque()
        self.failure: BusError | None = None
        """Why the bus is away; None while it is there."""
        self._due_s = 0.0  # when an interface that was opened again and has not failed counts as back
        self._outages = self._dropped_before = 0
        self._marks: deque[tuple[int, int]] = deque([(time.monotonic_ns(), 0)], maxlen=_MARKS)
        self._load = 0.0
        self._stop = threading.Event()
        self._port = CanPort(config)
        self.network = SkinNetwork(self.send)
        self._receiver = Receiver(self._port)
        self._thread = threading.Thread(target=self._run, name=f"mainline {config.name}", daemon=True)
        self._thread.start()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a data frame, from any thread. Raises BusError."""
        self._port.send(can_id, data)
        self._outgoing.append((can_id, data))

    def handle(self, cob_id: int, handler: Handler) -> None:
        """From now on ``handler`` gets the data frames of ``cob_id``, on the mainline."""
        self._handlers[cob_id] = handler

    def remote_od(self, node_id: int) -> RemoteOd:
        """The object dictionary of a node on this bus."""

        def on_response(data: bytes, t_ns: int) -> None:
            if len(data) != 8:
                self.reject(CodecError(sdo_response_cob_id(node_id), data, "8 bytes (SDO response)"))
                return
            self.network.notify(sdo_response_cob_id(node_id), bytearray(data), t_ns * 1e-9)

        self.handle(sdo_response_cob_id(node_id), on_response)
        return RemoteOd(self.network, node_id)

    def ask_remote(self, can_id: int) -> None:
        """Send a remote frame, as guarding does, from any thread. Raises BusError."""
        self._port.send(can_id, b"", remote=True)

    def listen(self, listener: Callable[[Sequence[Frame]], None]) -> None:
        """From now on ``listener`` gets every batch of frames whole, of all kinds, before any handler does,
        on the mainline."""
        self._listeners = (*self._listeners, listener)

    def poll_with(self, poller: Callable[[int], None]) -> None:
        """From now on ``poller`` is told the time, monotonic ns, after each batch of frames."""
        self._pollers = (*self._pollers, poller)

    def call(self, job: Callable[[], None]) -> None:
        """Have ``job`` done by the mainline, before any frame that is received from now on."""
        self._jobs.append(job)

    def reject(self, error: CodecError) -> None:
        """Count a frame that is not what its COB-ID promises; log the first of a COB-ID. Mainline only."""
        self._malformed += 1
        if self.first_malformed is None:
            self.first_malformed = error
        if error.cob_id not in self._complained:
            self._complained.add(error.cob_id)
            _log.warning("%s: %s; rejected, as are others like it", self.config.name, error)

    def stats(self) -> BusStats:
        return BusStats(
            received=self._received,
            sent=self._port.sent,
            foreign=self._foreign,
            ignored=self._ignored,
            dropped=self._dropped_before + self._receiver.dropped,
            outages=self._outages,
            malformed=self._malformed,
            bits=self._marks[-1][1],
            load=self._load,
        )

    def stop(self) -> None:
        """End and join the mainline; frames can still be sent."""
        self._stop.set()
        self._thread.join()

    def close(self) -> None:
        """End all threads and close the interface."""
        self.stop()
        self._receiver.close()
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    heard = self._turn()
                    if self.failure is not None and (heard or time.monotonic() > self._due_s):
                        self.failure = None
                        _log.warning("%s: the bus is back", self.config.name)
                except BusError as error:
                    self._reopen(error)
        except Exception as error:  # a defect of ours: it must reach the user, not die with the thread
            _log.debug("bus %s", self.config.name, exc_info=True)
            failure = SkinError(f"bus {self.config.name!r}: {type(error).__name__}: {error}")
            failure.__cause__ = error
            self._on_failure(failure)

    def _reopen(self, error: BusError) -> None:
        """Open the interface again; one that does not open, or fails at once, is tried after a pause."""
        if self.failure is None:
            self._outages += 1
            self.failure = error
            _log.warning("%s; tried again until it is back", error)
        self._receiver.close()
        while not self._stop.wait(_REOPEN_S):
            try:
                self._port.reopen()
            except BusError:
                continue
            self._dropped_before += self._receiver.dropped
            self._receiver = Receiver(self._port)
            self._due_s = time.monotonic() + _REOPEN_S
            return

    def _turn(self) -> bool:
        """One batch of frames to their handlers; whether there was any."""
        batch = self._receiver.get_batch(_WAIT_S)
        while self._jobs:
            self._jobs.popleft()()
        if batch:
            for listener in self._listeners:
                listener(batch)
        for frame in batch:
            if frame.remote or frame.error or frame.extended or (frame.fd and not self.config.fd):
                self._ignored += 1
                continue
            self._received += 1
            self._meter.add(frame.can_id, frame.data, fd=frame.fd)
            handler = self._handlers.get(frame.can_id)
            if handler is None:
                self._foreign += 1
                continue
            handler(frame.data, frame.t_ns)
        # While frames wait, the time is that of the newest one dealt out: a scan is not late because we are.
        now_ns = batch[-1].t_ns if batch else time.monotonic_ns()
        for poll in self._pollers:
            poll(now_ns)
        if now_ns >= self._marks[-1][0] + _MARK_NS:
            self._mark(now_ns)
        return bool(batch)

    def _mark(self, now_ns: int) -> None:
        """Work out the bits so far; the meter has one owner, so nobody else may ask it."""
        while self._outgoing:
            self._meter.add(*self._outgoing.popleft())
        bits = self._meter.bits
        then_ns, then_bits = self._marks[0]
        self._load = (bits - then_bits) * 1e9 / ((now_ns - then_ns) * self.config.bitrate_bps)
        self._marks.append((now_ns, bits))
