"""A running host: a hand's worth of patches, brought up, solved and supervised."""

from __future__ import annotations

import contextlib
import logging
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from skinnode.bus_load.plan import check_plan
from skinnode.bus_load.stuffing import load_kernels
from skinnode.canopen import indices as od
from skinnode.config import BusConfig, HandConfig, PatchConfig, load_hand
from skinnode.errors import BusError, CodecError
from skinnode.host import nmt_master
from skinnode.host.callback import Callbacks, FieldCallback
from skinnode.host.configurator import BOOT_DEADLINE_S
from skinnode.host.containment import Defects, DefectStats
from skinnode.host.dispatcher import BusStats
from skinnode.host.events import CAPACITY_EVENTS, Events, EventSubscription, HealthWatch
from skinnode.host.hand_files import check_files
from skinnode.host.hand_frame import HandGatherer, HandSubscription
from skinnode.host.health import SYNCS_MISSED, BusHealth, PatchHealth
from skinnode.host.link import BusLink
from skinnode.host.lss_master import LssMaster
from skinnode.host.mainline import Mainline
from skinnode.host.other_masters import OtherMasters, OtherMasterStats
from skinnode.host.patch_stream import PatchStream, StreamStats, check_solvable
from skinnode.host.publish import Publisher, Subscription
from skinnode.host.reception import receive_bus, receive_patch
from skinnode.host.remote_node import RemoteNode
from skinnode.host.start import configure_all, go_on_unless, start_all
from skinnode.host.supervised import NodeStats
from skinnode.host.supervisor import Supervisor
from skinnode.host.sync import SyncFollower, SyncProducer, SyncStats, Ticks
from skinnode.host.tap import ContainedTap, HostTap, tap_bus, tap_link
from skinnode.host.tare import TARE_DEADLINE_S, TARE_DEADLINE_SYNCS, tare
from skinnode.host.workers import Workers
from skinnode.model.frames import FieldFrame
from skinnode.transport import CanPort

_log = logging.getLogger(__name__)

LAST_SCAN_S: Final = 0.5
"""How long the end of a host may wait for the last scans, at most."""

_POLL_S: Final = 0.005


@dataclass(frozen=True, slots=True)
class HostStats:
    """Counters of a running host, at one instant."""

    buses: Mapping[str, BusStats]
    patches: Mapping[str, StreamStats]
    nodes: Mapping[str, NodeStats]
    """By patch."""
    other_masters: Mapping[str, OtherMasterStats]
    """By bus: what other masters send there."""
    sync: SyncStats
    malformed: tuple[CodecError, ...]
    """The first frame of wrong length on each bus that had one."""
    defects: Mapping[str, DefectStats]
    """Exceptions that the host contained, by patch and by bus; under ``host`` those of neither."""

    @property
    def rivals(self) -> Mapping[str, OtherMasterStats]:
        """Old name of :attr:`other_masters`, for one version."""
        warnings.warn(
            "HostStats.rivals is HostStats.other_masters now; the old name goes in version 0.2",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.other_masters


@dataclass(frozen=True, slots=True)
class _Bus:
    """A bus with what the host does on it besides its patches."""

    link: BusLink
    ticks: Ticks
    other_masters: OtherMasters
    follower: SyncFollower
    lss: LssMaster


def _never() -> bool:
    return False


class Host:
    """A hand, running. Made by :meth:`from_toml` or :meth:`from_config`, which bring it up and shut it down::

        with Host.from_toml("hand.toml") as host:
            for field in host.fields():
                ...

    Inside the block all nodes are operational and SYNC is sent; who restarts or comes back is brought up
    again. At its end, and when bring-up fails half-way, the nodes are pre-operational, every thread has ended
    and every interface is closed. On a bus where the host is a guest, NMT and SYNC are left to the master.
    """

    def __init__(
        self,
        hand: HandConfig,
        buses: Mapping[str, _Bus],
        nodes: Sequence[RemoteNode],
        sync: SyncProducer | None,
        supervisor: Supervisor,
        publisher: Publisher,
        callbacks: Callbacks,
        events: Events,
        defects: Defects,
    ) -> None:
        self.hand, self._defects = hand, defects
        self._callbacks, self._events = callbacks, events
        self._buses = buses
        self._nodes = {node.patch.name: node for node in nodes}
        self._sync, self._supervisor, self._publisher = sync, supervisor, publisher
        self._t_up_ns = time.monotonic_ns()

    @classmethod
    @contextlib.contextmanager
    def from_toml(
        cls,
        path: Path | str,
        *,
        interface: str | None = None,
        channel: str | None = None,
        boot_deadline_s: float = BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = _never,
        tap: HostTap | None = None,
    ) -> Iterator[Host]:
        """:meth:`from_config` of a hand file. Raises ConfigError for a file that cannot be used."""
        hand = load_hand(path)
        running = cls.from_config(
            hand,
            interface=interface,
            channel=channel,
            boot_deadline_s=boot_deadline_s,
            cancelled=cancelled,
            tap=tap,
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
        boot_deadline_s: float = BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = _never,
        tap: HostTap | None = None,
        open_port: Callable[[BusConfig], CanPort] = CanPort,
    ) -> Iterator[Host]:
        """Bring a hand up; shut it down at the end of the ``with`` block.

        Args:
            hand: the hand.
            interface: python-can interface to use in place of the file's.
            channel: channel to use in place of the file's; only for a hand of one bus.
            boot_deadline_s: how long a node may take to answer for the first time.
            cancelled: asked during bring-up; when it says True, bring-up ends with BringUpCancelled.
            tap: writes down what passes, bring-up included: a :class:`skinnode.record.Recorder`.
            open_port: opens the interface of a bus, where that is not one of python-can's.

        Raises ConfigError for options, EDS or baseline files that contradict the hand, and for a layout that
        cannot be solved; BusLoadError for a plan that does not fit its bus; BusError for an interface that
        does not open or a bus on which no node answers; NodeTimeout for a node that does not answer, both
        unless ``bring_up.missing`` is ``wait``; NodeError for one that is not what the hand says or does not
        keep its configuration. After that the host survives whatever comes: see :meth:`health` and
        :meth:`stats`.
        """
        hand = hand.on(interface, channel)
        check_plan(hand)
        check_files(hand)
        load_kernels()  # of the load of a bus: the mainline could not stop for that
        defects = Defects("host")
        publisher = Publisher(tuple(patch.name for patch in hand.patches), defects)
        callbacks = Callbacks(defects)
        with contextlib.ExitStack() as stack:
            stack.callback(callbacks.join)
            stack.callback(publisher.end)
            buses = {
                bus.name: _serve_bus(
                    hand,
                    stack.enter_context(BusLink(bus, {}, _logged_already, open_port)),
                    Ticks(hand.sync.counter_overflow),
                )
                for bus in hand.buses
                if hand.patches_on(bus.name)
            }
            workers = stack.enter_context(_workers(hand, defects))
            nodes = [
                _remote_node(patch, hand, buses[patch.bus], workers, publisher) for patch in hand.patches
            ]
            if tap is not None:
                tap = ContainedTap(tap, defects)
                for bus in buses.values():
                    tap_link(tap, bus.link)
                for node in nodes:
                    node.stream.tap = tap
            # Undone in this order from below: SYNC stops, the scans under way end, nobody is brought up any
            # more, nodes fall silent, the mainline ends, boxes are emptied, workers end, interfaces close,
            # subscribers hear the end.
            for node in nodes:
                stack.callback(node.stream.close)
            # Everybody knows by now what to do with what comes.
            stack.enter_context(Mainline([bus.link for bus in buses.values()], defects))
            for patch in hand.patches:
                go_on_unless(cancelled)
                check_solvable(patch, hand.solver)
            try:
                ready = configure_all(nodes, hand.bring_up.missing, boot_deadline_s, cancelled)
                for node in nodes:
                    stack.callback(_stand_by, node)
                start_all(ready)
            except BusError:
                for bus in buses.values():
                    if bus.link.failure is not None:  # the nodes fell silent because the bus failed
                        raise bus.link.failure from bus.link.failure.__cause__
                raise
            supervisor = stack.enter_context(
                Supervisor(nodes, list(ready), hand.bring_up.heartbeat_s, defects)
            )
            own = [bus for bus in buses.values() if bus.link.config.role == "master"]
            sync: SyncProducer | None = None
            if own:
                streams = [
                    (each.stream, buses[each.patch.bus].ticks) for each in nodes if not each.has_other_master
                ]
                stack.callback(_let_scans_end, streams, hand.sync.period_s)
                senders = [(bus.link.send, bus.ticks) for bus in own]
                of_buses = [bus.link.defects for bus in own]
                sync = SyncProducer(senders, hand.sync.period_s, hand.sync.stagger_s, of_buses)
                stack.enter_context(sync)
            events = Events(defects)
            host = cls(hand, buses, nodes, sync, supervisor, publisher, callbacks, events, defects)
            stack.callback(events.end)
            watch = HealthWatch(host._all_health, host._all_bus_health, events, defects, host._all_defects)
            stack.enter_context(watch)
            yield host

    def fields(
        self, *, timeout_s: float | None = None, capacity: int | None = None, patch: str | None = None
    ) -> Subscription:
        """Fields as they are solved, of all patches or of one, from now until the host closes: for ``for`` or
        ``async for``.

        With ``timeout_s`` the loop raises TimeoutError when no field came for that long. ``capacity`` is how
        many fields the loop may lag behind before it loses the oldest, as in the hand file unless given.
        """
        kept = self.hand.stream.capacity_fields if capacity is None else capacity
        return self._publisher.subscribe(kept, timeout_s, patch)

    def hands(self, *, timeout_s: float | None = None, capacity: int | None = None) -> HandSubscription:
        """Hand frames from now until the host closes: the fields of all patches of one SYNC, for ``for`` or
        ``async for``. A patch is waited for two SYNC periods at most, and one that is away not at all.
        Arguments as of :meth:`fields`; ``capacity`` counts hand frames.

        Raises ValueError for a hand whose patches do not follow one SYNC with a counter.
        """
        self._require_one_sync()
        patches = [patch.name for patch in self.hand.patches]
        kept = (self.hand.stream.capacity_fields if capacity is None else capacity) * len(patches)
        patience_ns = 2 * self.hand.sync.period_ms * 1_000_000
        gatherer = HandGatherer(patches, patience_ns, lambda patch: self.health(patch).condition)
        return HandSubscription(self.fields(capacity=kept), gatherer, timeout_s)

    def on_field(
        self,
        function: Callable[[FieldFrame], object],
        *,
        patch: str | None = None,
        capacity: int | None = None,
    ) -> FieldCallback:
        """Call ``function`` with each field from now on, on a thread of its own, until the host closes or the
        callback returned is closed. A function that blocks or raises loses its own fields, counted there.
        Arguments as of :meth:`fields`. Raises TypeError for what is no function, or an ``async`` one."""
        return self._callbacks.add(function, self.fields(capacity=capacity, patch=patch))

    def latest(self, patch: str) -> FieldFrame | None:
        """The newest field of a patch, None before the first. Never waits. Raises ValueError for no patch."""
        return self._publisher.latest(patch)

    def health(self, patch: str) -> PatchHealth:
        """How a patch is. Raises KeyError for no such patch."""
        node = self._nodes[patch]
        return node.monitor.health(
            time.monotonic_ns(),
            node.heartbeat_s,
            self.hand.sync.period_s,
            node.stream.stats().assembler.conflicts,
            node.stream.t_passed_ns,
        )

    def bus_health(self, bus: str) -> BusHealth:
        """How a bus is. Raises KeyError for no such bus, and for one without patches."""
        link, other_masters = self._buses[bus].link, self._buses[bus].other_masters.stats()
        stats, failure = link.stats(), link.failure
        return BusHealth(
            bus=bus,
            away=None if failure is None else str(failure),
            load=stats.load,
            error_frames=stats.error_frames,
            bus_offs=stats.bus_offs,
            outages=stats.outages,
            kernel_dropped=stats.kernel_dropped,
            dropped=stats.dropped,
            malformed=stats.malformed,
            foreign=stats.foreign,
            foreign_ids=tuple(sorted(stats.foreign_ids)),
            other_syncs=other_masters.syncs,
            other_masters=other_masters.nmt_commands + other_masters.sdo_requests + other_masters.heartbeats,
            controller=stats.controller,
            no_sync=self._lacks_sync(self._buses[bus]),
        )

    def _lacks_sync(self, bus: _Bus) -> bool:
        """Of a bus of guests. By the time that was dispatched: nothing is late because we are. Where patches
        scan by their own clocks, nobody needs one."""
        if bus.link.config.role == "master" or bus.link.failure is not None:
            return False
        since_ns = max(self._t_up_ns, bus.follower.t_newest_ns)
        if bus.link.t_dispatched_ns - since_ns < SYNCS_MISSED * self.hand.sync.period_ms * 1_000_000:
            return False
        streams = [node.stream for node in self._nodes.values() if node.link is bus.link]
        return bool(self.hand.sync.counter_overflow) or not any(stream.stats().offered for stream in streams)

    def events(self, *, capacity: int = CAPACITY_EVENTS) -> EventSubscription:
        """What happens to the health of patches, wires and buses from now until the host closes."""
        return self._events.subscribe(capacity)

    def _require_one_sync(self) -> None:
        guests = {patch.bus for patch in self.hand.patches if self.hand.bus(patch.bus).role == "guest"}
        masters = any(patch.bus not in guests for patch in self.hand.patches)
        if len(guests) + masters > 1 or self.hand.sync.counter_overflow == 0:
            producers = "none with a counter" if len(guests) + masters == 1 else f"{len(guests) + masters}"
            raise ValueError(f"SYNC producers: got {producers}, must be one that all patches follow")

    def _all_health(self) -> dict[str, PatchHealth]:
        return {patch: self.health(patch) for patch in self._nodes}

    def _all_bus_health(self) -> dict[str, BusHealth]:
        return {bus: self.bus_health(bus) for bus in self._buses}

    def _all_defects(self) -> dict[str, DefectStats]:
        of_buses = [bus.link.defects for bus in self._buses.values()]
        of_patches = [node.defects for node in self._nodes.values()]
        return {each.subject: each.stats() for each in (self._defects, *of_buses, *of_patches)}

    def tap(self, tap: HostTap) -> Callable[[], None]:
        """Let ``tap`` write down what passes, from now until what is returned is called or the host closes.
        One at a time."""
        ends, tap = [], ContainedTap(tap, self._defects)
        for bus in self._buses.values():
            streams = [node.stream for node in self._nodes.values() if node.link is bus.link]
            ends.append(tap_bus(tap, bus.link, streams))

        def untap() -> None:
            for end in ends:
                end()

        return untap

    def tare(self, patch: str, *, deadline_s: float | None = None) -> None:
        """Tare a patch: its present resistances become the baseline. Returns once the host has read the new
        baseline and solves with it. The event ``baselines`` confirms it to all subscribers.

        The command is RPDO1. The node loses the baseline at power-off unless it is stored (0x1010).
        ``deadline_s`` is 5 s and three SYNC periods by default.

        Raises KeyError if there is no such patch; NodeError if the host is a guest on its bus, if a file
        keeps its baseline, or if the node is not operational; NodeTimeout if no new baseline came in time;
        BusError if the command cannot be sent.
        """
        node = self._nodes[patch]
        if deadline_s is None:
            deadline_s = TARE_DEADLINE_S + TARE_DEADLINE_SYNCS * self.hand.sync.period_s
        tare(
            node,
            lambda: self._supervisor.stats()[patch].baselines,
            lambda: self.health(patch),
            deadline_s,
        )

    def stats(self) -> HostStats:
        """All counters."""
        buses = self._buses
        sync = SyncStats(0, 0, 0, 0) if self._sync is None else self._sync.stats()
        followers = [bus.follower for bus in buses.values()]
        rejected = (bus.link.first_malformed for bus in buses.values())
        return HostStats(
            buses={name: bus.link.stats() for name, bus in buses.items()},
            patches={name: node.stream.stats() for name, node in self._nodes.items()},
            nodes=self._supervisor.stats(),
            other_masters={name: bus.other_masters.stats() for name, bus in buses.items()},
            sync=replace(
                sync,
                received=sum(follower.received for follower in followers),
                irregular=sum(follower.irregular for follower in followers),
            ),
            malformed=tuple(error for error in rejected if error is not None),
            defects=self._all_defects(),
        )


def _workers(hand: HandConfig, defects: Defects) -> Workers:
    count = hand.solver.workers or len(os.sched_getaffinity(0))
    return Workers(min(count, len(hand.patches)), "solve", defects)


def _remote_node(
    patch: PatchConfig, hand: HandConfig, bus: _Bus, workers: Workers, publisher: Publisher
) -> RemoteNode:
    defects = Defects(patch.name)
    reception = receive_patch(patch, hand, bus.link, bus.ticks, workers, publisher, defects)
    return RemoteNode(patch, hand, bus.link, reception, bus.lss, defects)


def _serve_bus(hand: HandConfig, link: BusLink, ticks: Ticks) -> _Bus:
    heard, lss = receive_bus(hand, link, ticks), LssMaster(link.send)
    link.handle(od.LSS_RESPONSE_COB_ID, lss.on_response)
    return _Bus(link, ticks, heard.other_masters, heard.follower, lss)


def _logged_already(error: Exception) -> None:
    """Ignore a defect of a bus: the health watch reports it."""


def _let_scans_end(streams: Sequence[tuple[PatchStream, Ticks]], period_s: float) -> None:
    """Wait for the scans of the last SYNC, so that no scan is cut off by the end of the program."""
    end_s = time.monotonic() + min(1.5 * period_s, LAST_SCAN_S)
    while not all(stream.settled(ticks.newest) for stream, ticks in streams):
        if time.monotonic() > end_s:
            return
        time.sleep(_POLL_S)


def _stand_by(node: RemoteNode) -> None:
    if node.has_other_master or not node.monitor.running:
        return
    node.monitor.running = False
    try:
        nmt_master.stand_by(node.link.send, node.patch.node_id)
    except Exception as error:  # the bus is gone; the shutdown must continue
        _log.warning("node %d was not put on stand-by: %s", node.patch.node_id, error)
