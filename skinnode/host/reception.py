"""Register a host's handlers for the frames on a bus.

The functions in this module send no frames, start no threads and never block, so a replay can use them for
recorded frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import STATE_MASK, NmtState
from skinnode.config import HandConfig, PatchConfig
from skinnode.host.arrivals import ArrivalPredictor
from skinnode.host.code_watch import CodeWatch
from skinnode.host.dispatcher import Dispatcher
from skinnode.host.node_monitor import NodeMonitor
from skinnode.host.other_masters import OtherMasters
from skinnode.host.patch_stream import PatchStream, StreamOptions, StreamOutput
from skinnode.host.sync import SyncFollower, Ticks
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import Scan

LEAST_GRACE_NS: Final = 5_000_000
"""Minimum time (ns) to wait for the summary of a scan after its last chunk. The host waits at least half a
SYNC period, because the chunks of all patches take precedence over the summary on the bus.
"""


@dataclass(frozen=True, slots=True)
class PatchReception:
    """Receivers of a patch's frames."""

    stream: PatchStream
    monitor: NodeMonitor


@dataclass(frozen=True, slots=True)
class BusReception:
    """Receivers of other masters' frames on a bus."""

    other_masters: OtherMasters
    follower: SyncFollower


def receive_bus(hand: HandConfig, dispatcher: Dispatcher, ticks: Ticks) -> BusReception:
    """Register the handlers for other masters' frames on a bus."""
    config = dispatcher.config
    other_masters, follower = OtherMasters(config), SyncFollower(ticks)
    for cob_id, handler in other_masters.handlers(
        [patch.node_id for patch in hand.patches_on(config.name)]
    ).items():
        dispatcher.handle(cob_id, handler)
    if config.role == "guest":
        dispatcher.handle(od.SYNC_COB_ID, follower.on_sync)
        dispatcher.handle(od.NMT_COB_ID, _ignore)
    return BusReception(other_masters, follower)


def receive_patch(
    patch: PatchConfig,
    hand: HandConfig,
    dispatcher: Dispatcher,
    ticks: Ticks,
    output: StreamOutput,
) -> PatchReception:
    """Register the handlers for a patch's frames.

    The stream withholds scans until it has a solver. Scans may arrive immediately if a previous host left the
    node operational.

    Args:
        patch: Configuration of the patch.
        hand: Configuration of the hand to which the patch belongs.
        dispatcher: Dispatcher of the patch's bus.
        ticks: SYNC times of the patch's bus.
        output: Workers and publisher for the patch's scans, and collector of exceptions. Without a collector,
            handlers raise their exceptions, and an exception in the solver stops the publisher.
    """
    period_ns = hand.sync.period_ms * 1_000_000
    watch = CodeWatch(CodeScale(patch.code_bits), patch.relative_noise)
    monitor = NodeMonitor(patch.name, patch.node_id, dispatcher.reject, watch)

    arrivals = ArrivalPredictor(period_ns)
    dispatcher.expect(patch.name, ())  # no prediction before the first scan

    def on_scan(scan: Scan) -> None:
        if not scan.empty:
            monitor.on_scan(scan.t_last_ns)
        dispatcher.expect(patch.name, arrivals.next_ns(scan.t_last_ns))

    assembler = ScanAssembler(
        PatchProfile.from_config(patch, dispatcher.config),
        counter_overflow=ticks.counter_overflow,
        period_ns=period_ns,
        grace_ns=max(LEAST_GRACE_NS, hand.sync.period_ms * 500_000),
        node_id=patch.node_id,
        on_reject=dispatcher.reject,
        under_way=True,
    )
    options = StreamOptions(
        tick=ticks.find,
        on_scan=on_scan,
        judge=watch.judge,
        watch=watch.on_scan,
        partial=hand.stream.partial,
        under_way=dispatcher.config.role == "guest",
    )
    stream = PatchStream(patch.name, assembler, output, options)

    def on_heartbeat(data: bytes, t_ns: int) -> None:
        monitor.on_heartbeat(data, t_ns)
        if len(data) == 1 and data[0] & STATE_MASK == NmtState.INITIALISING:
            stream.withhold()  # a node loses its configuration when it boots

    dispatcher.handle(od.heartbeat_cob_id(patch.node_id), on_heartbeat, output.defects)
    dispatcher.handle(od.emcy_cob_id(patch.node_id), monitor.on_emergency, output.defects)
    dispatcher.handle(od.chunk_cob_id(patch.node_id), stream.on_chunk, output.defects)
    dispatcher.handle(od.summary_cob_id(patch.node_id), stream.on_summary, output.defects)
    dispatcher.poll_with(stream.poll, output.defects)
    return PatchReception(stream, monitor)


def _ignore(data: bytes, t_ns: int) -> None:
    """Ignore an NMT command from the bus's master."""
