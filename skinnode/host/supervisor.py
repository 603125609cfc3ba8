"""Keeps the nodes of a running hand running: who comes back is brought up again, whoever comes late is taken
up, whose baseline changed is read again. Each for itself; the others do not notice.

One thread looks fifty times a second at what the mainline has written down and decides. What waits for a
node (bring-up, reading a baseline) is done by a pool, one job a node at a time, and looked at when it is
done. So all state here has one owner.

=========  ========================================  =========================================
phase      means                                     left when
=========  ========================================  =========================================
AWAITED    not there, or not taken up                it is heard, or answers: JOINING
JOINING    a job brings it up                        done: STARTING; failed: AWAITED
STARTING   told to go operational                    it says so: RUNNING; too late: AWAITED
RUNNING    its scans go through                      booted, or in another state: JOINING;
                                                     no heartbeat: AWAITED
=========  ========================================  =========================================

A defect is an exception raised while serving a patch that is STARTING or RUNNING, or during its bring-up. It
makes the patch faulty: its scans are withheld, and it is AWAITED for a pause of 0.1 s to 1 s that grows with
each defect. A node whose bring-up failed is AWAITED likewise. Its boot-up ends the pause; after silence or a
refusal, any frame from it does.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final, Self

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError
from skinnode.host.containment import Defects, keep_on
from skinnode.host.node_supervision import NodeSupervision
from skinnode.host.remote_node import RemoteNode
from skinnode.host.supervised import LEAST_NS, NodeStats, Phase, Supervised

_log = logging.getLogger(__name__)

THREADS: Final = 8
"""Nodes brought up at the same time after the start; more would only queue for the bus."""

_TURN_S: Final = 0.02


class Supervisor:
    """Supervises ``nodes``, those of ``running`` from where they are, from construction to :meth:`close`.

    Exceptions raised while serving no patch are reported to ``defects``. The supervisor also sends the
    heartbeats of masters that have one.
    """

    def __init__(
        self,
        nodes: Sequence[RemoteNode],
        running: Sequence[RemoteNode],
        heartbeat_s: float,
        defects: Defects,
    ) -> None:
        now_ns = time.monotonic_ns()
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
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(min(THREADS, len(self._nodes)), thread_name_prefix="rejoin")
        self._supervision = NodeSupervision(self._pool)
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def stats(self) -> dict[str, NodeStats]:
        """By patch."""
        return {
            node.remote.patch.name: NodeStats(
                node.phase, node.rejoins, node.failures, node.baselines, node.complaint
            )
            for node in self._nodes
        }

    def close(self) -> None:
        """Begin nothing any more; end and join all threads."""
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
                self._supervision.look(node, time.monotonic_ns())
            except Exception as error:  # the next turn makes it faulty
                node.upset = True
                node.remote.defects.report("supervision", error)
        self._beat(time.monotonic_ns())
        return True

    def _beat(self, now_ns: int) -> None:
        """The heartbeat of a master, on the buses where it has one."""
        if now_ns < self._beat_ns:
            return
        self._beat_ns = max(self._beat_ns + self._heartbeat_ns, now_ns)
        for link in self._links.values():
            node_id = link.config.heartbeat_node_id
            assert node_id is not None  # of these
            try:
                link.send(od.heartbeat_cob_id(node_id), bytes([NmtState.OPERATIONAL]))
            except BusError:  # nodes that miss it report that themselves
                continue
            except Exception as error:
                link.defects.report("sending a heartbeat", error)
