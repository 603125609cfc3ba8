"""Runs nodes that share a CAN port in one thread."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from types import TracebackType
from typing import Final, Self

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.errors import BusError
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.patch.patch_node import PatchNode
from skinnode.process import clock
from skinnode.transport.bus_state import BusState, bus_state
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

_IDLE_S: Final = 0.1
"""Maximum time (s) for which the thread waits for a frame before it checks whether it must stop."""

_RETRY_S: Final = 0.02
"""Pause (s) after a bus error; long enough for a full transmit queue to drain."""

_CATCH_UP_FRAMES: Final = 4096
"""Maximum number of queued frames to handle before a heartbeat is reported as missed. A fully loaded 1 Mbit/s
bus carries this many frames in half a second."""

OFF_AFTER_S: Final = 0.1
"""Duration (s) of continuous bus errors after which the nodes assume that their CAN controller is bus-off. A
full transmit queue drains in less time."""

REOPEN_S: Final = 1.0
"""Duration (s) of continuous bus errors after which the CAN interface is reopened. This recovers an interface
that was unplugged and plugged in again."""


class NodeRunner:
    """Runs a group of nodes from :meth:`start` until :meth:`stop`. A runner can be started only once.

    Bus errors do not stop the runner. While it runs, other threads may only read the counters of its nodes.
    All timers have the precision required by the most demanding node. The caller must close the port.

    Args:
        port: CAN port that the nodes share.
        nodes: Nodes to run.

    Raises:
        ValueError: If there are no nodes or two nodes have the same node-ID.
    """

    def __init__(self, port: CanPort, nodes: Iterable[PatchNode]) -> None:
        self._port = port
        self._fd = port.config.fd
        self.nodes = tuple(nodes)
        if not self.nodes:
            raise ValueError("nodes: got none, must contain at least one")
        ids = [node.node_id for node in self.nodes if node.node_id != NOT_CONFIGURED]
        if len(set(ids)) < len(ids):
            raise ValueError(f"nodes: got node-IDs {sorted(ids)}, must all be different")
        self._slack_ns = min(node.pacing.slack_ns for node in self.nodes)
        self.bus_errors = 0
        """Number of bus errors since the runner was created."""
        self.bus_error = ""
        """One-line description of the first error in the latest series of bus errors; empty if there has been
        none."""
        self._deadlines_ns = [NO_DEADLINE_NS] * len(self.nodes)  # as of the end of the last turn
        self._heard = 0
        self._bus_state = BusState.ACTIVE
        # Number of frames that the port had sent when bus-off began. Any frame sent later proves recovery.
        self._sent_before = 0
        self._powered, self._stopping = clock.event(), clock.event()
        self._stopped = False
        self._error: BaseException | None = None
        self._thread = clock.thread(target=self._run, name=f"nodes {port.config.name}")

    @property
    def failed(self) -> bool:
        """Whether an error has ended the thread. :meth:`stop` raises this error."""
        return self._error is not None

    def start(self) -> None:
        """Start the thread and return once all nodes have been powered on.

        :meth:`stop` raises any error that ends the thread.
        """
        self._thread.start()
        self._powered.wait()

    def request_stop(self) -> None:
        """Request that the thread end within 0.1 s, without waiting for it. Call :meth:`stop` afterwards."""
        self._stopping.set()

    def stop(self) -> None:
        """Power the nodes off and end the thread. Repeated calls have no effect.

        Raises:
            BaseException: The error that ended the thread, if any.
        """
        if self._stopped:
            return
        self._stopped = True
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
            if error is None:  # an error from the ``with`` block takes precedence
                raise

    def _run(self) -> None:
        try:
            now_ns = clock.monotonic_ns()
            for node in self.nodes:
                node.power_on(now_ns)
            self._powered.set()
            self._drive()
        except BaseException as error:  # stop() raises this error
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
                # The frame is lost and the nodes continue, as they would on a board.
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
            # Only sending or receiving a frame proves that the bus works.
            if self._port.sent + self._heard > moved:
                failing_since_s = None
            if self._bus_state is BusState.OFF and self._port.sent > self._sent_before:
                self._set_bus_state(BusState.ACTIVE)

    def _set_bus_state(self, state: BusState) -> None:
        self._bus_state = state
        now_ns = clock.monotonic_ns()
        for node in self.nodes:
            with contextlib.suppress(BusError):  # the emergency message stays queued
                node.on_bus(state, now_ns)

    def _on_error_frame(self, frame: Frame) -> None:
        # Only SocketCAN encodes the controller state in error frames.
        if self._port.config.interface == "socketcan":
            state = bus_state(frame)
            if state is not None:
                self._set_bus_state(state)
                self._sent_before = 1 << 63  # a frame that is counted as sent may still be queued

    def _turn(self) -> None:
        """Handle the timers that are due, then wait for a frame or the next timer."""
        nodes, now = self.nodes, clock.monotonic_ns
        # All nodes are given the same time, so that one wake-up serves nodes that were started together.
        now_ns, first_ns = now(), NO_DEADLINE_NS
        silent = any(now_ns >= node.silent_from_ns for node in nodes)
        failure = self._catch_up(now_ns) if silent else None
        for number, node in enumerate(nodes):
            # A frame may have postponed the deadline since the last turn. The call to on_timer() then has no
            # effect, which costs less than querying every deadline again.
            deadline_ns = self._deadlines_ns[number]
            if deadline_ns > now_ns:
                deadline_ns = _deadline_ns(node)
            if deadline_ns <= now_ns:
                try:
                    node.on_timer(now_ns)
                except BusError as error:
                    failure = error
                deadline_ns = _deadline_ns(node)
            self._deadlines_ns[number] = deadline_ns
            first_ns = min(first_ns, deadline_ns)
        wait_s = min((first_ns + self._slack_ns - now()) * 1e-9, _IDLE_S)
        frame = self._port.recv(wait_s if wait_s > 0.0 else 0.0)
        if frame is not None:
            failure = self._serve(frame) or failure
        if failure is not None:
            raise failure

    def _catch_up(self, now_ns: int) -> BusError | None:
        """Handle the queued frames that arrived before ``now_ns``.

        If this thread is late, a heartbeat that arrived in time may still be queued. It would be reported as
        missed if the timers were handled first.
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
        """Pass a frame to all nodes. Return the last BusError that a node raised, or None."""
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


def _deadline_ns(node: PatchNode) -> int:
    deadline_ns = node.next_deadline_ns()
    return NO_DEADLINE_NS if deadline_ns is None else deadline_ns
