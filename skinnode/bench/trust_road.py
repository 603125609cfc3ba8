"""Runs a host and simulated nodes with faults on virtual buses, for ``skinnode bench trust``.

Simulated spheres press on a hand of full-size patches. After a fault-free period, a different fault is
injected into each patch. This module imports the simulator to inject the faults.
"""

from __future__ import annotations

import logging
import time
import uuid
from dataclasses import fields
from typing import Any, Final

import numpy as np

from skinnode.bench.trust_score import LIMIT, deviations, trusted_wires
from skinnode.config import HandConfig, parse_hand
from skinnode.host import Host
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.sensor import SimulatedPatch

ROAD: Final[tuple[dict[str, Any], ...]] = (
    {},
    {"lost": 0.05},
    {"lost": 0.5},
    {"torn": 0.3},
    {"summary_lost": 0.3},
    {"corrupted": 0.1},
    {"displaced": 0.2},
    {"understated": 0.2},
    {"frozen": True},
    {"open_upper": 4},
    {"open_lower": 13},
    {"shorted_upper": 4},
    {"shorted_lower": 13},
    {"noisy_upper": 4},
    {"noisy_lower": 13},
    {"frozen_upper": 4},
    {"frozen_lower": 13},
    {"stuck_upper": 4, "stuck_lower": 13},
    {"crossed_upper": 4},
    {"crossed_lower": 13},
    {"flipped": 0.2},
)
"""Fault injected into each patch: changed, missing or repeated values. The first patch has no fault."""
AT_ONCE: Final = 4
"""Number of patches simulated simultaneously by this process."""
CLEAN_S: Final = 1.2
"""Time from bring-up to fault injection, in s. The first press begins during this time."""
FAULTY_S: Final = 4.0
PERIOD_MS: Final = 80


def rows(seed: int) -> list[dict[str, Any]]:
    """Inject the faults and compare the fields with the truth; return one row per patch."""
    found = []
    kept = logging.getLogger("skinnode")
    level = kept.level
    kept.setLevel(logging.CRITICAL)  # hide the warnings caused by injected faults
    try:
        for first in range(0, len(ROAD), AT_ONCE):
            found += _together(ROAD[first : first + AT_ONCE], seed)
    finally:
        kept.setLevel(level)
    return found


def _together(kinds: tuple[dict[str, Any], ...], seed: int) -> list[dict[str, Any]]:
    hand = _hand(len(kinds), seed)
    names = [patch.name for patch in hand.patches]
    taken: dict[str, list[FieldFrame]] = {name: [] for name in names}
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        host.on_field(lambda field: taken[_patch(field)].append(field), capacity=1000)
        until_s = time.monotonic() + 60.0
        while not all(taken.values()) and time.monotonic() < until_s:
            time.sleep(0.05)
        time.sleep(CLEAN_S)
        begin_ns = time.monotonic_ns()
        for name, kind in zip(names, kinds, strict=True):
            fleet.inject(Faults(seed=seed, **kind), name)
        time.sleep(FAULTY_S)
        conditions = {name: str(host.health(name).condition) for name in names}
        sources = fleet.patches
    return [
        _row(kind, taken[name], sources[name], conditions[name], begin_ns)
        for name, kind in zip(names, kinds, strict=True)
    ]


def _patch(field: FieldFrame) -> str:
    assert field.stamp is not None  # the host timestamps every field
    return field.stamp.patch


def _hand(patches: int, seed: int) -> HandConfig:
    buses = [{"name": f"can{i}", "channel": f"trust-{uuid.uuid4().hex}"} for i in range(patches)]
    return parse_hand(
        {
            "buses": buses,
            "patches": [
                {"name": f"p{i}", "node_id": 5 + i, "bus": f"can{i}", "tolerances": "exact"}
                for i in range(patches)
            ],
            "sync": {"period_ms": PERIOD_MS},
            "simulation": {"seed": seed, "cycle_s": 3.0},
        }
    )


def _row(
    kind: dict[str, Any], taken: list[FieldFrame], source: SimulatedPatch, condition: str, begin_ns: int
) -> dict[str, Any]:
    after = [field for field in taken if field.stamp is not None and field.stamp.t_sync_ns > begin_ns]
    trusted = beyond = coordinates = 0
    worst = 0.0
    rest = source.scene.layout.upper_m
    for field in after:
        off = deviations(field, _truth_m(field, source) - rest)[trusted_wires(field)]
        trusted += field.trusted
        coordinates += off.size
        beyond += int((off > LIMIT).sum())
        worst = max(worst, float(off.max(initial=0.0)))
    named = sorted({f"{fault.place}: {fault.kind}" for field in after for fault in field.faults})
    return {
        "fault": ", ".join(f"{name} {value}" for name, value in kind.items()) or "none",
        "fields": len(after),
        "trusted": trusted,
        "beyond": beyond,
        "coordinates": coordinates,
        "worst": worst,
        "named": named,
        "condition": condition,
    }


def _truth_m(field: FieldFrame, source: SimulatedPatch) -> Float:
    """Return the true electrode positions at the conversion time or, if unknown, at the time of the SYNC."""
    stamp = field.stamp
    assert stamp is not None
    try:
        t_ns = source.read_ns(stamp.device_time_us)
    except LookupError:
        t_ns = stamp.t_sync_ns
    return np.asarray(source.truth_m(t_ns))


def known_faults() -> set[str]:
    """Return the names of all faults that the simulator supports."""
    return {entry.name for entry in fields(Faults)}


HEAD: Final = f"  {'':24}{'fields':>8}{'trusted':>9}{'beyond 5':>10}{'worst':>9}  condition, named"


def text(row: dict[str, Any]) -> str:
    """Format a row of the table."""
    worst = row["worst"]
    off = "-" if worst is None else f"{worst:.3g}"
    named = "; ".join(row["named"][:3]) + (
        f" and {len(row['named']) - 3} more" if len(row["named"]) > 3 else ""
    )
    return (
        f"  {row['fault']:24}{row['fields']:8}{row['trusted']:9}{row['beyond']:10}{off:>9}"
        f"  {row['condition']}{', ' if named else ''}{named}"
    )
