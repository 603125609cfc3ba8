"""Handle SYNC, LSS, other masters and health for a bus of the hand."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.canopen import indices as od
from skinnode.config import HandConfig
from skinnode.host.health import SYNCS_MISSED, BusHealth
from skinnode.host.link import BusLink
from skinnode.host.lss_master import LssMaster
from skinnode.host.other_masters import OtherMasters
from skinnode.host.reception import receive_bus
from skinnode.host.sync import SyncFollower, Ticks


@dataclass(frozen=True, slots=True)
class ServedBus:
    """Bus of the hand: its SYNC times, SYNC follower, LSS master, and detector of other masters."""

    link: BusLink
    ticks: Ticks
    other_masters: OtherMasters
    follower: SyncFollower
    lss: LssMaster

    def health(self, *, no_sync: bool) -> BusHealth:
        """Return the health of the bus, including ``no_sync``."""
        masters, stats, failure = self.other_masters.stats(), self.link.stats(), self.link.failure
        return BusHealth(
            bus=self.link.config.name,
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
            other_syncs=masters.syncs,
            other_masters=masters.nmt_commands + masters.sdo_requests + masters.heartbeats,
            controller=stats.controller,
            no_sync=no_sync,
        )

    def sync_is_late(self, t_up_ns: int, period_ns: int) -> bool:
        """Return whether another master's SYNC has been missing for :data:`SYNCS_MISSED` periods.

        The time is measured up to the newest dispatched frame. If it were measured up to now, a delay in the
        host would look like a missing SYNC.

        Args:
            t_up_ns: Monotonic time (ns) at which bring-up ended.
            period_ns: SYNC period (ns).
        """
        if self.link.config.role == "master" or self.link.failure is not None:
            return False
        since_ns = max(t_up_ns, self.follower.t_newest_ns)
        return self.link.t_dispatched_ns - since_ns >= SYNCS_MISSED * period_ns


def serve_bus(hand: HandConfig, link: BusLink) -> ServedBus:
    """Register the handlers for other masters' frames and for LSS responses."""
    ticks = Ticks(hand.sync.counter_overflow)
    heard, lss = receive_bus(hand, link, ticks), LssMaster(link.send)
    link.handle(od.LSS_RESPONSE_COB_ID, lss.on_response)
    return ServedBus(link, ticks, heard.other_masters, heard.follower, lss)
