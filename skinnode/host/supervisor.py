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

import contextlib
import logging
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Final, Self

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError, ConfigError, NodeError, NodeTimeout
from skinnode.host import nmt_master
from skinnode.host.containment import Defects, keep_on
from skinnode.host.health import HEARTBEATS_MISSED
from skinnode.host.remote_node import RemoteNode
from skinnode.host.sdo_client import Abandoned
from skinnode.host.supervised import Joined, NodeStats, Phase, Supervised
from skinnode.text.words import known

_log = logging.getLogger(__name__)

THREADS: Final = 8
"""Nodes brought up at the same time after the start; more would only queue for the bus."""

JOIN_DEADLINE_S: Final = 1.0
"""How long a node that was heard may take to answer SDO, and to tare itself."""

START_DEADLINE_S: Final = 1.0
"""How long a node may take to say that it is operational: four heartbeats."""

_TURN_S: Final = 0.02
_PROBE_NS: Final = 250_000_000
"""A node that is not there is asked for this often: its boot-up may have been lost, and one that sends no
heartbeat would never be noticed. 0.1 % of a bus for four."""
_SEARCH_NS: Final = 1_000_000_000
"""Pause between two searches by LSS for a node that is not there."""
_FORGET_NS: Final = 2_000_000_000
"""Silence after which a node is no longer reported as refused or faulty, ns."""
_LEAST_NS: Final = 300_000_000
"""Least time from one bring-up of a node to the next, for nodes that restart in a loop."""
_MUTE_NS: Final = 1_000_000_000
"""Minimum time between two readings of the configuration of a node that sends no scans."""
_DOUBT_NS: Final = 2_000_000_000
"""Minimum time between two readings of a baseline that may have changed unnoticed, ns."""
_REGISTER_NS: Final = 500_000_000
"""Minimum time between two readings of an error register that is not zero, ns. The emergency that clears an
error may be lost, and the patch must be operational within a second of it. Costs four SDO frames a second."""


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
                read_ns=now_ns + _LEAST_NS,
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
                self._look(node, time.monotonic_ns())
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

    def _look(self, node: Supervised, now_ns: int) -> None:
        count = node.remote.defects.count
        if node.upset or (count != node.defects and node.phase in (Phase.STARTING, Phase.RUNNING)):
            self._make_faulty(node, now_ns)
            return
        if count != node.defects:  # a bring-up is due anyway; exceptions from frames must not delay it
            node.defects = count
            node.complaint = node.remote.monitor.defect = node.remote.defects.newest
        match node.phase:
            case Phase.AWAITED:
                self._await(node, now_ns)
            case Phase.JOINING:
                self._join(node, now_ns)
            case Phase.STARTING:
                self._starting(node, now_ns)
            case Phase.RUNNING:
                self._watch(node, now_ns)

    def _await(self, node: Supervised, now_ns: int) -> None:
        remote, monitor = node.remote, node.remote.monitor
        booted = monitor.boot_ups != remote.boot_ups
        heard_ns = max(monitor.t_heartbeat_ns or 0, remote.t_answer_ns, monitor.t_scan_ns or 0)
        if booted or heard_ns > node.since_ns:
            at_once = (booted or node.was_silent) and now_ns >= node.begun_ns + _LEAST_NS
            if at_once or now_ns >= node.not_before_ns:
                self._begin(node, now_ns)
            return
        if now_ns - max(heard_ns, node.since_ns) > _FORGET_NS:
            monitor.refusal = monitor.defect = None  # the node is gone, whatever it was
        if remote.listen_only or remote.link.failure is not None:
            return
        if now_ns >= node.probe_ns:
            node.probe_ns = now_ns + _PROBE_NS
            with contextlib.suppress(BusError):  # a bus that is away, or full: asked again
                remote.probe()
        search_is_over = node.searching is None or node.searching.done()
        if remote.searchable and search_is_over and now_ns - max(node.search_ns, node.since_ns) > _SEARCH_NS:
            node.search_ns = now_ns
            node.searching = self._pool.submit(_search, remote)

    def _begin(self, node: Supervised, now_ns: int) -> None:
        """Have the node brought up, once no job talks to it any more: asked for again until then."""
        if node.job is not None and not node.job.done():
            node.abandon.set()
            return
        remote, abandon = node.remote, threading.Event()

        def bring_up() -> Joined | None:
            withholdings = remote.withhold()
            return Joined(remote.configure(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        remote.boot_ups = remote.monitor.boot_ups
        node.job = self._pool.submit(bring_up)
        node.abandon, node.phase, node.since_ns, node.begun_ns = abandon, Phase.JOINING, now_ns, now_ns

    def _join(self, node: Supervised, now_ns: int) -> None:
        remote, job = node.remote, node.job
        assert job is not None  # of this phase
        if remote.monitor.boot_ups != remote.boot_ups:
            node.abandon.set()  # it booted again meanwhile: what was done so far is gone
        if not job.done():
            return
        if node.abandon.is_set():
            if now_ns >= node.since_ns + _LEAST_NS:
                self._begin(node, now_ns)
            return
        node.job = None
        try:
            joined = job.result()
            assert joined is not None  # of a bring-up
            assert joined.solver is not None
            remote.start(joined.solver, joined.withholdings)
            _note_baseline(node)
        except (BusError, ConfigError) as error:
            refused = isinstance(error, (NodeError, ConfigError)) and not isinstance(error, NodeTimeout)
            self._fail(node, str(error), now_ns, refused=refused)
            return
        except Exception as error:
            node.upset = True
            remote.defects.report("bring-up", error)
            return
        node.phase, node.since_ns, node.probe_ns = Phase.STARTING, now_ns, now_ns + _PROBE_NS
        if remote.has_other_master:  # another master starts it when it likes
            self._running(node, now_ns)

    def _starting(self, node: Supervised, now_ns: int) -> None:
        remote = node.remote
        if remote.monitor.boot_ups != remote.boot_ups:
            self._begin(node, now_ns)
        elif remote.monitor.said_since(NmtState.OPERATIONAL, node.since_ns):
            self._running(node, now_ns)
        elif remote.link.t_dispatched_ns > node.since_ns + START_DEADLINE_S * 1e9:
            silent = remote.monitor.nmt_state == NmtState.OPERATIONAL  # its state before the command
            self._fail(node, _not_started(remote, silent=silent), now_ns, refused=not silent)
        elif now_ns >= node.probe_ns:  # NMT commands are unconfirmed: it may have been lost
            node.probe_ns = now_ns + _PROBE_NS
            with contextlib.suppress(BusError):
                nmt_master.start(remote.link.send, remote.patch.node_id)

    def _running(self, node: Supervised, now_ns: int) -> None:
        remote = node.remote
        node.phase, node.since_ns, node.complaint = Phase.RUNNING, now_ns, None
        node.unconfigured = False
        node.read_ns = now_ns + _LEAST_NS
        node.rejoins += 1
        remote.monitor.rejoins = node.rejoins
        remote.monitor.refusal = remote.monitor.defect = None
        remote.monitor.complaint = None
        _log.warning("node %d (%s) was brought up and runs", remote.patch.node_id, remote.patch.name)

    def _fail(self, node: Supervised, complaint: str, now_ns: int, *, refused: bool) -> None:
        if complaint != node.complaint:
            _log.warning("%s; tried again", complaint)
        node.failures += 1
        node.complaint = complaint
        monitor = node.remote.monitor
        monitor.complaint = complaint
        monitor.refusal = complaint if refused else None
        monitor.running = monitor.running and not refused  # it may be somebody else's now
        self._await_again(node, now_ns, was_silent=True)  # or refused: it may be another node by now

    def _make_faulty(self, node: Supervised, now_ns: int) -> None:
        """Make a patch faulty after a defect. Repeated at the next turn if it raises."""
        remote = node.remote
        count = remote.defects.count
        node.abandon.set()
        node.failures += 1
        node.complaint = remote.monitor.defect = remote.defects.newest
        remote.link.call(remote.stream.withhold, remote.defects)
        self._await_again(node, now_ns, was_silent=False)
        node.defects, node.upset = count, False

    def _await_again(self, node: Supervised, now_ns: int, *, was_silent: bool) -> None:
        node.phase, node.since_ns, node.was_silent = Phase.AWAITED, now_ns, was_silent
        node.not_before_ns = now_ns + int(node.pause.next_s() * 1e9)

    def _watch(self, node: Supervised, now_ns: int) -> None:
        remote, monitor = node.remote, node.remote.monitor
        said_ns = monitor.t_heartbeat_ns or 0
        if monitor.boot_ups != remote.boot_ups:
            self._begin(node, now_ns)
            return
        if (
            not remote.has_other_master
            and monitor.nmt_state != NmtState.OPERATIONAL
            and said_ns > node.since_ns
        ):
            self._begin(node, now_ns)
            if (
                node.phase is Phase.RUNNING
                and monitor.nmt_state == NmtState.STOPPED
                and now_ns >= node.probe_ns
            ):
                node.probe_ns = now_ns + _PROBE_NS  # a job waits for a response that it does not send
                with contextlib.suppress(BusError):
                    nmt_master.stand_by(remote.link.send, remote.patch.node_id)
            if node.phase is Phase.JOINING:
                _log.warning(
                    "node %d (%s) left NMT state %d for %s without the host's doing",
                    remote.patch.node_id,
                    remote.patch.name,
                    NmtState.OPERATIONAL,
                    monitor.nmt_state,
                )
            return
        patience_ns = HEARTBEATS_MISSED * remote.heartbeat_s * 1e9
        if remote.link.t_dispatched_ns > max(said_ns, node.since_ns) + patience_ns and not remote.listen_only:
            _log.warning("node %d (%s) is lost: no heartbeat", remote.patch.node_id, remote.patch.name)
            node.phase, node.since_ns, node.not_before_ns = Phase.AWAITED, now_ns, 0
            remote.link.call(remote.stream.withhold, remote.defects)  # until its state is known
            return
        if node.unconfigured:
            node.unconfigured = False
            _log.warning("node %d (%s) lost its configuration", remote.patch.node_id, remote.patch.name)
            self._begin(node, now_ns)
            return
        if node.job is None and now_ns >= node.mute_ns and remote.is_mute(node.since_ns):
            node.mute_ns = now_ns + _MUTE_NS
            node.job = self._pool.submit(_read_back, node)
            return
        self._watch_baseline(node, now_ns)

    def _watch_baseline(self, node: Supervised, now_ns: int) -> None:
        """Read it again where the node said that it changed, or may have said so in a summary that was
        lost. In the first case scans are withheld until then."""
        remote, stream, job = node.remote, node.remote.stream, node.job
        if job is not None:
            if job.done():
                node.job = None
                self._take_baseline(node, job, now_ns)
            return
        changed = stream.withholding
        node.announced |= changed
        if not (changed or stream.doubtful) or now_ns < node.read_ns:
            self._watch_register(node, now_ns)
            return
        if remote.listen_only:
            if changed:
                remote.monitor.refusal = "its baseline changed; a guest that sends nothing cannot read it"
            return
        stream.doubtful = False
        abandon = node.abandon = threading.Event()

        def read() -> Joined | None:
            withholdings = remote.withhold() if changed else stream.withholdings
            return Joined(remote.renew_baseline(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        node.job = self._pool.submit(read)

    def _watch_register(self, node: Supervised, now_ns: int) -> None:
        """Ask a node with an error for its error register: the emergency that ended it may have been lost."""
        remote = node.remote
        if not remote.monitor.error_register or remote.listen_only or now_ns < node.register_ns:
            return

        def read() -> Joined | None:
            with contextlib.suppress(BusError, ConfigError):  # asked again
                remote.renew_register()
            return None

        node.register_ns = now_ns + _REGISTER_NS
        node.job = self._pool.submit(read)

    def _take_baseline(self, node: Supervised, job: Future[Joined | None], now_ns: int) -> None:
        if job.exception() is None and job.result() is None:  # it was the error register
            return
        remote, stream = node.remote, node.remote.stream
        node.read_ns = now_ns + (_LEAST_NS if stream.withholding else _DOUBT_NS)
        try:
            read = job.result()
        except (BusError, ConfigError) as error:  # if the node is gone, its silence will show
            stream.doubtful = True
            _log.warning("%s; its baseline is read again", error)
            return
        except Abandoned:
            return
        except Exception as error:
            remote.defects.report("reading the baseline or the error register", error)
            return
        assert read is not None  # see above
        solver = read.solver
        if solver is not None:
            remote.link.call(lambda: stream.resume(solver, read.withholdings, anew=False), remote.defects)
            node.announced = True  # or found after a lost summary
            _note_baseline(node)


def _note_baseline(node: Supervised) -> None:
    """Note with which baseline the scans are solved now. A bring-up finds a new one too: after a reading that
    failed, or if it changed while the node was away."""
    facts, before = node.remote.facts, node.baseline_ohm
    assert facts is not None  # of a node that was brought up
    node.baseline_ohm = facts.baseline_ohm
    if node.announced or (before is not None and not np.array_equal(before, facts.baseline_ohm)):
        node.announced = False
        node.baselines += 1
        node.remote.monitor.baselines = node.baselines


def _read_back(node: Supervised) -> None:
    """Find out whether a node that sends no scans lost its configuration."""
    with contextlib.suppress(BusError, ConfigError):  # asked again
        node.unconfigured = not node.remote.is_configured()


def _search(remote: RemoteNode) -> bool:
    """Search for the patch by LSS. Returns whether it was found."""
    try:
        return remote.search()
    except Exception as error:
        remote.defects.report("search by LSS", error)
        return False


def _not_started(remote: RemoteNode, *, silent: bool) -> str:
    """Return why a node does not count as started."""
    node = f"node {remote.patch.node_id}"
    if silent:
        return f"{node}: got no heartbeat within {START_DEADLINE_S:g} s of the start command, allowed: one"
    state = known(remote.monitor.nmt_state)
    return f"{node}: got NMT state {state} after the start command, allowed: {NmtState.OPERATIONAL:d}"
