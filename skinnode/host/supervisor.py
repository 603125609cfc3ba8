"""Keep the nodes of a running hand operational.

A node that appears late or reappears is configured and started. A changed baseline is reread. Each node is
supervised independently of the others.

Fifty times a second, the supervisor's thread evaluates the mainline's information about each node and decides
what to do. Any operation that waits for a node, such as its configuration, runs as a job on a thread pool. A
node has at most one job at a time. LSS searches for absent nodes have threads of their own, so that no other
job waits for them; a bus carries only one such search at a time. The supervisor's thread also collects the
results of the jobs, so that no other thread accesses its state.

=========  ========================================  =========================================
phase      meaning                                   next phase
=========  ========================================  =========================================
AWAITED    node is absent or not configured          JOINING when a frame from the node arrives
JOINING    a job configures the node                 STARTING if successful, otherwise AWAITED
STARTING   the start command has been sent           RUNNING when operational; AWAITED if too late
RUNNING    the node's scans are solved               JOINING if it boots or leaves operational;
                                                     AWAITED if heartbeats are missing
=========  ========================================  =========================================

A defect is an unexpected exception raised while configuring a node, or while serving its patch in phase
STARTING or RUNNING. The patch is then faulty: its scans are withheld, and its node stays in phase AWAITED for
a pause. The pause starts at 0.1 s and doubles with each defect, up to 1 s. A failed configuration is followed
by the same kind of pause. A boot-up message from the node ends the pause early. If the node was silent or
refused, any frame from it ends the pause.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.node_supervision import NodeSupervision
from skinnode.host.remote_node import RemoteNode
from skinnode.host.supervised import LEAST_NS, NodeStats, Phase, Supervised
from skinnode.process import clock
from skinnode.process.closing import Closing

_log = logging.getLogger(__name__)

THREADS: Final = 8
"""Maximum number of parallel jobs, one per node. With more, the bus becomes the bottleneck."""

_TURN_S: Final = 0.02
"""Interval (s) between checks of all nodes."""


class Supervisor(Closing):
    """Supervisor of all nodes, running from construction until :meth:`close`.

    The supervisor also sends the host's heartbeats.

    Threads: one thread makes all decisions, and a pool runs the jobs. Any thread may call :meth:`stats`.

    Args:
        nodes: All nodes of the hand.
        running: Nodes that are already running.
        heartbeat_s: Heartbeat period (s) of the host.
        defects: Collector of exceptions that concern no particular patch.
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
        buses = {remote.link.config.name for remote in nodes}
        self._searches = clock.pool(min(THREADS, len(buses)), "search")
        self._supervision = NodeSupervision(self._pool, self._searches)
        self._thread = clock.thread(target=self._run, name="supervisor")
        self._thread.start()

    def stats(self) -> dict[str, NodeStats]:
        """Return the bring-up counters of each node, by patch name."""
        return {
            node.remote.patch.name: NodeStats(
                node.phase, node.rejoins, node.failures, node.baselines, node.complaint
            )
            for node in self._nodes
        }

    def close(self) -> None:
        """Abort running jobs, then end and join all threads."""
        self._stop.set()
        self._thread.join()
        for node in self._nodes:
            node.abandon.set()
        for pool in (self._pool, self._searches):
            pool.shutdown(cancel_futures=True)

    # --- supervisor's thread

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
        """Send the host's heartbeat on each bus where the host has a node-ID."""
        if now_ns < self._beat_ns:
            return
        self._beat_ns = max(self._beat_ns + self._heartbeat_ns, now_ns)
        for link in self._links.values():
            node_id = link.config.heartbeat_node_id
            assert node_id is not None  # the dict contains only buses on which the host has a node-ID
            try:
                link.send(od.heartbeat_cob_id(node_id), bytes([NmtState.OPERATIONAL]))
            except BusError:  # the nodes themselves detect a missing heartbeat
                continue
            except Exception as error:
                link.defects.report("sending a heartbeat", error)
