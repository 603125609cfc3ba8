"""Drives nodes on a bus: one thread for all boards that share an endpoint."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterable
from types import TracebackType
from typing import Final, Self

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.errors import BusError
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.patch.patch_node import PatchNode
from skinnode.transport.bus_state import BusState, bus_state
from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort

_IDLE_S: Final = 0.1
"""Longest wait for a frame: how soon the thread sees that it should end."""

_RETRY_S: Final = 0.02
"""Pause after an error of the bus: a queue that was full has drained by then."""

_CATCH_UP_FRAMES: Final = 4096
"""Frames that are heard before somebody is called silent: half a second of a full bus at 1 Mbit/s."""

OFF_AFTER_S: Final = 0.1
"""A bus on which everything has failed for this long is off to the nodes: a full queue drains sooner."""

REOPEN_S: Final = 1.0
"""An interface that does nothing but fail for this long may be another one by now, plugged in again: it is
opened anew, and again after as long."""


class NodeRunner:
    """Powers ``nodes`` on and keeps them going until :meth:`stop`.

    Raises ValueError for no nodes, or for two with the same node-ID; any number may have none yet. A runner
    runs once. It does not end because of the bus, however long that is away. The nodes belong to the thread
    from :meth:`start` to :meth:`stop`; only counters may be looked at meanwhile. The port stays open. Timers
    are kept as closely as the most exact of the nodes wants it.
    """

    def __init__(self, port: CanPort, nodes: Iterable[PatchNode]) -> None:
        self._port = port
        self._fd = port.config.fd
        self.nodes = tuple(nodes)
        if not self.nodes:
            raise ValueError("nodes: got none, must be at least one")
        ids = [node.node_id for node in self.nodes if node.node_id != NOT_CONFIGURED]
        if len(set(ids)) < len(ids):
            raise ValueError(f"nodes: got node-IDs {sorted(ids)}, must differ")
        self._slack_ns = min(node.pacing.slack_ns for node in self.nodes)
        self.bus_errors = 0
        """Errors of the bus that the nodes got over."""
        self.bus_error = ""
        """What they began with the last time, in one line."""
        self._heard = 0
        self._bus_state = BusState.ACTIVE
        self._sent_before = 0  # frames, when everything had begun to fail: one more, and the bus is back
        self._powered, self._stopping = threading.Event(), threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"nodes {port.config.name}", daemon=True)

    @property
    def failed(self) -> bool:
        """Whether the thread has ended by an error; :meth:`stop` raises it."""
        return self._error is not None

    def start(self) -> None:
        """Power on, in the order of the nodes, and return when they have their node-IDs; what goes wrong is
        raised by :meth:`stop`."""
        self._thread.start()
        self._powered.wait()

    def stop(self) -> None:
        """End and join the thread; the nodes are off. Raises what ended the thread before, and does nothing
        when called again."""
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
            if error is None:  # otherwise what went wrong first is on its way already
                raise

    def _run(self) -> None:
        try:
            now_ns = time.monotonic_ns()
            for node in self.nodes:
                node.power_on(now_ns)
            self._powered.set()
            self._drive()
        except BaseException as error:  # whatever it is, it belongs to whoever calls stop()
            self._error = error
        finally:
            self._powered.set()
            for node in self.nodes:
                node.power_off()

    def _drive(self) -> None:
        failing_since_s: float | None = None
        opened_s = time.monotonic()
        while not self._stopping.is_set():
            moved = self._port.sent + self._heard
            try:
                self._turn()
            except BusError as error:
                # What could not be sent is lost, as on any bus; the nodes go on.
                self.bus_errors += 1
                now_s = time.monotonic()
                if failing_since_s is None:
                    failing_since_s = opened_s = now_s
                    self.bus_error = str(error)
                if now_s - failing_since_s > OFF_AFTER_S and self._bus_state is not BusState.OFF:
                    self._tell(BusState.OFF)
                    self._sent_before = self._port.sent
                if now_s - opened_s > REOPEN_S:
                    opened_s = now_s
                    with contextlib.suppress(BusError):
                        self._port.reopen()
                self._stopping.wait(_RETRY_S)
            if self._port.sent + self._heard > moved:  # a turn with nothing to do proves nothing
                failing_since_s = None
            if self._bus_state is BusState.OFF and self._port.sent > self._sent_before:
                self._tell(BusState.ACTIVE)

    def _tell(self, state: BusState) -> None:
        self._bus_state = state
        now_ns = time.monotonic_ns()
        for node in self.nodes:
            with contextlib.suppress(BusError):  # the emergency waits in the node
                node.on_bus(state, now_ns)

    def _on_error_frame(self, frame: Frame) -> None:
        if self._port.config.interface == "socketcan":  # others put other things into them
            state = bus_state(frame)
            if state is not None:
                self._tell(state)
                self._sent_before = 1 << 63  # frames queued for a controller that is off are not sent

    def _turn(self) -> None:
        """Serve all nodes and at most one frame; returns when there is something to do, or now and then."""
        nodes, clock = self.nodes, time.monotonic_ns
        # One time for all: nodes that started together stay together, and the thread wakes once for all.
        now_ns, first_ns = clock(), NO_DEADLINE_NS
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
        wait_s = min((first_ns + self._slack_ns - clock()) * 1e-9, _IDLE_S)
        frame = self._port.recv(wait_s if wait_s > 0.0 else 0.0)
        if frame is not None:
            failure = self._serve(frame) or failure
        if failure is not None:
            raise failure

    def _catch_up(self, now_ns: int) -> BusError | None:
        """Serve the frames that came before ``now_ns``: a heartbeat that came in time has not been missed,
        whatever kept this thread from hearing it."""
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
        """Give a frame to all nodes. An error of one is returned, the others are served all the same."""
        failure: BusError | None = None
        if frame.error:
            self._on_error_frame(frame)
        elif not (frame.extended or (frame.fd and not self._fd)):
            self._heard += 1
            if self._bus_state is BusState.OFF:
                self._tell(BusState.ACTIVE)
            for node in self.nodes:
                try:
                    node.on_frame(frame.can_id, frame.data, frame.t_ns, frame.remote)
                except BusError as error:
                    failure = error
        return failure
