"""One bus of the hand: its port, and what becomes of what is received there and sent."""

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
from skinnode.transport import CanPort, Frame, Intake
from skinnode.wire.indices import SYNC_COB_ID, sdo_response_cob_id

_log = logging.getLogger(__name__)

_REOPEN_S: Final = 0.1
"""Pause before an interface that failed is opened again."""


class BusLink(Dealer):
    """An open bus, from construction to :meth:`close` or the end of a ``with`` block. A
    :class:`~skinnode.host.mainline.Mainline` makes it deal out what comes.

    ``handlers`` get the data frames of their COB-IDs, on the mainline. ``on_failure`` is called once if a
    handler fails; nothing is dealt out any more then. Raises BusError where the interface does not open. An
    interface that fails later is opened again and again until it is back.
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
        self._outages = 0
        self.t_dealt_ns = 0
        """What was received up to then has been dealt out, monotonic."""
        self._rests = False  # while the bus is away, and for good after a defect
        self._resume: Callable[[], None] = lambda: None
        self._reopening: threading.Thread | None = None
        self._stop = threading.Event()
        self._port = open_port(config)
        self.intake = Intake(self._port)
        """What is received and not dealt out yet."""
        self.network = SkinNetwork(self.send)

    def send(self, can_id: int, data: bytes) -> None:
        """Send a data frame, from any thread. Raises BusError."""
        t_ns = time.monotonic_ns()
        self._port.send(can_id, data)
        if can_id != SYNC_COB_ID:
            self.intake.asked(t_ns)
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
        self.intake.asked(t_ns)
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
            dropped=self.intake.dropped,
            outages=self._outages,
            read=self._port.received,
            waiting=self.intake.queued,
            kernel_dropped=self._port.dropped,
        )

    def close(self) -> None:
        """Close the interface. The mainline must have ended before."""
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- the mainline's

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        """As :meth:`Intake.expect`."""
        self.intake.expect(what, times_ns)

    def begin(self, resume: Callable[[], None]) -> None:
        """Before the first turn. ``resume``: receives again on an interface that was opened again."""
        self._resume = resume

    def turn(self) -> None:
        """What was received since the last turn, to its handlers. Raises nothing."""
        if self._rests:
            return
        try:
            heard = self._deal_out()
            if self.failure is not None and (heard or time.monotonic() > self._due_s):
                self.failure = None
                _log.warning("%s: the bus is back", self.config.name)
        except BusError as error:
            self._go_away(error)
        except Exception as error:  # a defect of ours: it must reach the user, and the other buses go on
            self._fail(error)

    def measure_load(self) -> None:
        """As :meth:`measure`, at the time up to which was dealt out. Raises nothing."""
        if self._rests:
            return
        try:
            self.measure(self.t_dealt_ns)
        except Exception as error:  # a defect of ours
            self._fail(error)

    def end(self) -> None:
        """After the last turn: open the interface no more."""
        self._stop.set()
        if self._reopening is not None:
            self._reopening.join()

    def _deal_out(self) -> bool:
        """One batch of frames to their handlers; whether there was any."""
        seen_ns = self.intake.seen_ns  # first: whatever came before it is in the batch
        batch = self.intake.take()
        while self._jobs:
            self._jobs.popleft()()
        # While frames wait, here or in the interface, time is that of the newest one dealt out: nothing is
        # late because we are.
        if batch:
            self.deal(batch)
            self.t_dealt_ns = batch[-1].t_ns
        elif seen_ns > self.t_dealt_ns:
            self.t_dealt_ns = seen_ns
        else:
            return False
        self.poll(self.t_dealt_ns)
        return bool(batch)

    def _go_away(self, error: BusError) -> None:
        """Have the interface opened again, on a thread of its own: that may take long."""
        if self.failure is None:
            self._outages += 1
            self.failure = error
            _log.warning("%s; tried again until it is back", error)
        self._rests = True
        name = f"reopen {self.config.name}"
        self._reopening = threading.Thread(target=self._reopen, name=name, daemon=True)
        self._reopening.start()

    def _reopen(self) -> None:
        """One that does not open, or fails at once, is tried after a pause."""
        try:
            while not self._stop.wait(_REOPEN_S):
                try:
                    self._port.reopen()
                except BusError:
                    continue
                self._due_s = time.monotonic() + _REOPEN_S
                self._resume()
                self._rests = False
                return
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        self._rests = True
        _log.debug("bus %s", self.config.name, exc_info=True)
        failure = SkinError(f"bus {self.config.name!r}: {type(error).__name__}: {error}")
        failure.__cause__ = error
        self._on_failure(failure)
