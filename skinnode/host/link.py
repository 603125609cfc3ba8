"""One bus of the hand: its port, its receive thread, and its mainline."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Final, Self

from skinnode.errors import BusError, CodecError, SkinError
from skinnode.host.dealer import BusStats, Dealer, Handler
from skinnode.host.network import RemoteOd, SkinNetwork
from skinnode.model.config import BusConfig
from skinnode.transport import CanPort, Frame, Receiver
from skinnode.wire.indices import sdo_response_cob_id

_log = logging.getLogger(__name__)

_WAIT_S: Final = 0.02
"""How long the mainline waits for a frame before it looks at the clock for scans that lack something."""


_REOPEN_S: Final = 0.1
"""Pause before an interface that failed is opened again."""


class BusLink(Dealer):
    """An open bus. It receives from construction to :meth:`close`, and deals out from :meth:`run` or the
    beginning of a ``with`` block on.

    ``handlers`` get the data frames of their COB-IDs, on the mainline. ``on_failure`` is called once, from
    the mainline, if a handler fails. Raises BusError where the interface does not open. An interface that
    fails later is opened again and again until it is back.
    """

    def __init__(
        self,
        config: BusConfig,
        handlers: Mapping[int, Handler],
        on_failure: Callable[[SkinError], None],
        open_port: Callable[[BusConfig], CanPort] = CanPort,
    ) -> None:
        super().__init__(config, handlers, time.monotonic_ns())
        self._on_failure = on_failure
        self._sent_listeners: tuple[Callable[[Frame], None], ...] = ()
        self._jobs: deque[Callable[[], object]] = deque()
        self.failure: BusError | None = None
        """Why the bus is away; None while it is there."""
        self._due_s = 0.0  # when an interface that was opened again and has not failed counts as back
        self._outages = self._dropped_before = 0
        self.t_dealt_ns = 0
        """What was received up to then has been dealt out, monotonic."""
        self._stop = threading.Event()
        self._port = open_port(config)
        self.network = SkinNetwork(self.send)
        self._receiver = Receiver(self._port)
        self._thread = threading.Thread(target=self._run, name=f"mainline {config.name}", daemon=True)

    def run(self) -> None:
        """Begin to deal frames out; those received before come first."""
        self._thread.start()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a data frame, from any thread. Raises BusError."""
        t_ns = time.monotonic_ns()
        self._port.send(can_id, data)
        self.count_sent(can_id, data)
        for listener in self._sent_listeners:
            listener(Frame(can_id, data, t_ns, fd=len(data) > 8))

    def remote_od(self, node_id: int, on_answer: Callable[[int], None] = lambda t_ns: None) -> RemoteOd:
        """The object dictionary of a node on this bus; ``on_answer`` is told when it answers."""

        def on_response(data: bytes, t_ns: int) -> None:
            if len(data) != 8:
                self.reject(CodecError(sdo_response_cob_id(node_id), data, "8 bytes (SDO response)"))
                return
            on_answer(t_ns)
            self.network.notify(sdo_response_cob_id(node_id), bytearray(data), t_ns * 1e-9)

        self.handle(sdo_response_cob_id(node_id), on_response)
        return RemoteOd(self.network, node_id)

    def ask_remote(self, can_id: int) -> None:
        """Send a remote frame, as guarding does, from any thread. Raises BusError."""
        t_ns = time.monotonic_ns()
        self._port.send(can_id, b"", remote=True)
        for listener in self._sent_listeners:
            listener(Frame(can_id, b"", t_ns, remote=True))

    def listen_to_sent(self, listener: Callable[[Frame], None]) -> None:
        """From now on ``listener`` gets every frame that was sent, with the time at which it was handed to
        the interface, on the thread that sent it."""
        self._sent_listeners = (*self._sent_listeners, listener)

    def unlisten_to_sent(self, listener: Callable[[Frame], None]) -> None:
        """From now on ``listener`` gets no more. On the mainline."""
        self._sent_listeners = tuple(each for each in self._sent_listeners if each is not listener)

    def call(self, job: Callable[[], object]) -> None:
        """Have ``job`` done by the mainline, before any frame that is received from now on."""
        self._jobs.append(job)

    def stats(self) -> BusStats:
        return self.count(
            sent=self._port.sent,
            dropped=self._dropped_before + self._receiver.dropped,
            outages=self._outages,
            read=self._port.received,
            waiting=self._receiver.queued,
            kernel_dropped=self._port.dropped,
        )

    def stop(self) -> None:
        """End and join the mainline; frames can still be sent."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()

    def close(self) -> None:
        """End all threads and close the interface."""
        self.stop()
        self._receiver.close()
        self._port.close()

    def __enter__(self) -> Self:
        self.run()
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
        receiver = self._receiver
        batch, seen_ns = receiver.get_batch(_WAIT_S), self.t_dealt_ns
        if not batch:
            seen_ns = receiver.seen_ns
            batch = receiver.get_batch(0.0)
        while self._jobs:
            self._jobs.popleft()()
        self.deal(batch)
        # While frames wait, here or in the interface, time is that of the newest one dealt out: nothing is
        # late because we are.
        self.t_dealt_ns = batch[-1].t_ns if batch else max(seen_ns, self.t_dealt_ns)
        self.poll(self.t_dealt_ns)
        return bool(batch)
