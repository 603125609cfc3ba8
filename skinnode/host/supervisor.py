"""Keep the nodes of a running hand in operation.

A node that comes back, or appears late, is configured and started; a changed baseline is read again. Nodes do
not affect each other. One thread decides fifty times a second what to do, based on the facts that the
mainline collected. Operations that wait for a node (configuration, reading a baseline) run on a pool, one job
per node at a time; the thread takes the result when the job is done, so all state has one owner.

=========  ========================================  =========================================
phase      means                                     left when
=========  ========================================  =========================================
AWAITED    absent, or not configured                 it is heard, or answers: JOINING
JOINING    a job configures it                       done: STARTING; failed: AWAITED
STARTING   it got the start command                  it is operational: RUNNING; too late: AWAITED
RUNNING    its scans are passed on                   it booted, or left operational: JOINING;
                                                     no heartbeat: AWAITED
=========  ========================================  =========================================

A defect is an exception raised while serving a patch that is STARTING or RUNNING, or while configuring it. It
makes the patch faulty: its scans are withheld, and its node is AWAITED for a pause of 0.1 s to 1 s that grows
with each defect. A node that could not be configured is likewise AWAITED. A boot-up ends the pause; after
silence or a refusal, so does any frame from the node.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.node_supervision import NodeSupervision
from skinnode.host.remote_node import RemoteNode
from skinnode.host.supervised import LEAST_NS, NodeStats, Phase, Supervised
from skinnode.process import clock

_log = logging.getLogger(__name__)

THREADS: Final = 8
"""Maximum number of nodes configured in parallel after the start; more would only wait for the bus."""

_TURN_S: Final = 0.02
"""Interval between two decisions, s."""


class Supervisor:
    """Supervisor of ``nodes`` from construction until :meth:`close`.

    It also sends the host's heartbeats. Threads: one thread decides; a pool runs jobs that wait for nodes;
    any thread may call :meth:`stats`.

    Args:
        nodes: All nodes of the hand.
        running: Nodes that are already running.
        heartbeat_s: Period of the host's heartbeat, s.
        defects: Collects exceptions that do not concern a particular patch.
    """

    def __init__(
        self,
        nodes: Sequence[RemoteNode],
        running: Sequence[RemoteNode],
        heartbeat_s: float,
        defects: Defects,
    ) -> None:
        now_ns = clock.monotonic_ns()
        self._nodes = [
            Supervised(
                remote,
                Phase.RUNNING if remote in running else Phase.AWAITED,
                now_ns,
                read_ns=now_ns + LEAST_NS,
                defects=remote.defects.count,
                baseline_ohm=None if remote.facts is None else remote.facts.baseline_ohm,
            )
            for remote in nodes
        ]
        self._links = {
            remote.link.config.name: remote.link
            for remote in nodes
            if remote.link.config.heartbeat_node_id is not None
        }
        self._heartbeat_ns, self._beat_ns = int(heartbeat_s * 1e9), now_ns
        self._defects = defects
        self._stop = clock.event()
        self._pool = clock.pool(min(THREADS, len(self._nodes)), "rejoin")
        self._supervision = NodeSupervision(self._pool)
        self._thread = clock.thread(target=self._run, name="supervisor")
        self._thread.start()

    def stats(self) -> dict[str, NodeStats]:
        """Return the statistics of each node, by patch."""
        return {
            node.remote.patch.name: NodeStats(
                node.phase, node.rejoins, node.failures, node.baselines, node.complaint
            )
            for node in self._nodes
        }

    def close(self) -> None:
        """Stop starting jobs; end and join all threads."""
        self._stop.set()
        self._thread.join()
        for node in self._nodes:
            node.abandon.set()
        self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- its thread

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "supervision")

    def _turn(self) -> bool:
        if self._stop.wait(_TURN_S):
            return False
        for node in self._nodes:
            try:
                self._supervision.look(node, clock.monotonic_ns())
            except Exception as error:  # the next iteration marks the patch as faulty
                node.upset = True
                node.remote.defects.report("supervision", error)
        self._beat(clock.monotonic_ns())
        return True

    def _beat(self, now_ns: int) -> None:
        """Send the host's heartbeat on the buses where it has a node-ID."""
        if now_ns < self._beat_ns:
            return
        self._beat_ns = max(self._beat_ns + self._heartbeat_ns, now_ns)
        for link in self._links.values():
            node_id = link.config.heartbeat_node_id
            assert node_id is not None  # only buses with such a node-ID are kept
            try:
                link.send(od.heartbeat_cob_id(node_id), bytes([NmtState.OPERATIONAL]))
            except BusError:  # nodes that miss the heartbeat report it themselves
                continue
            except Exception as error:
                link.defects.report("sending a heartbeat", error)
