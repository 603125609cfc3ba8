"""Collects the faults of a monitoring session and reports the current view as JSON."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, Final

from skinnode.host.accounting import losses_of_stream
from skinnode.host.health import Condition, PatchHealth
from skinnode.host.patch_stream import StreamStats
from skinnode.host.trust_report import fault_table
from skinnode.monitor.source import Source
from skinnode.monitor.touches import Touch
from skinnode.monitor.view_model import History, PatchView, View
from skinnode.process import clock
from skinnode.text.words import counted

SETTLE_NS: Final = 3_000_000_000
"""Time (ns) within which all patches of a running hand must become operational."""

LOOK_S: Final = 0.1
"""Interval between checks of the source for faults, in seconds."""

LINE_S: Final = 1.0
"""Interval between JSON lines, in seconds."""


class FaultBook:
    """Faults of a monitoring session, each listed once, in order of first occurrence.

    Args:
        live: Whether the source is a running hand, whose patches must be operational soon after start-up. A
            recording can begin before its patches are started, so they are checked only at the end.
    """

    def __init__(self, *, live: bool) -> None:
        self._live = live
        self._found: dict[tuple[str, str], str] = {}
        self._begun_ns: int | None = None
        self._settled: set[str] = set()

    @property
    def lines(self) -> list[str]:
        """One line of text per fault."""
        return list(self._found.values())

    def update(self, view: View, real_ns: int, *, ending: bool = False) -> None:
        """Record every fault in a view.

        Args:
            view: Current view of the hand.
            real_ns: Monotonic time of the monitor, in ns.
            ending: Whether the session is ending; a patch that has never been operational then counts as a
                fault.
        """
        if self._begun_ns is None:
            self._begun_ns = real_ns
        patient = not ending and not (self._live and real_ns - self._begun_ns >= SETTLE_NS)
        for patch in view.patches:
            if patch.condition == Condition.OPERATIONAL:
                self._settled.add(patch.name)
            elif patch.name in self._settled or not patient:
                self._add(patch.name, patch.condition, patch.condition)
            for key, text in (*_lasting(patch.health), *_losses(patch)):
                self._add(patch.name, key, text)
        for bus in view.buses:
            if bus.level == "bad":
                for word in bus.words:
                    self._add(bus.name, word.lstrip("0123456789 ").partition(":")[0], word)

    def _add(self, subject: str, key: str, text: str) -> None:
        self._found[subject, key] = f"{subject}: {text}"


def _lasting(health: PatchHealth) -> list[tuple[str, str]]:
    """Return (key, text) pairs for a patch's wire faults, duplicate node-ID and last EMCY message."""
    wires = [f"{fault.side} wire {fault.number} {fault.state}" for fault in health.wires]
    found = [(text, text) for text in wires]
    if health.duplicate_id:
        found.append(("duplicate", f"two nodes have node-ID {health.node_id}"))
    if health.last_emergency:
        code = f"EMCY 0x{health.last_emergency:04X}"
        found.append((code, f"{code} {health.emergency_text}"))
    return found


def _losses(patch: PatchView) -> list[tuple[str, str]]:
    """Return (counter, text) pairs for the nonzero loss counters of a patch."""
    found = [] if patch.stream is None else list(losses_of_stream(patch.stream).items())
    if patch.arrivals.lost:
        lost = counted(patch.arrivals.lost, "field lost", "fields lost")
        found.append(("fields", f"{lost} between its daemon and this process"))
    return found


def watch(
    source: Source, stop: threading.Event, seconds: float | None, faults: FaultBook
) -> Iterator[dict[str, Any]]:
    """Yield the current view as a JSON object every second, and once more at the end.

    Args:
        source: Host, remote hand or recording.
        stop: Event that ends the iteration.
        seconds: Maximum duration; None for no limit.
        faults: Faults of the session, updated at each check.

    Raises:
        SkinError: If the source has failed.
    """
    begun_s = due_s = clock.monotonic()
    due_s += LINE_S
    history = History(source.hand, live=source.live)
    ending, pending = False, list[str]()
    while not ending:
        ending = stop.wait(LOOK_S) or source.over
        now_s = clock.monotonic()
        ending |= seconds is not None and now_s >= begun_s + seconds
        view = history.add(source.snapshot())
        faults.update(view, clock.monotonic_ns(), ending=ending)
        pending += [str(event) for event in source.events()]
        if ending or now_s >= due_s:
            due_s += LINE_S
            yield {"elapsed_s": round(now_s - begun_s, 2), **as_json(view), "events": pending}
            pending = []


def as_json(view: View) -> dict[str, Any]:
    """Return the view as JSON-compatible data, with None for unavailable values and no displacements."""
    return {
        "patches": {patch.name: _patch_json(patch) for patch in view.patches},
        "buses": {
            bus.name: {
                "level": bus.level,
                "words": list(bus.words),
                "load": None if bus.load is None else round(bus.load, 4),
                "frames_hz": None if bus.frames_hz is None else round(bus.frames_hz, 1),
                "lost": bus.lost,
            }
            for bus in view.buses
        },
        "fields_hz": round(view.fields_hz, 2),
        "latency_s": view.latency_s,
        "latency_max_s": view.latency_max_s,
        "away": view.away,
    }


def _patch_json(patch: PatchView) -> dict[str, Any]:
    return {
        "node_id": patch.node_id,
        "bus": patch.bus,
        "condition": patch.condition,
        "level": patch.level,
        "words": list(patch.words),
        "wires": [
            {"side": fault.side, "number": fault.number, "state": str(fault.state)}
            for fault in patch.health.wires
        ],
        "alive": str(patch.health.alive),
        "emergencies": patch.health.emergencies,
        "rate_hz": round(patch.rate_hz, 2),
        "latency_s": patch.latency_s,
        "latency_max_s": patch.latency_max_s,
        "scan": patch.scan,
        "trusted": patch.trusted,
        "distrust": patch.distrust,
        "precise": patch.precise,
        "deepest_data_share": patch.data_share,
        "data_faults": [fault_table(fault) for fault in patch.data_faults],
        **_losses_json(patch.stream),
        "fields_lost": patch.arrivals.lost,
        "transit_s": patch.arrivals.transit_s,
        "depth_m": patch.depth_m,
        "depth_std_m": patch.depth_std_m,
        "shear_m": list(patch.shear_m),
        "touches": [_touch_json(touch) for touch in patch.touches],
    }


def _losses_json(stream: StreamStats | None) -> dict[str, int | None]:
    """Return the loss counters of a patch; None if they are not available."""
    if stream is None:
        return dict.fromkeys(("torn", "corrupt", "missed", "skipped", "chunks_lost"))
    counts = stream.assembler
    return {
        "torn": counts.scans_torn,
        "corrupt": counts.scans_corrupt,
        "missed": counts.scans_missed,
        "skipped": stream.skipped,
        "chunks_lost": counts.chunks_lost,
    }


def _touch_json(touch: Touch) -> dict[str, Any]:
    return {
        "x_m": touch.x_m,
        "y_m": touch.y_m,
        "place_std_m": touch.place_std_m,
        "depth_m": touch.depth_m,
        "area_m2": touch.area_m2,
        "area_std_m2": touch.area_std_m2,
        "normal_force_n": touch.force_n,
        "normal_force_std_n": touch.force_std_n,
        "shear_force_n": None if touch.shear_n is None else list(touch.shear_n),
    }
