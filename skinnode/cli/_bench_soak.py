"""A hand under random faults for minutes: does the host grow, and do its sums agree with the injector's?

Simulated nodes with faults and the host share this process and two virtual buses. A round injects one or two
faults into one patch or all, takes them away, and waits until every patch streams again; subscribers come and
go meanwhile. Memory is compared between two calm instants, one after a warm-up and one at the end: blocks
that Python has allocated (:func:`sys.getallocatedblocks`, which a single object kept a scan would show) and
resident memory. This file may import the simulator, as the demo may: faults have to come from somewhere.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import random
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from sys import getallocatedblocks
from typing import Any, Final

from skinnode.host import Host, HostStats
from skinnode.host.accounting import discrepancies
from skinnode.model.config import HandConfig, parse_hand
from skinnode.model.frames import FieldFrame
from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.fleet import Fleet
from vcan_sim.sensor import REMEMBERED_READINGS

WARM_UP: Final = 0.25
"""Share of the time after which memory is looked at for the first time."""
BLOCKS: Final = 2000
"""Growth allowed: a few hundred come and go with what is under way; a leak of one a scan makes 10,000 in
three minutes."""
RESIDENT_MB: Final = 8.0
"""Of the allocator of C, which gives memory back as it likes."""
BACK_S: Final = 15.0
"""A stream that is not back by then is lost. It should take one; a loaded machine may need more."""
SLOW_S: Final = 1.0
"""Rounds that took longer are told."""
CALM_S: Final = 1.5
_PATCHES: Final = 4

_KINDS: Final[tuple[dict[str, Any], ...]] = (
    {"lost": 0.05},
    {"duplicated": 0.05},
    {"reordered": 0.05},
    {"late": 0.02},
    {"short": 0.03},
    {"remote": 0.03},
    {"miscounted": 0.02},
    {"torn": 0.1},
    {"summary_lost": 0.1},
    {"reset": 0.05},
    {"sync_lost": 0.1},
    {"long": 0.5},
    {"silent": True},
    {"deaf": True},
    {"frozen": True},
    {"unplugged": True},
    {"restart_every_s": 0.7},
    {"emcy_per_s": 200.0},
    {"babble_per_s": 500.0},
    {"unplugged": True, "wrong_identity": True},
    {"unplugged": True, "wrong_layout": True},
)


@dataclass(frozen=True, slots=True)
class _Size:
    """What must not grow."""

    blocks: int
    resident_mb: float
    threads: int
    descriptors: int


def run(minutes: float, seed: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Soak for ``minutes``; progress goes to ``report``. Raises as :meth:`Host.from_config`."""
    chance = random.Random(seed)
    hand = _hand()
    kept = logging.getLogger("skinnode")
    level = kept.level
    kept.setLevel(logging.ERROR)  # thousands of warnings of what is injected
    try:
        fleet = Fleet(hand)
        for source in fleet.patches.values():
            for k in range(REMEMBERED_READINGS):  # it grows up to that
                source.read(-1000 * (k + 1))
        with fleet, Host.from_config(hand) as host:
            figures = _soak(host, fleet, chance, minutes * 60.0, report)
            fleet.stop()
            stats = _standing_still(host)
            injected = {patch.name: fleet.injected(patch.name) for patch in hand.patches}
    finally:
        kept.setLevel(level)
    sums = discrepancies(stats) + _against_injected(stats, injected)
    lanes = stats.patches.values()
    figures["frames"] = sum(bus.received for bus in stats.buses.values())
    figures["scans"] = sum(lane.offered + lane.withheld + lane.partial for lane in lanes)
    figures["fields"] = sum(lane.solved for lane in lanes)
    figures["rejoins"] = sum(node.rejoins for node in stats.nodes.values())
    figures["discrepancies"] = sums
    figures["injected"] = {
        name: sum(getattr(each, name) for each in injected.values()) for name in Injected.__dataclass_fields__
    }
    figures["must"] = _must(figures)
    return figures


def _hand() -> HandConfig:
    small = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
    buses = [{"name": f"can{i}", "channel": f"soak-{uuid.uuid4().hex}"} for i in range(2)]
    patches = [
        {"name": f"p{i}", "node_id": 5 + i, "bus": f"can{i % 2}", "layout": small} for i in range(_PATCHES)
    ]
    beat = {"heartbeat_ms": 100}
    return parse_hand({"buses": buses, "patches": patches, "sync": {"period_ms": 40}, "bring_up": beat})


def _soak(
    host: Host, fleet: Fleet, chance: random.Random, seconds: float, report: Callable[[str], None]
) -> dict[str, Any]:
    names = [patch.name for patch in host.hand.patches]
    begin_s, rounds, slowest_s, lost = time.monotonic(), 0, 0.0, 0
    first: _Size | None = None
    while (passed_s := time.monotonic() - begin_s) < seconds:
        if first is None and passed_s > WARM_UP * seconds:
            _all_at_once(host, fleet, names)
            first = _size()
            report(f"{passed_s:6.0f} s: {_told(first)}")
        what = _inject(fleet, chance, names)
        with host.fields(capacity=2) as abandoned:
            callback = host.on_field(_broken if rounds % 2 else _patient, capacity=4)
            abandoned.get(0.1)
            time.sleep(chance.uniform(0.3, 2.0))
            callback.close()
        _calm(fleet)
        back_s = _wait_for_streams(host, names)
        rounds += 1
        slowest_s = max(slowest_s, back_s)
        lost += back_s >= BACK_S
        if rounds % 20 == 0 or back_s >= SLOW_S:
            report(f"{time.monotonic() - begin_s:6.0f} s: round {rounds}, {what}; back after {back_s:.2f} s")
    time.sleep(CALM_S)
    last = _size()
    report(f"{time.monotonic() - begin_s:6.0f} s: {_told(last)}")
    first = first or last
    return {
        "seconds": time.monotonic() - begin_s,
        "rounds": rounds,
        "slowest_back_s": slowest_s,
        "not_back": lost,
        "grown_blocks": last.blocks - first.blocks,
        "grown_mb": last.resident_mb - first.resident_mb,
        "grown_threads": last.threads - first.threads,
        "grown_descriptors": last.descriptors - first.descriptors,
    }


def _all_at_once(host: Host, fleet: Fleet, names: list[str]) -> None:
    """Every patch has to be brought up at the same time: as many threads as there will ever be."""
    fleet.inject(Faults(unplugged=True))
    time.sleep(CALM_S)
    _calm(fleet)
    _wait_for_streams(host, names)
    time.sleep(CALM_S)


def _inject(fleet: Fleet, chance: random.Random, names: list[str]) -> str:
    """The faults of a round; what they are."""
    if chance.random() < 0.05:
        bus = chance.choice(fleet.hand.buses).name
        fleet.bus_off(bus, off=True)
        return f"{bus} off"
    kinds: dict[str, Any] = {}
    for kind in chance.sample(_KINDS, chance.choice((1, 2))):
        kinds |= kind
    patch = None if chance.random() < 0.2 else chance.choice(names)
    fleet.inject(Faults(**kinds), patch)
    return f"{', '.join(kinds)} of {patch or 'all'}"


def _calm(fleet: Fleet) -> None:
    for bus in fleet.hand.buses:
        fleet.bus_off(bus.name, off=False)
    fleet.inject(NO_FAULTS)


def _wait_for_streams(host: Host, names: list[str]) -> float:
    """Until every patch has given a field of a SYNC from now on, s."""
    begin_ns = time.monotonic_ns()

    def back(name: str) -> bool:
        field = host.latest(name)
        return field is not None and field.stamp is not None and field.stamp.t_sync_ns > begin_ns

    while not all(back(name) for name in names):
        if time.monotonic_ns() > begin_ns + BACK_S * 1e9:
            return BACK_S
        time.sleep(0.01)
    return (time.monotonic_ns() - begin_ns) * 1e-9


def _broken(field: FieldFrame) -> None:
    raise RuntimeError("a subscriber's own defect")


def _patient(field: FieldFrame) -> None:
    time.sleep(0.2)


def _standing_still(host: Host) -> HostStats:
    """Counters when nothing comes any more and everything has been worked off."""
    last, stats = None, host.stats()
    for _ in range(100):
        now = (
            [stats.buses[name].read for name in stats.buses],
            [lane.solved for lane in stats.patches.values()],
        )
        if now == last:
            break
        last = now
        time.sleep(0.3)
        stats = host.stats()
    return stats


def _size() -> _Size:
    for _ in range(3):
        gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's
    if trim is not None:
        trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return _Size(
        getallocatedblocks(),
        pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        threading.active_count(),
        len(os.listdir("/proc/self/fd")),
    )


def _told(size: _Size) -> str:
    return (
        f"{size.blocks} blocks, {size.resident_mb:.1f} MB resident, {size.threads} threads, "
        f"{size.descriptors} file descriptors"
    )


def _against_injected(stats: HostStats, injected: dict[str, Injected]) -> list[str]:
    """What the host counted otherwise than whoever injected it."""
    found = [
        f"{name}: got {stats.patches[name].frames} chunks and summaries, must be the {each.pdos} sent"
        for name, each in injected.items()
        if stats.patches[name].frames != each.pdos
    ]
    lanes, buses = stats.patches.values(), stats.buses.values()
    short = sum(lane.assembler.bad_length for lane in lanes)
    for what, got, name in (
        ("remote frames", sum(bus.ignored for bus in buses), "remote"),
        ("short chunks", short, "short"),
        ("long heartbeats", sum(bus.malformed for bus in buses) - short, "long"),
        ("foreign frames", sum(bus.foreign for bus in buses), "babbled"),
        ("frames lost to the host's queue", sum(bus.dropped for bus in buses), None),
    ):
        must = sum(getattr(each, name) for each in injected.values()) if name else 0
        if got != must:
            found.append(f"{what}: got {got}, must be {must}")
    return found


def _must(figures: dict[str, Any]) -> list[dict[str, Any]]:
    asked = (
        ("growth: blocks of Python", "grown_blocks", BLOCKS),
        ("growth: resident memory, MB", "grown_mb", RESIDENT_MB),
        ("growth: threads", "grown_threads", 0),
        ("growth: file descriptors", "grown_descriptors", 0),
        ("streams that did not come back", "not_back", 0),
    )
    must = [
        {"what": what, "got": figures[name], "asked": most, "reached": figures[name] <= most}
        for what, name, most in asked
    ]
    wrong = len(figures["discrepancies"])
    return [*must, {"what": "sums that do not agree", "got": wrong, "asked": 0, "reached": wrong == 0}]
