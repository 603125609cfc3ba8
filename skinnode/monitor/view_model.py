"""Computes the screen content, as immutable data, from snapshots."""

from __future__ import annotations

import functools
import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from skinnode.canopen.emergency import register_text
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.config.patches import LayoutConfig
from skinnode.host.events import HealthEvent
from skinnode.host.health import Condition, PatchHealth
from skinnode.host.patch_stream import StreamStats
from skinnode.host.trust_report import deepest_data_share
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.distrust_text import why_not
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.monitor.field_map import Surface, mean_shear_m, surface_of
from skinnode.monitor.source import Arrivals, Snapshot
from skinnode.monitor.touches import Touch, touches_of

Level = Literal["good", "note", "bad"]
"""Severity of a condition: ``good`` for no fault, ``note`` for a condition to check, ``bad`` for a fault."""
HISTORY_NS: Final = 2_000_000_000
"""Period over which rates and latencies are computed, in ns."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchView:
    """View of one patch."""

    name: str
    node_id: int
    bus: str
    condition: str
    level: Level
    words: tuple[str, ...]
    """Descriptions of the patch's faults, most severe first."""
    health: PatchHealth
    stream: StreamStats | None
    """Counters of the patch; None for a remote hand, whose daemon does not send them."""
    arrivals: Arrivals
    rate_hz: float
    """Fields per second."""
    latency_s: float | None
    """Median time in seconds from the arrival of a scan's last CAN frame until its field is ready."""
    latency_max_s: float | None
    scan: int | None
    trusted: bool
    distrust: str
    """Reason why the newest field is not trusted; empty if the field is trusted or does not exist."""
    precise: bool
    data_share: float | None
    """Fraction of the maximum depth that comes from the data, not the prior; None if there is no field."""
    data_faults: tuple[DataFault, ...]
    """Faulty readings excluded from the newest field."""
    method: str
    surface: Surface | None
    depth_m: float | None
    depth_std_m: float | None
    """Standard deviation of the deepest electrode's depth, in metres."""
    shear_m: tuple[float, float]
    """Depth-weighted mean shear (x, y) in metres."""
    touches: tuple[Touch, ...]


@dataclass(frozen=True, slots=True)
class BusView:
    """View of one bus."""

    name: str
    where: str
    role: str
    level: Level
    words: tuple[str, ...]
    load: float | None
    """Bus load over the last second, as a fraction of the bus capacity; None if a remote hand's daemon is not
    sending data."""
    frames_hz: float | None
    """Frames per second; None for a remote hand, whose daemon does not send this number."""
    lost: int
    """Number of frames dropped by the kernel or the host."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """View of the whole hand at one instant."""

    t_ns: int
    patches: tuple[PatchView, ...]
    buses: tuple[BusView, ...]
    scans_hz: float
    """Fields per second from the fastest patch; equal to the SYNC rate if no scan is lost."""
    fields_hz: float
    """Fields per second, summed over all patches."""
    latency_s: float | None
    latency_max_s: float | None
    away: str | None = None
    """Reason why no data is arriving from a remote hand's daemon; None while data is arriving."""

    @property
    def deepest_m(self) -> float:
        """Depth of the deepest press on any patch, in metres."""
        return max((patch.depth_m or 0.0 for patch in self.patches), default=0.0)

    def patch(self, name: str) -> PatchView:
        """Return a patch by its name. Raises KeyError for an unknown name."""
        return {patch.name: patch for patch in self.patches}[name]


@dataclass(frozen=True, slots=True)
class LogLine:
    """Entry in the event log: an event and its time of day."""

    time: str
    subject: str
    text: str
    level: Level


class History:
    """Snapshots of the last few seconds, from which views are computed; see :func:`view_of`."""

    def __init__(self, hand: HandConfig, *, live: bool = True, maps: bool = True) -> None:
        self._hand, self._live, self._maps = hand, live, maps
        self._kept: deque[Snapshot] = deque()

    def add(self, snapshot: Snapshot) -> View:
        """Add the newest snapshot and return its view."""
        kept = self._kept
        if kept and kept[-1].t_ns > snapshot.t_ns:
            kept.clear()  # in a recording, the clock can go backwards
        elif kept and kept[-1].t_ns == snapshot.t_ns:
            kept.pop()
        kept.append(snapshot)
        while len(kept) > 2 and kept[1].t_ns < snapshot.t_ns - HISTORY_NS:
            kept.popleft()
        return view_of(self._hand, kept, live=self._live, maps=self._maps)


def view_of(hand: HandConfig, history: Sequence[Snapshot], *, live: bool = True, maps: bool = True) -> View:
    """Return the view of the newest snapshot.

    Args:
        hand: The hand.
        history: Snapshots, oldest first; rates are averages over the whole history.
        live: Whether the source is a running host; a recording has no latencies.
        maps: Whether to compute what only the monitor shows: the surface, shear and touches of each patch.
    """
    now, before = history[-1], history[0]
    elapsed_s = max(1e-3, (now.t_ns - before.t_ns) * 1e-9)
    patches = tuple(_patch_view(patch, history, elapsed_s, live, maps) for patch in hand.patches)
    buses = tuple(_bus_view(bus, now, before, elapsed_s) for bus in hand.buses if bus.name in now.bus_health)
    slowest = [patch.latency_max_s for patch in patches if patch.latency_max_s is not None]
    medians = [patch.latency_s for patch in patches if patch.latency_s is not None]
    return View(
        t_ns=now.t_ns,
        patches=patches,
        buses=buses,
        scans_hz=max(patch.rate_hz for patch in patches),
        fields_hz=sum(patch.rate_hz for patch in patches),
        latency_s=statistics.median(medians) if medians else None,
        latency_max_s=max(slowest, default=None),
        away=now.away,
    )


def _patch_view(
    patch: PatchConfig, history: Sequence[Snapshot], elapsed_s: float, live: bool, maps: bool
) -> PatchView:
    now, before, name = history[-1], history[0], patch.name
    health, field, arrivals = now.health[name], now.fields[name], now.arrivals[name]
    condition, level, words = judge_patch(health, _recent_losses(name, now, before))
    if now.away is not None:
        words = ("daemon away",)  # the other faults are out of date
    rest_m = now.supplied_m[name] if name in now.supplied_m else upper_m(patch.layout)
    depth_m = depth_std_m = surface = None
    if field is not None:
        depth_m, depth_std_m = _deepest_m(field)
        surface = surface_of(field, rest_m) if maps else None
    latencies = _latencies_s(history, name) if live else []
    return PatchView(
        name=name,
        node_id=patch.node_id,
        bus=patch.bus,
        condition=condition,
        level=level,
        words=words,
        health=health,
        stream=now.streams.get(name),
        arrivals=arrivals,
        rate_hz=max(0, arrivals.received - before.arrivals[name].received) / elapsed_s,
        latency_s=statistics.median(latencies) if latencies else None,
        latency_max_s=max(latencies, default=None),
        scan=None if field is None or field.stamp is None else field.stamp.scan,
        trusted=field is not None and field.trusted,
        distrust="" if field is None else why_not(field),
        precise=field is None or field.precise,
        data_share=None if field is None else deepest_data_share(field),
        data_faults=() if field is None else field.faults,
        method="" if field is None else field.method,
        surface=surface,
        depth_m=depth_m,
        depth_std_m=depth_std_m,
        shear_m=(0.0, 0.0) if surface is None else mean_shear_m(surface),
        touches=() if field is None or not maps else touches_of(field, rest_m),
    )


def _deepest_m(field: FieldFrame) -> tuple[float, float | None]:
    """Return the depth of the most deeply pressed electrode and its standard deviation, in m."""
    std_m = field.displacement_std_m[..., 2]
    known_m = np.where(np.isfinite(std_m), -field.displacement_m[..., 2], -np.inf)
    place = int(known_m.argmax())
    deviation_m = float(std_m.flat[place])
    return max(0.0, float(known_m.flat[place])), deviation_m if math.isfinite(deviation_m) else None


def _latencies_s(history: Sequence[Snapshot], name: str) -> list[float]:
    """Return the latencies, in seconds, of a patch's fields in the given snapshots."""
    found: dict[int, float] = {}
    since_ns = history[-1].t_ns - HISTORY_NS
    for snapshot in history:
        field = snapshot.fields[name]
        if field is not None and field.stamp is not None and field.stamp.t_solved_ns >= since_ns:
            stamp = field.stamp
            found[stamp.scan] = max(0, stamp.t_solved_ns - stamp.t_receive_ns) * 1e-9
    return list(found.values())


@functools.lru_cache(maxsize=128)
def upper_m(layout: LayoutConfig) -> Float:
    """Return the (U, N, 3) electrode positions at rest, in m, according to the hand file."""
    return layout.build().upper_m


def _recent_losses(name: str, now: Snapshot, before: Snapshot) -> list[str]:
    """Describe each kind of data that a patch lost between two snapshots."""
    counts = [("fields", (now.arrivals[name].lost or 0) - (before.arrivals[name].lost or 0))]
    if name in now.streams:
        after, first = now.streams[name].assembler, before.streams[name].assembler
        counts.append(("chunks", after.chunks_lost - first.chunks_lost))
        counts.append(("scans", after.scans_missed - first.scans_missed))
    return [f"{count} {what} lost" for what, count in counts if count > 0]


def judge_patch(health: PatchHealth, lossy: Sequence[str]) -> tuple[str, Level, tuple[str, ...]]:
    """Return the condition of a patch, its severity, and descriptions of its faults.

    Args:
        health: Health of the patch.
        lossy: Descriptions of its recent losses.
    """
    condition, words = health.condition, _faults(health)
    if condition is Condition.STALE and health.scan_age_s is None:
        return "starting", "note", tuple(words)
    if condition is not Condition.OPERATIONAL:
        lossy = []  # the condition already explains these losses
    level: Level = "good"
    if lossy or words:
        level = "note"
    if condition is Condition.BOOTING:
        level = "note"
    elif condition is not Condition.OPERATIONAL or health.duplicate_id:
        level = "bad"
    return str(condition), level, (*words, *lossy)


def _faults(health: PatchHealth) -> list[str]:
    words = []
    if health.refusal:
        words.append(health.refusal)
    if health.defect:
        words.append(health.defect)
    if health.complaint and health.condition is not Condition.OPERATIONAL and health.complaint not in words:
        words.append(health.complaint)
    if health.duplicate_id:
        words.append(f"two nodes have node-ID {health.node_id}")
    if health.restarts_in_a_loop:
        words.append("restarts in a loop: check its supply and watchdog")
    words += [f"{fault.side} wire {fault.number} {fault.state}" for fault in health.wires]
    words += [
        f"{fault.place} {fault.kind}"
        for fault in health.faults
        if fault.part is not FaultyPart.PATCH and fault.kind not in (FaultKind.OPEN, FaultKind.SHORT)
    ]
    if health.error_register:
        words.append(health.emergency_text or f"error: {register_text(health.error_register)}")
    return words


def _bus_view(bus: BusConfig, now: Snapshot, before: Snapshot, elapsed_s: float) -> BusView:
    health, frames_hz = now.bus_health[bus.name], None
    if bus.name in now.buses:
        stats, first = now.buses[bus.name], before.buses[bus.name]
        frames_hz = max(0, stats.received + stats.sent - first.received - first.sent) / elapsed_s
    words = []
    if health.away is not None:
        words.append(f"away: {health.away}")
    if health.no_sync:
        words.append("no SYNC received from its master")
    if health.controller not in (None, "error active"):
        words.append(f"the controller is {health.controller}")
    lost = health.kernel_dropped + health.dropped
    for count, text in (
        (health.bus_offs, "bus-off"),
        (lost, "frames lost"),
        (health.error_frames, "error frames"),
        (health.malformed, "frames malformed"),
        (health.other_masters, "commands of another master"),
        (health.other_syncs, "SYNCs of another producer"),
    ):
        if count:
            words.append(f"{count} {text}")
    level: Level = "bad" if words else "good"
    if health.foreign:
        shown = ", ".join(f"0x{cob_id:03X}" for cob_id in health.foreign_ids[:3])
        words.append(
            f"{health.foreign} foreign frames ({shown}{' …' if len(health.foreign_ids) > 3 else ''})"
        )
        level = "note" if level == "good" else level
    return BusView(
        name=health.bus,
        where=f"{bus.interface} {bus.channel}",
        role=bus.role,
        level=level,
        words=tuple(words),
        load=None if now.away else health.load,
        frames_hz=frames_hz,
        lost=lost,
    )


def log_line(event: HealthEvent, wall_minus_mono_ns: int) -> LogLine:
    """Format an event as a line for the event log."""
    return LogLine(time_of_day(event.t_ns + wall_minus_mono_ns), event.subject, event.text, event.severity)


def time_of_day(t_ns: int) -> str:
    """Format a wall-clock time in ns as the local time of day, to the second."""
    import datetime

    return datetime.datetime.fromtimestamp(t_ns * 1e-9).strftime("%H:%M:%S")
