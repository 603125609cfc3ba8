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
"""

from __future__ import annotations

import contextlib
import enum
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final, Self

from skinnode.errors import BusError, ConfigError, NodeError, NodeTimeout, SkinError
from skinnode.host.bringup import Abandoned
from skinnode.host.health import HEARTBEATS_MISSED, OPERATIONAL
from skinnode.host.pipeline import Solver
from skinnode.host.station import Station
from skinnode.wire import indices as od

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
_RETRY_NS: Final = 400_000_000
"""Pause after a bring-up that failed: the stream is to be back within a second of the cause going away."""
_FORGET_NS: Final = 2_000_000_000
"""A node that has been silent for so long is no longer said to be refused."""
_LEAST_NS: Final = 300_000_000
"""Least time from one bring-up of a node to the next, for nodes that restart in a loop."""
_DOUBT_NS: Final = 2_000_000_000
"""Least time between two readings of a baseline, or an error register, that may have changed unseen."""


class Phase(enum.StrEnum):
    """Where the supervisor has a node."""

    AWAITED = "awaited"
    JOINING = "joining"
    STARTING = "starting"
    RUNNING = "running"


@dataclass(frozen=True, slots=True)
class NodeStats:
    """What the supervisor did about a node."""

    phase: Phase
    rejoins: int
    """Bring-ups after the start that ended with the node running."""
    failures: int
    """Those that did not."""
    baselines: int
    """Times its baseline had changed and was read anew."""
    complaint: str | None
    """Why the last bring-up failed; None where it did not."""


@dataclass(frozen=True, slots=True)
class _Joined:
    """What a job brings back."""

    solver: Solver | None
    withholdings: int


@dataclass(slots=True)
class _Node:
    """State of one node; of the supervisor's thread alone."""

    station: Station
    phase: Phase
    since_ns: int
    job: Future[_Joined | None] | None = None
    """The one that talks to the node; without a result where it only asks for the error register."""
    searching: Future[bool] | None = None
    abandon: threading.Event = field(default_factory=threading.Event)
    """Tells the job to stop where it is."""
    not_before_ns: int = 0
    probe_ns: int = 0
    search_ns: int = 0
    read_ns: int = 0
    register_ns: int = 0
    rejoins: int = 0
    failures: int = 0
    baselines: int = 0
    complaint: str | None = None


class Supervisor:
    """Supervises ``stations``, those of ``running`` from where they are, from construction to :meth:`close`.

    ``on_failure`` is told of a defect of its own. It sends the heartbeat of a master that has one.
    """

    def __init__(
        self,
        stations: Sequence[Station],
        running: Sequence[Station],
        heartbeat_s: float,
        on_failure: Callable[[SkinError], None],
    ) -> None:
        now_ns = time.monotonic_ns()
        self._nodes = [
            _Node(
                station,
                Phase.RUNNING if station in running else Phase.AWAITED,
                now_ns,
                read_ns=now_ns + _LEAST_NS,
            )
            for station in stations
        ]
        self._links = {
            station.link.config.name: station.link
            for station in stations
            if station.link.config.heartbeat_node_id is not None
        }
        self._heartbeat_ns, self._beat_ns = int(heartbeat_s * 1e9), now_ns
        self._on_failure = on_failure
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(min(THREADS, len(self._nodes)), thread_name_prefix="rejoin")
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def stats(self) -> dict[str, NodeStats]:
        """By patch."""
        return {
            node.station.patch.name: NodeStats(
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
        try:
            while not self._stop.wait(_TURN_S):
                self._beat(time.monotonic_ns())
                for node in self._nodes:
                    self._look(node, time.monotonic_ns())
        except Exception as error:  # a defect of ours: it must reach the user, not die with the thread
            _log.debug("supervisor", exc_info=True)
            failure = SkinError(f"supervisor: {type(error).__name__}: {error}")
            failure.__cause__ = error
            self._on_failure(failure)

    def _beat(self, now_ns: int) -> None:
        """The heartbeat of a master, on the buses where it has one."""
        if now_ns < self._beat_ns:
            return
        self._beat_ns = max(self._beat_ns + self._heartbeat_ns, now_ns)
        for link in self._links.values():
            node_id = link.config.heartbeat_node_id
            assert node_id is not None  # of these
            with contextlib.suppress(BusError):  # the nodes that do not hear it will say so
                link.send(od.heartbeat_cob_id(node_id), bytes([OPERATIONAL]))

    def _look(self, node: _Node, now_ns: int) -> None:
        match node.phase:
            case Phase.AWAITED:
                self._await(node, now_ns)
            case Phase.JOINING:
                self._join(node, now_ns)
            case Phase.STARTING:
                self._starting(node, now_ns)
            case Phase.RUNNING:
                self._watch(node, now_ns)

    def _await(self, node: _Node, now_ns: int) -> None:
        station, monitor = node.station, node.station.monitor
        booted = monitor.boot_ups != station.boot_ups
        if now_ns < node.not_before_ns and not (booted and now_ns >= node.since_ns + _LEAST_NS):
            return
        heard_ns = max(monitor.t_heartbeat_ns or 0, station.t_answer_ns)
        if station.is_silent:
            heard_ns = max(heard_ns, monitor.t_scan_ns or 0)
        if booted or heard_ns > node.since_ns:
            self._begin(node, now_ns)
            return
        if now_ns - max(heard_ns, node.since_ns) > _FORGET_NS:
            monitor.refusal = None  # whatever it was, it is gone
        if station.is_silent or station.link.failure is not None:
            return
        if now_ns >= node.probe_ns:
            node.probe_ns = now_ns + _PROBE_NS
            with contextlib.suppress(BusError):  # a bus that is away, or full: asked again
                station.probe()
        search_is_over = node.searching is None or node.searching.done()
        if station.searchable and search_is_over and now_ns - max(node.search_ns, node.since_ns) > _SEARCH_NS:
            node.search_ns = now_ns
            node.searching = self._pool.submit(station.search)

    def _begin(self, node: _Node, now_ns: int) -> None:
        """Have the node brought up, once no job talks to it any more: asked for again until then."""
        if node.job is not None and not node.job.done():
            node.abandon.set()
            return
        station, abandon = node.station, threading.Event()

        def bring_up() -> _Joined | None:
            withholdings = station.withhold()
            return _Joined(station.bring_up(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        station.boot_ups = station.monitor.boot_ups
        node.abandon, node.phase, node.since_ns = abandon, Phase.JOINING, now_ns
        node.job = self._pool.submit(bring_up)

    def _join(self, node: _Node, now_ns: int) -> None:
        station, job = node.station, node.job
        assert job is not None  # of this phase
        if station.monitor.boot_ups != station.boot_ups:
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
            station.start(joined.solver, joined.withholdings)
        except (BusError, ConfigError) as error:
            refused = isinstance(error, (NodeError, ConfigError)) and not isinstance(error, NodeTimeout)
            self._fail(node, str(error), now_ns, refused=refused)
            return
        node.phase, node.since_ns = Phase.STARTING, now_ns
        if station.is_guest:  # another master starts it when it likes
            self._running(node, now_ns)

    def _starting(self, node: _Node, now_ns: int) -> None:
        station = node.station
        if station.monitor.boot_ups != station.boot_ups:
            self._begin(node, now_ns)
        elif station.monitor.said_since(OPERATIONAL, node.since_ns):
            self._running(node, now_ns)
        elif station.link.t_dealt_ns > node.since_ns + START_DEADLINE_S * 1e9:
            state = station.monitor.nmt_state
            text = f"node {station.patch.node_id}: got NMT state {state} after the start command, allowed: 5"
            self._fail(node, text, now_ns, refused=True)

    def _running(self, node: _Node, now_ns: int) -> None:
        station = node.station
        node.phase, node.since_ns, node.complaint = Phase.RUNNING, now_ns, None
        node.read_ns = now_ns + _LEAST_NS
        node.rejoins += 1
        station.monitor.rejoins, station.monitor.refusal = node.rejoins, None
        _log.warning("node %d (%s) was brought up and runs", station.patch.node_id, station.patch.name)

    def _fail(self, node: _Node, complaint: str, now_ns: int, *, refused: bool) -> None:
        if complaint != node.complaint:
            _log.warning("%s; tried again", complaint)
        node.failures += 1
        node.complaint = complaint
        monitor = node.station.monitor
        monitor.refusal = complaint if refused else None
        monitor.running = monitor.running and not refused  # it may be somebody else's now
        node.phase, node.since_ns, node.not_before_ns = Phase.AWAITED, now_ns, now_ns + _RETRY_NS

    def _watch(self, node: _Node, now_ns: int) -> None:
        station, monitor = node.station, node.station.monitor
        said_ns = monitor.t_heartbeat_ns or 0
        if monitor.boot_ups != station.boot_ups:
            self._begin(node, now_ns)
            return
        if not station.is_guest and monitor.nmt_state != OPERATIONAL and said_ns > node.since_ns:
            self._begin(node, now_ns)
            if node.phase is Phase.JOINING:
                _log.warning(
                    "node %d (%s) left NMT state %d for %s without the host's doing",
                    station.patch.node_id,
                    station.patch.name,
                    OPERATIONAL,
                    monitor.nmt_state,
                )
            return
        patience_ns = HEARTBEATS_MISSED * station.heartbeat_s * 1e9
        if station.link.t_dealt_ns > max(said_ns, node.since_ns) + patience_ns and not station.is_silent:
            _log.warning("node %d (%s) is lost: no heartbeat", station.patch.node_id, station.patch.name)
            node.phase, node.since_ns, node.not_before_ns = Phase.AWAITED, now_ns, 0
            station.link.call(station.lane.withhold)  # what it says until it is known again
            return
        self._watch_baseline(node, now_ns)

    def _watch_baseline(self, node: _Node, now_ns: int) -> None:
        """Read it again where the node said that it changed, or may have said so in a summary that was
        lost. In the first case scans are withheld until then."""
        station, lane, job = node.station, node.station.lane, node.job
        if job is not None:
            if job.done():
                node.job = None
                self._take_baseline(node, job, now_ns)
            return
        changed = lane.withholding
        if not (changed or lane.doubtful) or now_ns < node.read_ns:
            self._watch_register(node, now_ns)
            return
        if station.is_silent:
            if changed:
                station.monitor.refusal = "its baseline changed; a guest that sends nothing cannot read it"
            return
        lane.doubtful = False
        abandon = node.abandon = threading.Event()

        def read() -> _Joined | None:
            withholdings = station.withhold() if changed else lane.withholdings
            return _Joined(station.renew_baseline(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        node.job = self._pool.submit(read)

    def _watch_register(self, node: _Node, now_ns: int) -> None:
        """Ask a node with an error for its error register: the emergency that ended it may have been lost."""
        station = node.station
        if not station.monitor.error_register or station.is_silent or now_ns < node.register_ns:
            return

        def read() -> _Joined | None:
            with contextlib.suppress(BusError, ConfigError):  # asked again
                station.renew_register()
            return None

        node.register_ns = now_ns + _DOUBT_NS
        node.job = self._pool.submit(read)

    def _take_baseline(self, node: _Node, job: Future[_Joined | None], now_ns: int) -> None:
        if job.exception() is None and job.result() is None:  # it was the error register
            return
        station, lane = node.station, node.station.lane
        node.read_ns = now_ns + (_LEAST_NS if lane.withholding else _DOUBT_NS)
        try:
            read = job.result()
        except (BusError, ConfigError) as error:  # if the node is gone, its silence will show
            lane.doubtful = True
            _log.warning("%s; its baseline is read again", error)
            return
        except Abandoned:
            return
        assert read is not None  # see above
        solver = read.solver
        if solver is not None:
            node.baselines += 1
            station.link.call(lambda: lane.resume(solver, read.withholdings, anew=False))
