"""Configure the nodes of a hand in parallel and make them operational."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Final

from skinnode.canopen.nmt import NmtState
from skinnode.config import BusConfig, Missing, PatchConfig
from skinnode.errors import BusError, NodeError, NodeTimeout, SkinError
from skinnode.host import nmt_master
from skinnode.host.node_supervision import start_deadline_s
from skinnode.host.remote_node import RemoteNode
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sdo_client import Abandoned
from skinnode.process import clock
from skinnode.text.words import known

BRING_UP_THREADS: Final = 16
"""Maximum number of nodes configured in parallel. With more, the bus becomes the bottleneck."""

_BRING_UPS: Final = 3
"""Maximum number of attempts to configure a node. An attempt is repeated after an unexpected exception or a
boot-up of the node. The node boots, for example, after LSS has set its node-ID.
"""

_START_AGAIN_NAPS: Final = 50
"""Number of polling intervals (0.25 s in total) between repetitions of the start command. NMT commands are
unconfirmed and may be lost.
"""

_POLL_S: Final = 0.005


class BringUpCancelled(SkinError):
    """Raised when the caller cancels bring-up."""


class _Defective(NodeError):
    """Raised if the last attempt to configure a node ended with an unexpected exception."""


def go_on_unless(cancelled: Callable[[], bool]) -> None:
    """Raise BringUpCancelled if ``cancelled`` returns True."""
    if cancelled():
        raise BringUpCancelled("bring-up was cancelled")


def configure_all(
    nodes: Sequence[RemoteNode], missing: Missing, deadline_s: float, cancelled: Callable[[], bool]
) -> dict[RemoteNode, ScanSolver]:
    """Configure all nodes in parallel.

    The first failure stops the other configurations at their next transfer.

    Args:
        nodes: Nodes to configure.
        missing: ``wait`` if a silent node may join later, ``refuse`` if every node must respond.
        deadline_s: Time limit (s) for a node's first response.
        cancelled: Function polled during configuration. If it returns True, configuration stops.

    Returns:
        Solvers of the configured nodes, by node.

    Raises:
        NodeTimeout: if a node does not respond and ``missing`` is ``refuse``.
        BusError: if no node on a bus responds and ``missing`` is ``refuse``, or a frame cannot be sent.
        BringUpCancelled: if ``cancelled`` returned True.
    """
    return _Start(nodes, missing, deadline_s, cancelled).run()


class _Start:
    """Configuration of several nodes on a thread pool."""

    def __init__(
        self, nodes: Sequence[RemoteNode], missing: Missing, deadline_s: float, cancelled: Callable[[], bool]
    ) -> None:
        self._nodes, self._waits, self._deadline_s = nodes, missing == "wait", deadline_s
        self._cancelled = cancelled
        self._over = clock.event()
        self._answered: list[PatchConfig] = []

    def run(self) -> dict[RemoteNode, ScanSolver]:
        """Configure the nodes. Return the solver of each configured node."""
        threads = min(len(self._nodes), BRING_UP_THREADS)
        with clock.pool(threads, "bring-up") as pool:
            try:
                jobs = {node: pool.submit(self._configure, node) for node in self._nodes}
                self._wait_for(jobs)
            finally:  # after a failure or Ctrl-C, stop the other jobs
                self._over.set()
                pool.shutdown(cancel_futures=True)
        solvers = {node: self._result(node, job) for node, job in jobs.items()}
        go_on_unless(self._cancelled)
        return {node: solver for node, solver in solvers.items() if solver is not None}

    def _abandoned(self) -> bool:
        return self._over.is_set() or self._cancelled()

    def _configure(self, node: RemoteNode) -> ScanSolver:
        if node.listen_only:
            _listen(node, self._deadline_s, self._abandoned)
            self._answered.append(node.patch)
        for left in reversed(range(_BRING_UPS)):
            try:
                solver = node.configure(self._deadline_s, self._abandoned, self._answered.append)
                if not left or node.monitor.boot_ups == node.boot_ups:
                    return solver
            except BusError:
                booted = node.monitor.boot_ups != node.boot_ups
                if not left or node.patch not in self._answered or not booted:
                    raise
            except (SkinError, Abandoned):
                raise
            except Exception as error:
                node.defects.report("bring-up", error)
                if not left:
                    patch = node.patch
                    text = f"patch {patch.name!r} on {patch.bus}: {node.defects.newest}"
                    raise _Defective(patch.node_id, text) from error
        raise AssertionError("the last attempt returns or raises")

    def _may_join_later(self, node: RemoteNode, failure: BaseException) -> bool:
        silent = isinstance(failure, NodeTimeout) and node.patch not in self._answered
        return self._waits and (silent or isinstance(failure, _Defective))

    def _wait_for(self, jobs: dict[RemoteNode, Future[ScanSolver]]) -> None:
        """Wait until all jobs have ended, or one has failed in a way that prevents the start."""
        ended: SimpleQueue[RemoteNode] = clock.simple_queue()

        def put_when_done(node: RemoteNode) -> Callable[[Future[ScanSolver]], None]:
            return lambda _: ended.put(node)

        for node, job in jobs.items():
            job.add_done_callback(put_when_done(node))
        for _ in jobs:
            node = ended.get()
            failure = jobs[node].exception()
            if failure is not None and not self._may_join_later(node, failure):
                break

    def _result(self, node: RemoteNode, job: Future[ScanSolver]) -> ScanSolver | None:
        """Return the solver of a node; None if the node may join later.

        An error that prevents the start is raised.
        """
        failure = None if job.cancelled() else job.exception()
        if job.cancelled() or isinstance(failure, Abandoned):
            return None
        if failure is None:
            return job.result()
        if self._may_join_later(node, failure):
            return None
        if isinstance(failure, NodeTimeout) and node.patch not in self._answered:
            raise _silence(node, self._nodes, self._answered, self._deadline_s) from None
        raise failure


def start_all(ready: dict[RemoteNode, ScanSolver]) -> None:
    """Start the nodes on buses where the host is the master, and wait until they report operational.

    The time limit is counted in polling intervals, so that it excludes any time during which the computer is
    suspended.

    Raises:
        NodeTimeout: if a node does not report operational in time.
    """
    t_start_ns = clock.monotonic_ns()
    for node, solver in ready.items():
        node.start(solver, node.stream.withholdings)
    deadline_s = max(map(start_deadline_s, ready), default=0.0)
    naps = round(deadline_s / _POLL_S)
    for node in ready:
        patch, monitor = node.patch, node.monitor
        while not node.has_other_master and not monitor.said_since(NmtState.OPERATIONAL, t_start_ns):
            if naps == 0:
                raise NodeTimeout(
                    patch.node_id,
                    f"patch {patch.name!r} on {patch.bus}: got NMT state {known(monitor.nmt_state)} after "
                    f"the start command, expected {NmtState.OPERATIONAL:d} (operational) within "
                    f"{deadline_s:g} s",
                )
            naps -= 1
            if naps % _START_AGAIN_NAPS == 0:
                nmt_master.start(node.link.send, patch.node_id)
            clock.sleep(_POLL_S)


def _listen(node: RemoteNode, deadline_s: float, abandoned: Callable[[], bool]) -> None:
    """Wait for a frame from a node to which the host must not send. Raise NodeTimeout if none arrives."""
    end_s = clock.monotonic() + deadline_s
    while not node.heard:
        if abandoned():
            raise Abandoned
        if clock.monotonic() > end_s:
            patch = node.patch
            raise NodeTimeout(
                patch.node_id,
                f"patch {patch.name!r} on {patch.bus}: received nothing within {deadline_s:g} s",
            )
        clock.sleep(_POLL_S)


def _silence(
    node: RemoteNode, nodes: Sequence[RemoteNode], answered: list[PatchConfig], deadline_s: float
) -> BusError:
    """Return the error for a node that does not respond.

    If no node on the bus responds, the cause is probably the cable, the supply or the bit rate, so the error
    names the bus.
    """
    bus, patch = node.bus, node.patch
    on_bus = [other.patch for other in nodes if other.bus is bus]
    silent = [other for other in on_bus if other not in answered]
    names = ", ".join(f"{other.node_id} ({other.name})" for other in silent)
    if len(silent) == len(on_bus):
        return BusError(
            f"{bus.name}: interface {bus.interface!r}, channel {bus.channel!r}: no response within "
            f"{deadline_s:g} s from any node: {names}{_of_one_process(bus)}"
        )
    return NodeTimeout(
        patch.node_id,
        f"patch {patch.name!r} on {bus.name}: no response within {deadline_s:g} s from {names}",
    )


def _of_one_process(bus: BusConfig) -> str:
    """Return a hint for an error message if nodes in another process cannot be reached on the bus."""
    in_process = bus.interface == "virtual"
    return "; the interface 'virtual' connects only nodes in the same process" if in_process else ""
