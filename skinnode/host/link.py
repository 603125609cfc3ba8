"""Send and receive frames on one bus of the hand, and reopen its interface after a failure."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from skinnode.canopen.indices import SYNC_COB_ID, sdo_response_cob_id
from skinnode.config import BusConfig
from skinnode.errors import BusError, CodecError, SkinError
from skinnode.host.containment import Defects, keep_on, one_line
from skinnode.host.dispatcher import BusStats, Dispatcher, Handler, PortCounters
from skinnode.host.retry_pause import Pause
from skinnode.host.sdo_client import RemoteOd, SkinNetwork
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.transport import CanPort, Frame, Intake

_log = logging.getLogger(__name__)

_REOPEN_S: Final = 0.1
"""Pause (s) before each attempt to reopen a failed interface."""


class BusLink(Dispatcher, Closing):
    """Connection to a bus, open from construction until :meth:`close` or the end of a ``with`` block.

    If a handler, poller, listener or job raises an exception, only the current frame or call is lost. If the
    dispatcher itself raises an exception, dispatching pauses for this bus, and received frames wait in the
    queue. If the interface fails, a separate thread tries repeatedly to reopen it.

    Threads: any thread may call :meth:`send`, :meth:`ask_remote`, :meth:`call` and :meth:`stats`. The other
    methods are reserved for the :class:`~skinnode.host.mainline.Mainline`.

    Args:
        config: Configuration of the bus.
        handlers: Handlers for the data frames, by COB-ID. The mainline calls them.
        on_defect: Function called with each exception whose message is new, on the thread that raised it.
        open_port: Function that opens the interface.

    Raises:
        BusError: if the interface cannot be opened.
    """

    def __init__(
        self,
        config: BusConfig,
        handlers: Mapping[int, Handler],
        on_defect: Callable[[SkinError], object],
        open_port: Callable[[BusConfig], CanPort] = CanPort,
    ) -> None:
        super().__init__(config, handlers, clock.monotonic_ns())
        self.defects = Defects(config.name, on_defect)
        """Collector of the exceptions that concern the bus rather than one of its patches."""
        self._sent_listeners: tuple[Callable[[Frame], None], ...] = ()
        self._jobs: deque[tuple[Callable[[], object], Defects]] = deque()
        self.failure: BusError | None = None
        """Error that made the bus unavailable; None while the bus is available."""
        self._due_s = 0.0  # time at which a reopened interface counts as working
        self._outages = 0
        self.t_dispatched_ns = 0
        """Monotonic time (ns) up to which all received frames have been dispatched."""
        self._rests = False  # whether dispatching is paused (bus unavailable or exception)
        self._rest_end_s = 0.0
        self._opening = False
        self._pause = Pause()
        self._load_pause, self._load_due_s = Pause(), 0.0
        self._resume: Callable[[], None] = lambda: None
        self._reopening: threading.Thread | None = None
        self._reopen_s = _REOPEN_S
        self._stop = clock.event()
        self._port = open_port(config)
        self.intake = Intake(self._port)
        """Queue of received frames that await dispatch."""
        self.network = SkinNetwork(self.send)

    def send(self, can_id: int, data: bytes) -> None:
        """Send a data frame. Thread-safe.

        Raises:
            BusError: if the interface does not accept the frame.
        """
        t_ns = clock.monotonic_ns()
        self._port.send(can_id, data)
        try:  # the frame has been sent, so exceptions in listeners must not reach the caller
            if can_id != SYNC_COB_ID:
                self.intake.asked(t_ns)
            self.count_sent(can_id, data)
            for listener in self._sent_listeners:
                listener(Frame(can_id, data, t_ns, fd=len(data) > 8))
        except Exception as error:
            self.defects.report("a listener for sent frames", error)

    def remote_od(
        self,
        node_id: int,
        on_answer: Callable[[int], None] = lambda t_ns: None,
        defects: Defects | None = None,
    ) -> RemoteOd:
        """Return an SDO client for the object dictionary of a node on this bus.

        Args:
            node_id: Node-ID of the node.
            on_answer: Function called with the monotonic time (ns) of each SDO response, on the mainline.
            defects: Collector of the response handler's exceptions; see :meth:`handle`. If it is given,
                unexpected exceptions during a transfer are reported to the bus's collector.
        """

        def on_response(data: bytes, t_ns: int) -> None:
            if len(data) != 8:
                self.reject(CodecError(sdo_response_cob_id(node_id), data, "8 bytes (SDO response)"))
                return
            on_answer(t_ns)
            self.network.notify(sdo_response_cob_id(node_id), bytearray(data), t_ns * 1e-9)

        self.handle(sdo_response_cob_id(node_id), on_response, defects)
        if defects is None:
            return RemoteOd(self.network, node_id)
        doing = f"SDO transfer with node {node_id}"
        return RemoteOd(self.network, node_id, lambda error: self.defects.report(doing, error))

    def ask_remote(self, can_id: int) -> None:
        """Send a remote frame, for example for node guarding. Thread-safe.

        Raises:
            BusError: if the interface does not accept the frame.
        """
        t_ns = clock.monotonic_ns()
        self._port.send(can_id, b"", remote=True)
        self.intake.asked(t_ns)
        for listener in self._sent_listeners:
            listener(Frame(can_id, b"", t_ns, remote=True))

    def listen_to_sent(self, listener: Callable[[Frame], None]) -> None:
        """Pass every sent frame to ``listener``, on the sending thread."""
        self._sent_listeners = (*self._sent_listeners, listener)

    def unlisten_to_sent(self, listener: Callable[[Frame], None]) -> None:
        """Stop passing sent frames to ``listener``."""
        self._sent_listeners = tuple(each for each in self._sent_listeners if each is not listener)

    def call(self, job: Callable[[], object], defects: Defects | None = None) -> None:
        """Run ``job`` on the mainline, before any frame that arrives later is dispatched. Thread-safe.

        Args:
            job: Function to run.
            defects: Collector of the job's exceptions; by default, the bus's collector.
        """
        self._jobs.append((job, self.defects if defects is None else defects))

    def contain(self, owner: Defects | None, doing: str, error: Exception) -> None:
        """Report ``error`` and continue."""
        (self.defects if owner is None else owner).report(doing, error)

    def stats(self) -> BusStats:
        """Return all counters."""
        return self.count(
            PortCounters(
                sent=self._port.sent,
                dropped=self.intake.dropped,
                outages=self._outages,
                read=self._port.received,
                waiting=self.intake.queued,
                kernel_dropped=self._port.dropped,
            )
        )

    def close(self) -> None:
        """Close the interface. Call only after the mainline has ended."""
        self._port.close()

    # --- called by the mainline

    def expect(self, what: str, times_ns: tuple[int, ...]) -> None:
        """Announce the predicted arrival times of frames; see :meth:`Intake.expect`."""
        self.intake.expect(what, times_ns)

    def begin(self, resume: Callable[[], None]) -> None:
        """Prepare for the first :meth:`turn`. ``resume`` restarts reception on a reopened interface."""
        self._resume = resume

    def turn(self) -> None:
        """Dispatch the frames received since the previous call."""
        if self._rests:
            self._rest()
            return
        try:
            heard = self._dispatch_received()
            if self.failure is not None and (heard or clock.monotonic() > self._due_s):
                self.failure = None
                _log.warning("%s: the bus is available again", self.config.name)
        except Exception as error:
            if self.intake.failed:
                self._go_away(error)
                return
            self._rests, self._rest_end_s = True, clock.monotonic() + self._pause.next_s()
            self.defects.report("dispatching frames", error)

    def measure_load(self) -> None:
        """Update the bus load if an update is due. Never raises."""
        try:
            if not self._rests and self.t_dispatched_ns * 1e-9 >= self._load_due_s:
                self.measure(self.t_dispatched_ns)
        except Exception as error:
            self._load_due_s = self.t_dispatched_ns * 1e-9 + self._load_pause.next_s()
            self.defects.report("measuring the load", error)

    def end(self) -> None:
        """Stop reopening the interface. Call after the last :meth:`turn`."""
        self._stop.set()
        if self._reopening is not None:
            self._reopening.join()

    def _dispatch_received(self) -> bool:
        """Dispatch one batch of frames. Return whether it contained any frames."""
        seen_ns = self.intake.seen_ns  # read first: the batch contains all frames up to this time
        batch = self.intake.take()
        while self._jobs:
            job, owner = self._jobs.popleft()
            try:
                job()
            except Exception as error:
                owner.report("a job on the mainline", error)
        # While frames are waiting, the pollers get the time of the newest dispatched frame. If they were
        # given the current time, a delay in the host would make nodes appear late.
        if batch:
            self.dispatch(batch)
            self.t_dispatched_ns = batch[-1].t_ns
        elif seen_ns > self.t_dispatched_ns:
            self.t_dispatched_ns = seen_ns
        else:
            return False
        self.poll(self.t_dispatched_ns)
        return bool(batch)

    def _rest(self) -> None:
        """Resume dispatching after the pause, or restart a reopening thread that failed to start."""
        if not self._opening:
            self._rests = clock.monotonic() < self._rest_end_s
        elif (
            self._reopening is None or not self._reopening.is_alive()
        ) and self._opening:  # the reopening thread failed to start
            self._begin_reopening()

    def _go_away(self, error: Exception) -> None:
        """Mark the bus as unavailable, and start reopening its interface."""
        self._rests = self._opening = True
        if not isinstance(error, BusError):
            self.defects.report("receiving", error)
            error = BusError(f"{self.config.name}: cannot receive ({one_line(error)})")
        if self.failure is None:
            self._outages += 1
            self.failure = error
            _log.warning("%s; trying to reopen the interface", error)
        self._begin_reopening()

    def _begin_reopening(self) -> None:
        """Reopen the interface on a separate thread, because reopening may block."""
        if self._stop.is_set():
            return
        name = f"reopen {self.config.name}"
        thread = clock.thread(target=self._reopen, name=name)
        thread.start()
        self._reopening = thread  # after start(), because only a started thread can be joined

    def _reopen(self) -> None:
        """Try to reopen the interface until it succeeds.

        Unexpected exceptions lengthen the pauses between attempts.
        """
        keep_on(self._reopens_not, self.defects, "reopening the interface")

    def _reopens_not(self) -> bool:
        """Try once to reopen the interface. Return whether another attempt is needed."""
        if self._stop.wait(self._reopen_s):
            return False
        try:
            self._reopen_s = _REOPEN_S
            self._port.reopen()
            self._due_s = clock.monotonic() + _REOPEN_S
            self._resume()
        except BusError:
            return True
        except Exception:
            self._reopen_s = self._pause.next_s()
            raise
        self._opening = False
        self._rests = False
        return False
