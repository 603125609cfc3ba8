"""Defines the data sources for the monitor and the 3-D view: their interface and their data.

A source is a host in this process, a remote hand or a replayed recording. Sources read only the newest data
and never block the host.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from skinnode.config import HandConfig
from skinnode.host import PatchHealth, Subscription
from skinnode.host.dispatcher import BusStats
from skinnode.host.events import EventSubscription, HealthEvent
from skinnode.host.health import BusHealth
from skinnode.host.patch_stream import StreamStats
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout

QUEUED_EVENTS: Final = 500
"""Maximum number of events queued between two screen updates."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Counters of a patch's fields, as received by the source."""

    received: int
    lost: int | None = None
    """Number of fields lost between the daemon and this process; None if there is no daemon."""
    transit_s: float | None = None
    """Transit time of the newest field from the daemon, in s; None if there is no daemon."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a hand at one instant; the mappings are keyed by patch or bus name."""

    t_ns: int
    """Time in ns on the monotonic clock of the host or, for a recording, of the host that made it."""
    health: Mapping[str, PatchHealth]
    bus_health: Mapping[str, BusHealth]
    fields: Mapping[str, FieldFrame | None]
    arrivals: Mapping[str, Arrivals]
    buses: Mapping[str, BusStats]
    """Counters of each bus; empty for a remote hand, whose daemon does not send them."""
    streams: Mapping[str, StreamStats]
    """Counters of each patch; empty for a remote hand, whose daemon does not send them."""
    supplied_m: Mapping[str, Float]
    """See :func:`supplied_m`."""
    away: str | None = None
    """Reason why no data is arriving from a remote hand's daemon; None while data is arriving."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Progress of a recording."""

    path: Path
    frames: int
    dropped: int
    failure: str | None


class Source(Protocol):
    """Protocol implemented by the data sources.

    All methods except ``tare``, ``reset_node``, ``record`` and ``stop_recording`` return immediately.
    """

    hand: HandConfig
    title: str
    live: bool
    """Whether the hand is running, in this or another process."""

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand. Raises SkinError if the source has failed."""

    def events(self) -> list[HealthEvent]:
        """Return the events that have occurred since the last call."""

    def fields(self, capacity: int) -> Subscription:
        """Subscribe to the fields of all patches; the queue keeps the newest ``capacity`` fields."""

    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields."""

    def now_ns(self) -> int:
        """Return the current time in ns on the monotonic clock used in snapshots."""

    @property
    def wall_minus_mono_ns(self) -> int:
        """Wall-clock time minus the time on the monotonic clock used in snapshots, in ns."""

    @property
    def over(self) -> bool:
        """Whether the source has ended."""

    @property
    def flaws(self) -> list[str]:
        """Descriptions of missing or unreadable data in the replayed recording or in the recordings made."""

    @property
    def no_commands(self) -> str | None:
        """Reason why patches cannot be tared or reset; None if they can."""

    @property
    def no_recording(self) -> str | None:
        """Reason why no recording can be made; None if one can."""

    def tare(self, patch: str) -> None:
        """Tare a patch, as :meth:`RunningHand.tare` does."""

    def reset_node(self, patch: str) -> None:
        """Reset a patch's node, as :meth:`RunningHand.reset_node` does."""

    @property
    def recording(self) -> Recording | None:
        """Progress of the recording being written; None if no recording is being written."""

    def record(self, folder: Path) -> Path:
        """Start a recording and return its path. Raises ConfigError if the recording cannot be written."""

    def stop_recording(self) -> Recording:
        """End the recording and return its final statistics."""

    def close(self) -> None:
        """Release the source's resources."""


def supplied_m(hand: HandConfig, layout: Callable[[str], PatchLayout]) -> dict[str, Float]:
    """Return the electrode positions of the patches that supply them (``coordinates = "node"``).

    The hand file contains the positions of the other patches.

    Args:
        hand: The hand.
        layout: Function that returns the layout used to compute a patch's fields.

    Returns:
        (U, N, 3) positions at rest by patch name, in m; the planned positions until the node has supplied its
        own.
    """
    return {
        patch.name: layout(patch.name).upper_m for patch in hand.patches if patch.layout.coordinates == "node"
    }


def drain(subscription: EventSubscription) -> list[HealthEvent]:
    """Return all queued events, without waiting for more."""
    found: list[HealthEvent] = []
    while (event := subscription.get(0.0)) is not None:
        found.append(event)
    return found
