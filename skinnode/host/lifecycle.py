"""Start the parts of a host in order, and shut them down in reverse order."""

from __future__ import annotations

import contextlib
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.bus_load.plan import check_plan
from skinnode.bus_load.stuffing import load_kernels
from skinnode.config import BusConfig, HandConfig
from skinnode.errors import BusError
from skinnode.host import nmt_master
from skinnode.host.callback import Callbacks
from skinnode.host.configurator import BOOT_DEADLINE_S
from skinnode.host.containment import Defects
from skinnode.host.events import Events
from skinnode.host.hand_files import check_files
from skinnode.host.link import BusLink
from skinnode.host.mainline import Mainline
from skinnode.host.patch_stream import PatchStream, StreamOutput
from skinnode.host.publish import Publisher
from skinnode.host.reception import receive_patch
from skinnode.host.remote_node import RemoteNode
from skinnode.host.scan_solver import ScanSolver, check_solvable
from skinnode.host.served_bus import ServedBus, serve_bus
from skinnode.host.start import configure_all, go_on_unless, start_all
from skinnode.host.supervisor import Supervisor
from skinnode.host.sync import SyncProducer, Ticks
from skinnode.host.tap import ContainedTap, HostTap, tap_link
from skinnode.host.workers import Workers
from skinnode.process import clock
from skinnode.transport import CanPort

_log = logging.getLogger(__name__)

LAST_SCAN_S: Final = 0.5
"""Time limit (s) for the last scans when a host closes."""

_POLL_S: Final = 0.005


def never() -> bool:
    """Return False; default of :attr:`StartOptions.cancelled`."""
    return False


@dataclass(frozen=True, slots=True)
class StartOptions:
    """Options for starting a host.

    Raises:
        ValueError: if ``boot_deadline_s`` is negative, infinite or not a number.
    """

    boot_deadline_s: float = BOOT_DEADLINE_S
    """Time limit (s) for a node's first response."""
    cancelled: Callable[[], bool] = never
    """Function polled during bring-up. If it returns True, bring-up raises BringUpCancelled."""
    tap: HostTap | None = None
    """Recorder of the traffic, including bring-up; None for no recording."""
    open_port: Callable[[BusConfig], CanPort] = CanPort
    """Function that opens the interface of a bus."""

    def __post_init__(self) -> None:
        if not 0 <= self.boot_deadline_s < math.inf:
            raise ValueError(
                f"boot_deadline_s: got {self.boot_deadline_s!r}, must be finite and not negative"
            )


@dataclass(frozen=True, slots=True)
class HostParts:
    """Parts of a running host; see :func:`running_parts`."""

    hand: HandConfig
    buses: Mapping[str, ServedBus]
    nodes: Mapping[str, RemoteNode]
    sync: SyncProducer | None
    """SYNC producer; None if other masters run all buses."""
    supervisor: Supervisor
    publisher: Publisher
    callbacks: Callbacks
    events: Events
    defects: Defects
    """Collector of exceptions that concern no particular bus or patch."""


@contextlib.contextmanager
def running_parts(hand: HandConfig, options: StartOptions) -> Iterator[HostParts]:
    """Start the parts of a host. Shut them down when the ``with`` block exits.

    Shutdown order: stop SYNC, wait for the scans in progress, stop configuring nodes, make the nodes
    pre-operational, end the mainline, discard queued scans, end the workers, close the interfaces, and end
    the subscriptions.

    Raises:
        SkinError: see :meth:`skinnode.host.Host.from_config`.
    """
    check_plan(hand)
    check_files(hand)
    load_kernels()  # compile the bus load kernels now, not later on the mainline
    defects = Defects("host")
    publisher = Publisher(tuple(patch.name for patch in hand.patches), defects)
    callbacks = Callbacks(defects)
    with contextlib.ExitStack() as stack:
        stack.callback(callbacks.join)
        stack.callback(publisher.end)
        buses = {
            bus.name: serve_bus(
                hand, stack.enter_context(BusLink(bus, {}, _logged_already, options.open_port))
            )
            for bus in hand.buses
            if hand.patches_on(bus.name)
        }
        workers = stack.enter_context(_workers(hand, defects))
        nodes = _remote_nodes(hand, buses, workers, publisher)
        if options.tap is not None:
            _tap_all(ContainedTap(options.tap, defects), buses.values(), nodes)
        for node in nodes:
            stack.callback(node.stream.close)
        # All handlers are registered: frames may now be dispatched.
        stack.enter_context(Mainline([bus.link for bus in buses.values()], defects))
        ready = _brought_up(hand, nodes, options, stack)
        supervisor = Supervisor(nodes, list(ready), hand.bring_up.heartbeat_s, defects)
        stack.enter_context(supervisor)
        sync = _sync(hand, buses, nodes, stack)
        events = Events(defects)
        stack.callback(events.end)
        by_patch = {node.patch.name: node for node in nodes}
        yield HostParts(hand, buses, by_patch, sync, supervisor, publisher, callbacks, events, defects)


def _workers(hand: HandConfig, defects: Defects) -> Workers:
    count = hand.solver.workers or len(os.sched_getaffinity(0))
    return Workers(min(count, len(hand.patches)), "solve", defects)


def _remote_nodes(
    hand: HandConfig, buses: Mapping[str, ServedBus], workers: Workers, publisher: Publisher
) -> list[RemoteNode]:
    nodes = []
    for patch in hand.patches:
        bus, defects = buses[patch.bus], Defects(patch.name)
        output = StreamOutput(workers, publisher, defects)
        reception = receive_patch(patch, hand, bus.link, bus.ticks, output)
        nodes.append(RemoteNode(patch, hand, bus, reception, defects))
    return nodes


def _tap_all(tap: ContainedTap, buses: Iterable[ServedBus], nodes: Iterable[RemoteNode]) -> None:
    for bus in buses:
        tap_link(tap, bus.link, bus.ticks)
    for node in nodes:
        node.stream.tap = tap


def _brought_up(
    hand: HandConfig, nodes: Sequence[RemoteNode], options: StartOptions, stack: contextlib.ExitStack
) -> dict[RemoteNode, ScanSolver]:
    """Configure and start the nodes. Closing ``stack`` makes them pre-operational again."""
    for patch in hand.patches:
        go_on_unless(options.cancelled)
        check_solvable(patch, hand.solver, hand.sync.period_s)
    try:
        ready = configure_all(nodes, hand.bring_up.missing, options.boot_deadline_s, options.cancelled)
        for node in nodes:
            stack.callback(_stand_by, node)
        start_all(ready)
    except BusError:
        for node in nodes:
            if node.link.failure is not None:  # the bus has failed, so the nodes cannot respond
                raise node.link.failure from node.link.failure.__cause__
        raise
    return ready


def _sync(
    hand: HandConfig,
    buses: Mapping[str, ServedBus],
    nodes: Sequence[RemoteNode],
    stack: contextlib.ExitStack,
) -> SyncProducer | None:
    """Send SYNC on the buses where the host is the master. Closing ``stack`` stops it."""
    own = [bus for bus in buses.values() if bus.link.config.role == "master"]
    if not own:
        return None
    ours = [node for node in nodes if not node.has_other_master]
    streams = [(node.stream, buses[node.patch.bus].ticks) for node in ours]
    stack.callback(_let_scans_end, streams, hand.sync.period_s)
    senders = [(bus.link.send, bus.ticks) for bus in own]
    of_buses = [bus.link.defects for bus in own]
    sync = SyncProducer(senders, hand.sync.period_s, hand.sync.stagger_s, of_buses)
    return stack.enter_context(sync)


def _logged_already(error: Exception) -> None:
    """Ignore an exception on a bus. It is logged, and the health watch publishes it as an event."""


def _let_scans_end(streams: Sequence[tuple[PatchStream, Ticks]], period_s: float) -> None:
    """Wait for the scans of the last SYNC, so that the shutdown does not interrupt them."""
    end_s = clock.monotonic() + min(1.5 * period_s, LAST_SCAN_S)
    while not all(stream.settled(ticks.newest) for stream, ticks in streams):
        if clock.monotonic() > end_s:
            return
        clock.sleep(_POLL_S)


def _stand_by(node: RemoteNode) -> None:
    if node.has_other_master or not node.monitor.running:
        return
    node.monitor.running = False
    try:
        nmt_master.stand_by(node.link.send, node.patch.node_id)
    except Exception as error:  # the bus may have failed, but the shutdown must continue
        _log.warning("node %d could not be made pre-operational: %s", node.patch.node_id, error)
