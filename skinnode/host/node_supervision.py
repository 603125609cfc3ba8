"""Run the state machine of each supervised node."""

from __future__ import annotations

import contextlib
import logging
from concurrent.futures import Executor
from typing import Final

from skinnode.canopen.nmt import NmtState
from skinnode.errors import BusError, ConfigError, NodeError, NodeTimeout
from skinnode.host import nmt_master
from skinnode.host.baseline_watch import BaselineWatch, note_baseline
from skinnode.host.health import HEARTBEATS_MISSED
from skinnode.host.remote_node import RemoteNode
from skinnode.host.supervised import JOIN_DEADLINE_S, LEAST_NS, Joined, Phase, Supervised
from skinnode.process import clock
from skinnode.text.words import known

_log = logging.getLogger(__name__)

START_DEADLINE_S: Final = 1.0
"""Minimum time limit (s) from the start command to the first heartbeat that reports the node as
operational."""

START_HEARTBEATS: Final = 4
"""Minimum length of this time limit, in heartbeat periods."""

_PROBE_NS: Final = 250_000_000
"""Interval (ns) between requests to an absent node. The requests reveal a node that sends no heartbeats and
whose boot-up message was lost. Requests to four nodes use 0.1 % of a bus's capacity.
"""

_SEARCH_NS: Final = 1_000_000_000
"""Interval (ns) between LSS searches for an absent node."""

_FORGET_NS: Final = 2_000_000_000
"""Time (ns) without frames after which a node is no longer reported as refused or faulty."""

_MUTE_NS: Final = 1_000_000_000
"""Minimum interval (ns) between reads of the configuration of a node that sends no scans."""


class NodeSupervision:
    """State machines of all supervised nodes. Used only by the supervisor's thread.

    A job that has to wait for a node runs on ``pool``. A node has at most one job at a time. LSS searches run
    on ``searches``.
    """

    def __init__(self, pool: Executor, searches: Executor) -> None:
        self._pool, self._searches = pool, searches
        self._baselines = BaselineWatch(pool)

    def look(self, node: Supervised, now_ns: int) -> None:
        """Advance the state machine of a node to monotonic time ``now_ns``."""
        count = node.remote.defects.count
        if node.upset or (count != node.defects and node.phase in (Phase.STARTING, Phase.RUNNING)):
            self._make_faulty(node, now_ns)
            return
        # in the other phases, exceptions in frame handlers do not interrupt bring-up
        if count != node.defects:
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
            at_once = (booted or node.was_silent) and now_ns >= node.begun_ns + LEAST_NS
            if at_once or now_ns >= node.not_before_ns:
                self._begin(node, now_ns)
            return
        if now_ns - max(heard_ns, node.since_ns) > _FORGET_NS:
            monitor.refusal = monitor.defect = (
                None  # the node has disappeared, so its error no longer applies
            )
        if remote.listen_only or remote.link.failure is not None:
            return
        if now_ns >= node.probe_ns:
            node.probe_ns = now_ns + _PROBE_NS
            # a request that cannot be sent is repeated after _PROBE_NS
            with contextlib.suppress(BusError):
                remote.probe()
        search_is_over = node.searching is None or node.searching.done()
        if remote.searchable and search_is_over and now_ns - max(node.search_ns, node.since_ns) > _SEARCH_NS:
            node.search_ns = now_ns
            node.searching = self._searches.submit(_search, remote)

    def _begin(self, node: Supervised, now_ns: int) -> None:
        """Start configuring a node.

        A job that is still running is aborted first, and the configuration starts in a later iteration.
        """
        if node.job is not None and not node.job.done():
            node.abandon.set()
            return
        remote, abandon = node.remote, clock.event()

        def bring_up() -> Joined | None:
            withholdings = remote.withhold()
            return Joined(remote.configure(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        remote.boot_ups = remote.monitor.boot_ups
        node.job = self._pool.submit(bring_up)
        node.abandon, node.phase, node.since_ns, node.begun_ns = abandon, Phase.JOINING, now_ns, now_ns

    def _join(self, node: Supervised, now_ns: int) -> None:
        remote, job = node.remote, node.job
        assert job is not None  # a node in phase JOINING always has a job
        if remote.monitor.boot_ups != remote.boot_ups:
            node.abandon.set()  # the node has rebooted and lost its configuration
        if not job.done():
            return
        if node.abandon.is_set():
            if now_ns >= node.since_ns + LEAST_NS:
                self._begin(node, now_ns)
            return
        node.job = None
        try:
            joined = job.result()
            assert joined is not None  # a bring-up job never returns None
            assert joined.solver is not None
            remote.start(joined.solver, joined.withholdings)
            note_baseline(node)
        except (BusError, ConfigError) as error:
            refused = isinstance(error, (NodeError, ConfigError)) and not isinstance(error, NodeTimeout)
            self._fail(node, str(error), now_ns, refused=refused)
            return
        except Exception as error:
            node.upset = True
            remote.defects.report("bring-up", error)
            return
        node.phase, node.since_ns, node.probe_ns = Phase.STARTING, now_ns, now_ns + _PROBE_NS
        if remote.has_other_master:  # the bus's other master starts the node
            self._running(node, now_ns)

    def _starting(self, node: Supervised, now_ns: int) -> None:
        remote = node.remote
        if remote.monitor.boot_ups != remote.boot_ups:
            self._begin(node, now_ns)
        elif remote.monitor.said_since(NmtState.OPERATIONAL, node.since_ns):
            self._running(node, now_ns)
        elif remote.link.t_dispatched_ns > node.since_ns + start_deadline_s(remote) * 1e9:
            # the reported state predates the start command, and no heartbeat has arrived since
            silent = remote.monitor.nmt_state == NmtState.OPERATIONAL
            self._fail(node, _not_started(remote, silent=silent), now_ns, refused=not silent)
        elif now_ns >= node.probe_ns:  # NMT commands are unconfirmed and may be lost
            node.probe_ns = now_ns + _PROBE_NS
            with contextlib.suppress(BusError):
                nmt_master.start(remote.link.send, remote.patch.node_id)

    def _running(self, node: Supervised, now_ns: int) -> None:
        remote = node.remote
        node.phase, node.since_ns, node.complaint = Phase.RUNNING, now_ns, None
        node.unconfigured = False
        node.read_ns = now_ns + LEAST_NS
        node.rejoins += 1
        remote.monitor.rejoins = node.rejoins
        remote.monitor.refusal = remote.monitor.defect = None
        remote.monitor.complaint = None
        _log.warning("node %d (%s) was brought up and is running", remote.patch.node_id, remote.patch.name)

    def _fail(self, node: Supervised, complaint: str, now_ns: int, *, refused: bool) -> None:
        if complaint != node.complaint:
            _log.warning("%s; retrying", complaint)
        node.failures += 1
        node.complaint = complaint
        monitor = node.remote.monitor
        monitor.complaint = complaint
        monitor.refusal = complaint if refused else None
        monitor.running = monitor.running and not refused  # another host may be using a refused node
        self._await_again(node, now_ns, was_silent=True)  # another node may replace a refused node

    def _make_faulty(self, node: Supervised, now_ns: int) -> None:
        """Mark a patch as faulty after an unexpected exception.

        If this method itself raises an exception, the next iteration calls it again.
        """
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
                node.probe_ns = (
                    now_ns + _PROBE_NS
                )  # the running job waits for a response, which a stopped node does not send
                with contextlib.suppress(BusError):
                    nmt_master.stand_by(remote.link.send, remote.patch.node_id)
            if node.phase is Phase.JOINING:
                _log.warning(
                    "node %d (%s) left NMT state %d for %s without a command from the host",
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
            # scans are withheld until the node has been configured again
            remote.link.call(remote.stream.withhold, remote.defects)
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
        self._baselines.look(node, now_ns)


def start_deadline_s(remote: RemoteNode) -> float:
    """Return the time limit (s) from the start command to the first heartbeat that reports operational."""
    return max(START_DEADLINE_S, START_HEARTBEATS * remote.heartbeat_s)


def _read_back(node: Supervised) -> None:
    """Check whether a node that sends no scans has lost its configuration."""
    # a failed read is repeated later
    with contextlib.suppress(BusError, ConfigError):
        node.unconfigured = not node.remote.is_configured()


def _search(remote: RemoteNode) -> bool:
    """Search for a node over LSS. Return whether it was found."""
    try:
        return remote.search()
    except Exception as error:
        remote.defects.report("search by LSS", error)
        return False


def _not_started(remote: RemoteNode, *, silent: bool) -> str:
    """Return the message for a node that did not start in time."""
    node = f"node {remote.patch.node_id}"
    if silent:
        return f"{node}: got no heartbeat within {start_deadline_s(remote):g} s of the start command"
    state = known(remote.monitor.nmt_state)
    return f"{node}: got NMT state {state} after the start command, expected {NmtState.OPERATIONAL:d}"
