"""Runner of nodes on a bus, with one thread for all nodes that share a port."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from types import TracebackType
from typing import Final, Self

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.errors import BusError
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.patch.patch_node import PatchNode
from skinnode.process import clock
from skinnode.transport.bus_state import BusState, bus_state
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

_IDLE_S: Final = 0.1
"""Maximum wait for a frame, s; also the maximum delay before the thread ends."""

_RETRY_S: Final = 0.02
"""Pause after a bus error, s; a full queue drains within this time."""

_CATCH_UP_FRAMES: Final = 4096
"""Maximum number of frames served before a node is reported as silent; a full bus at 1 Mbit/s carries
that many in half a second."""

OFF_AFTER_S: Final = 0.1
"""Duration of uninterrupted bus errors after which nodes treat their controller as bus-off, s; a full queue
drains sooner."""

REOPEN_S: Final = 1.0
"""Duration of uninterrupted bus errors after which the interface is reopened, s, in case it was unplugged and
plugged in again."""


class NodeRunner:
    """Runner that powers nodes on and runs them until :meth:`stop`.

    A runner can be started only once. Bus errors do not stop it. The runner's thread owns the nodes from
    :meth:`start` to :meth:`stop`; other threads may only read the nodes' counters. The port stays open
    afterwards. Timers are as precise as the most demanding node requires.

    Args:
        port: the port that all nodes share.
        nodes: the nodes, any of which may still lack a node-ID.

    Raises:
        ValueError: if there are no nodes, or two nodes have the same node-ID.
    """

    def __init__(self, port: CanPort, nodes: Iterable[PatchNode]) -> None:
        self._port = port
        self._fd = port.config.fd
        self.nodes = tuple(nodes)
        if not self.nodes:
            raise ValueError("nodes: got none, must contain at least one")
        ids = [node.node_id for node in self.nodes if node.node_id != NOT_CONFIGURED]
        if len(set(ids)) < len(ids):
            raise ValueError(f"nodes: got node-IDs {sorted(ids)}, must differ")
        self._slack_ns = min(node.pacing.slack_ns for node in self.nodes)
        self.bus_errors = 0
        """Number of bus errors so far."""
        self.bus_error = ""
        """First error of the latest series of errors, in one line."""
        self._heard = 0
        self._bus_state = BusState.ACTIVE
        self._sent_before = 0  # frames sent before bus-off; one more shows that the bus has recovered
        self._powered, self._stopping = clock.event(), clock.event()
        self._error: BaseException | None = None
        self._thread = clock.thread(target=self._run, name=f"nodes {port.config.name}")

    @property
    def failed(self) -> bool:
        """Whether an error has ended the thread; :meth:`stop` raises it."""
        return self._error is not None

    def start(self) -> None:
        """Power the nodes on in order, and return once each is on and has loaded any stored node-ID.

        If an error ends the thread, :meth:`stop` raises it.
        """
        self._thread.start()
        self._powered.wait()

    def stop(self) -> None:
        """Stop and join the thread, which powers the nodes off. Further calls have no effect.

        Raises:
            BaseException: the error that ended the thread earlier.
        """
        if self._stopping.is_set():
            return
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        except Exception:
            if error is None:  # otherwise the original error is already being raised
                raise

    def _run(self) -> None:
        try:
            now_ns = clock.monotonic_ns()
            for node in self.nodes:
                node.power_on(now_ns)
            self._powered.set()
            self._drive()
        except BaseException as error:  # stop() raises it
            self._error = error
        finally:
            self._powered.set()
            for node in self.nodes:
                node.power_off()

    def _drive(self) -> None:
        failing_since_s: float | None = None
        opened_s = clock.monotonic()
        while not self._stopping.is_set():
            moved = self._port.sent + self._heard
            try:
                self._turn()
            except BusError as error:
                # A frame that could not be sent is lost, as on any bus, and the nodes continue.
                self.bus_errors += 1
                now_s = clock.monotonic()
                if failing_since_s is None:
                    failing_since_s = opened_s = now_s
                    self.bus_error = str(error)
                if now_s - failing_since_s > OFF_AFTER_S and self._bus_state is not BusState.OFF:
                    self._set_bus_state(BusState.OFF)
                    self._sent_before = self._port.sent
                if now_s - opened_s > REOPEN_S:
                    opened_s = now_s
                    with contextlib.suppress(BusError):
                        self._port.reopen()
                self._stopping.wait(_RETRY_S)
            # An iteration without frames does not show that the bus works.
            if self._port.sent + self._heard > moved:
                failing_since_s = None
            if self._bus_state is BusState.OFF and self._port.sent > self._sent_before:
                self._set_bus_state(BusState.ACTIVE)

    def _set_bus_state(self, state: BusState) -> None:
        self._bus_state = state
        now_ns = clock.monotonic_ns()
        for node in self.nodes:
            with contextlib.suppress(BusError):  # the emergency stays queued in the node
                node.on_bus(state, now_ns)

    def _on_error_frame(self, frame: Frame) -> None:
        if self._port.config.interface == "socketcan":  # other interfaces define error frames differently
            state = bus_state(frame)
            if state is not None:
                self._set_bus_state(state)
                self._sent_before = 1 << 63  # frames queued for a bus-off controller are not sent

    def _turn(self) -> None:
        """Serve all timers and at most one frame; return when a timer is due, or after a limited wait."""
        nodes, now = self.nodes, clock.monotonic_ns
        # All nodes receive the same time, so that nodes started together share one wake-up of the thread.
        now_ns, first_ns = now(), NO_DEADLINE_NS
        silent = any(now_ns >= node.silent_from_ns for node in nodes)
        failure = self._catch_up(now_ns) if silent else None
        for node in nodes:
            deadline_ns = node.next_deadline_ns()
            if deadline_ns is not None and deadline_ns <= now_ns:
                try:
                    node.on_timer(now_ns)
                except BusError as error:
                    failure = error
                deadline_ns = node.next_deadline_ns()
            if deadline_ns is not None and deadline_ns < first_ns:
                first_ns = deadline_ns
        wait_s = min((first_ns + self._slack_ns - now()) * 1e-9, _IDLE_S)
        frame = self._port.recv(wait_s if wait_s > 0.0 else 0.0)
        if frame is not None:
            failure = self._serve(frame) or failure
        if failure is not None:
            raise failure

    def _catch_up(self, now_ns: int) -> BusError | None:
        """Serve the frames received before ``now_ns``.

        This keeps a heartbeat received in time from counting as missed if this thread was delayed.
        """
        failure: BusError | None = None
        for _ in range(_CATCH_UP_FRAMES):
            frame = self._port.recv(0.0)
            if frame is None:
                break
            failure = self._serve(frame) or failure
            if frame.t_ns >= now_ns:
                break
        return failure

    def _serve(self, frame: Frame) -> BusError | None:
        """Pass a frame to all nodes, then return a bus error if a node raised one."""
        failure: BusError | None = None
        if frame.error:
            self._on_error_frame(frame)
        elif not (frame.extended or (frame.fd and not self._fd)):
            self._heard += 1
            if self._bus_state is BusState.OFF:
                self._set_bus_state(BusState.ACTIVE)
            for node in self.nodes:
                try:
                    node.on_frame(frame.can_id, frame.data, frame.t_ns, frame.remote)
                except BusError as error:
                    failure = error
        return failure
