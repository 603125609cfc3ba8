"""A running host: a hand's worth of patches, brought up, solved and supervised."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinnode.errors import BusError, CodecError, NodeTimeout, SkinError
from skinnode.host import bringup
from skinnode.host.bringup import Abandoned, Bringer, NodeFacts, check_eds
from skinnode.host.dealer import BusStats, Handler
from skinnode.host.health import OPERATIONAL, NodeMonitor, PatchHealth
from skinnode.host.link import BusLink
from skinnode.host.pipeline import Lane, LaneStats, Solver, check_solvable
from skinnode.host.publish import CAPACITY_FIELDS, Publisher, Subscription
from skinnode.host.sync import SyncProducer, SyncStats, Ticks
from skinnode.host.workers import Workers
from skinnode.model.config import BusConfig, HandConfig, PatchConfig, load_hand
from skinnode.model.frames import FieldFrame
from skinnode.wire import indices as od
from skinnode.wire.assembler import ScanAssembler
from skinnode.wire.profile import PatchProfile

_log = logging.getLogger(__name__)

BRING_UP_THREADS: Final = 16
"""Nodes brought up at the same time; more would only queue for the bus."""

START_DEADLINE_S: Final = 1.0
"""How long a node may take to say that it is operational: four heartbeats."""

LAST_SCAN_S: Final = 0.5
"""How long the end of a host may wait for the last scans, at most."""

_POLL_S: Final = 0.005


@dataclass(frozen=True, slots=True)
class HostStats:
    """Counters of a running host, at one instant."""

    buses: Mapping[str, BusStats]
    patches: Mapping[str, LaneStats]
    sync: SyncStats
    malformed: tuple[CodecError, ...]
    """The first frame of wrong length on each bus that had one."""


class BringUpCancelled(SkinError):
    """Bring-up was called off by whoever asked for it."""


def _never() -> bool:
    return False


def _go_on_unless(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise BringUpCancelled("bring-up was cancelled")


class Host:
    """A hand, running. Made by :meth:`from_toml` or :meth:`from_config`, which bring it up and shut it down::

        with Host.from_toml("hand.toml") as host:
            for field in host.fields():
                ...

    Inside the block all nodes are operational and SYNC is sent. At its end, and when bring-up fails half-way,
    the nodes are pre-operational, every thread has ended and every interface is closed.
    """

    def __init__(
        self,
        hand: HandConfig,
        links: Mapping[str, BusLink],
        lanes: Mapping[str, Lane],
        monitors: Mapping[str, NodeMonitor],
        sync: SyncProducer,
        publisher: Publisher,
    ) -> None:
        self.hand = hand
        self._links, self._lanes, self._monitors = links, lanes, monitors
        self._sync, self._publisher = sync, publisher

    @classmethod
    @contextlib.contextmanager
    def from_toml(
        cls,
        path: Path | str,
        *,
        interface: str | None = None,
        channel: str | None = None,
        boot_deadline_s: float = bringup.BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = _never,
    ) -> Iterator[Host]:
        """:meth:`from_config` of a hand file. Raises ConfigError for a file that cannot be used."""
        hand = load_hand(path)
        running = cls.from_config(
            hand, interface=interface, channel=channel, boot_deadline_s=boot_deadline_s, cancelled=cancelled
        )
        with running as host:
            yield host

    @classmethod
    @contextlib.contextmanager
    def from_config(
        cls,
        hand: HandConfig,
        *,
        interface: str | None = None,
        channel: str | None = None,
        boot_deadline_s: float = bringup.BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = _never,
    ) -> Iterator[Host]:
        """Bring a hand up; shut it down at the end of the ``with`` block.

        Args:
            hand: the hand.
            interface: python-can interface to use in place of the file's.
            channel: channel to use in place of the file's; only for a hand of one bus.
            boot_deadline_s: how long a node may take to answer for the first time.
            cancelled: asked during bring-up; when it says True, bring-up ends with BringUpCancelled.

        Raises ConfigError for options or EDS files that contradict the hand, and for a layout that cannot be
        solved; BusError for an interface that does not open or a bus on which no node answers; NodeTimeout
        for a node that does not answer; NodeError for one that is not what the hand says or does not keep its
        configuration.
        """
        hand = hand.on(interface, channel)
        for patch in hand.patches:
            if patch.eds is not None:
                check_eds(patch.eds, PatchProfile.from_config(patch, hand.bus(patch.bus)))
        names = tuple(patch.name for patch in hand.patches)
        publisher = Publisher(names)
        with contextlib.ExitStack() as stack:
            stack.callback(publisher.end)
            monitors = {patch.name: NodeMonitor(patch.name, patch.node_id) for patch in hand.patches}
            links = {
                bus.name: stack.enter_context(BusLink(bus, _handlers(hand, bus, monitors), publisher.fail))
                for bus in hand.buses
                if hand.patches_on(bus.name)
            }
            ticks = Ticks(hand.sync.counter_overflow)
            for patch in hand.patches:
                _go_on_unless(cancelled)
                check_solvable(patch, hand.solver)
            try:
                facts = _bring_up(hand, links, boot_deadline_s, cancelled)
                solvers = {name: Solver(known, hand.solver) for name, known in facts.items()}
                workers = stack.enter_context(_workers(hand))
                lanes = {
                    name: _lane(hand, known, solvers[name], workers, publisher, ticks, links, monitors)
                    for name, known in facts.items()
                }
                # Undone in this order from below: SYNC stops, the scans under way end, nodes fall silent,
                # mainlines end, boxes are emptied, workers end, interfaces close, subscribers hear the end.
                for lane in lanes.values():
                    stack.callback(lane.close)
                for link in links.values():
                    stack.callback(link.stop)
                for patch in hand.patches:
                    stack.callback(_stand_by, links[patch.bus], monitors[patch.name])
                _start(hand, links, monitors)
            except BusError:
                for link in links.values():
                    if link.failure is not None:  # the nodes fell silent because the bus failed
                        raise link.failure from link.failure.__cause__
                if publisher.failure is not None:
                    raise publisher.failure from publisher.failure.__cause__
                raise
            senders = [link.send for link in links.values()]
            stack.callback(_let_scans_end, tuple(lanes.values()), ticks, hand.sync.period_s, publisher)
            sync = stack.enter_context(SyncProducer(senders, hand.sync.period_s, ticks))
            yield cls(hand, links, lanes, monitors, sync, publisher)

    def fields(
        self, *, timeout_s: float | None = None, capacity: int = CAPACITY_FIELDS, patch: str | None = None
    ) -> Subscription:
        """Fields as they are solved, of all patches or of one, from now until the host closes.

        With ``timeout_s`` the loop raises TimeoutError when no field came for that long. ``capacity`` is how
        many fields the loop may lag behind before it loses the oldest.
        """
        return self._publisher.subscribe(capacity, timeout_s, patch)

    def latest(self, patch: str) -> FieldFrame | None:
        """The newest field of a patch, None before the first. Never waits. Raises ValueError for no patch."""
        return self._publisher.latest(patch)

    def health(self, patch: str) -> PatchHealth:
        """How a patch is. Raises KeyError for no such patch."""
        return self._monitors[patch].health(time.monotonic_ns(), bringup.HEARTBEAT_S, self.hand.sync.period_s)

    def stats(self) -> HostStats:
        """All counters."""
        return HostStats(
            buses={name: link.stats() for name, link in self._links.items()},
            patches={name: lane.stats() for name, lane in self._lanes.items()},
            sync=self._sync.stats(),
            malformed=tuple(
                link.first_malformed for link in self._links.values() if link.first_malformed is not None
            ),
        )


def _handlers(hand: HandConfig, bus: BusConfig, monitors: Mapping[str, NodeMonitor]) -> dict[int, Handler]:
    """Who gets what from the moment the bus is open."""
    handlers: dict[int, Handler] = {}
    for patch in hand.patches_on(bus.name):
        monitor, node_id = monitors[patch.name], patch.node_id
        handlers[od.heartbeat_cob_id(node_id)] = monitor.on_heartbeat
        handlers[od.emcy_cob_id(node_id)] = monitor.on_emergency
        # A node that an earlier host left operational may be sending already.
        handlers[od.chunk_cob_id(node_id)] = handlers[od.summary_cob_id(node_id)] = _ignore
    return handlers


def _ignore(data: bytes, t_ns: int) -> None:
    pass


def _workers(hand: HandConfig) -> Workers:
    count = hand.solver.workers or len(os.sched_getaffinity(0))
    return Workers(min(count, len(hand.patches)), "solve")


def _lane(
    hand: HandConfig,
    facts: NodeFacts,
    solver: Solver,
    workers: Workers,
    publisher: Publisher,
    ticks: Ticks,
    links: Mapping[str, BusLink],
    monitors: Mapping[str, NodeMonitor],
) -> Lane:
    """A lane that gets its frames from the bus of its patch."""
    patch, link = facts.config, links[facts.config.bus]
    assembler = ScanAssembler(
        facts.profile,
        counter_overflow=ticks.counter_overflow,
        period_ns=hand.sync.period_ms * 1_000_000,
        node_id=patch.node_id,
        on_reject=link.reject,
    )
    lane = Lane(patch.name, assembler, workers, publisher, ticks.find, monitors[patch.name].on_scan)
    lane.resume(solver, lane.withholdings, anew=True)
    link.handle(od.chunk_cob_id(patch.node_id), lane.on_chunk)
    link.handle(od.summary_cob_id(patch.node_id), lane.on_summary)
    link.poll_with(lane.poll)
    return lane


def _bring_up(
    hand: HandConfig, links: Mapping[str, BusLink], boot_deadline_s: float, cancelled: Callable[[], bool]
) -> dict[str, NodeFacts]:
    """All nodes side by side. The first failure stops the others at their next transfer."""
    over = threading.Event()
    answered: list[PatchConfig] = []

    def abandoned() -> bool:
        return over.is_set() or cancelled()

    def bring_up(patch: PatchConfig) -> NodeFacts:
        link = links[patch.bus]
        bringer = Bringer(link.send, hand.sync, boot_deadline_s, abandoned, answered.append)
        profile, remote = PatchProfile.from_config(patch, hand.bus(patch.bus)), link.remote_od(patch.node_id)
        return bringer.bring_up(patch, patch.layout.build(), profile, remote)

    with ThreadPoolExecutor(min(len(hand.patches), BRING_UP_THREADS), thread_name_prefix="bring-up") as pool:
        try:
            jobs = {patch.name: pool.submit(bring_up, patch) for patch in hand.patches}
            wait(jobs.values(), return_when=FIRST_EXCEPTION)
        finally:  # whoever still runs after the first failure, or after Ctrl-C, stops
            over.set()
            pool.shutdown(cancel_futures=True)
    for patch in hand.patches:
        job = jobs[patch.name]
        failure = None if job.cancelled() else job.exception()
        if failure is None or isinstance(failure, Abandoned):
            continue
        if isinstance(failure, NodeTimeout) and patch not in answered:
            raise _silence(hand, patch, answered, boot_deadline_s) from None
        raise failure
    _go_on_unless(cancelled)
    return {name: job.result() for name, job in jobs.items()}


def _silence(
    hand: HandConfig, patch: PatchConfig, answered: list[PatchConfig], boot_deadline_s: float
) -> BusError:
    """The error for a silent ``patch``. If all are silent it is the cable, the supply or the bit rate."""
    bus, on_bus = hand.bus(patch.bus), hand.patches_on(patch.bus)
    silent = [other for other in on_bus if other not in answered]
    allowed = f"allowed: an answer within {boot_deadline_s:g} s"
    names = ", ".join(f"{other.node_id} ({other.name})" for other in silent)
    if len(silent) == len(on_bus):
        return BusError(
            f"{bus.name}: interface {bus.interface!r}, channel {bus.channel!r}: got no answer from any node, "
            f"{allowed} from {names}"
        )
    return NodeTimeout(
        patch.node_id, f"patch {patch.name!r} on {bus.name}: got no answer, {allowed} from {names}"
    )


def _start(hand: HandConfig, links: Mapping[str, BusLink], monitors: Mapping[str, NodeMonitor]) -> None:
    """NMT start, and each node says in a heartbeat that it is operational. Raises NodeTimeout."""
    t_start_ns = time.monotonic_ns()
    for patch in hand.patches:
        bringup.start(links[patch.bus].send, patch.node_id)
    end_s = time.monotonic() + START_DEADLINE_S
    for patch in hand.patches:
        monitor = monitors[patch.name]
        while not monitor.said_since(OPERATIONAL, t_start_ns):
            if time.monotonic() > end_s:
                raise NodeTimeout(
                    patch.node_id,
                    f"patch {patch.name!r} on {patch.bus}: got NMT state {monitor.nmt_state} after the start "
                    f"command, allowed: {OPERATIONAL} (operational) within {START_DEADLINE_S:g} s",
                )
            time.sleep(_POLL_S)
        monitor.running = True


def _let_scans_end(lanes: Sequence[Lane], ticks: Ticks, period_s: float, publisher: Publisher) -> None:
    """Wait for the scans of the last SYNC, so that no scan is cut off by the end of the program."""
    end_s = time.monotonic() + min(1.5 * period_s, LAST_SCAN_S)
    while not all(lane.settled(ticks.newest) for lane in lanes) and publisher.failure is None:
        if time.monotonic() > end_s:
            return
        time.sleep(_POLL_S)


def _stand_by(link: BusLink, monitor: NodeMonitor) -> None:
    monitor.running = False
    try:
        bringup.stand_by(link.send, monitor.node_id)
    except BusError as error:  # the bus is gone; the rest of the shutdown must go on
        _log.warning("node %d was not put on stand-by: %s", monitor.node_id, error)
