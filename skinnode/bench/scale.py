"""Measures how CPU time and memory of the simulator and host grow with skin area and number of contacts.

A simulated hand has four patches per bus, and spheres press on some of its patches. The hands run in virtual
time, so that every patch sends every scan even on a slow machine. The simulated buses take the duration of
each frame into account. CPU time is read from the CPU clock of each thread: node threads count towards the
simulator, all other threads towards the host. A bus has no thread of its own. When all threads are waiting,
the last one to start waiting simulates the bus. The CPU time of the bus is measured separately and subtracted
from that of the thread that simulated it.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

from skinnode.bench.memory import resident_mb
from skinnode.bench.timing import machine, take_turns
from skinnode.canopen import indices as od
from skinnode.config import HandConfig, parse_hand
from skinnode.host import Host
from skinnode.process import clock
from skinnode.process.garbage_collection import without_long_collections
from skinnode.protocol.command import SendMode, pack_command
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import PatchScene, SceneConfig, bind_scene, parse_scene
from vcan_sim.sensor import SimulatedPatch
from vcan_sim.timed_bus import BitRates
from vcan_sim.timed_interface import Segment, segment
from vcan_sim.virtual_time import VirtualClock

PATCHES: Final = (1, 4, 16, 64, 256, 1000)
"""Default patch counts; one patch of each hand is touched."""
MOST_FIELDS: Final = 4_000
"""Limit on the product of patches and scans per measurement, so that large hands take only a few minutes."""
LEAST_SCANS: Final = 2
"""Minimum number of scans per measurement."""
FIXED: Final = 16
"""Number of patches in the hand used to vary the number of touched patches."""
TOUCHED: Final = (0, 1, 4, 16)
"""Numbers of touched patches in the hand of :data:`FIXED` patches."""
CHANGED_SCANS: Final = 100
"""Minimum number of scans for hands that send only changed chunks. Every tenth scan is sent in full."""
PATCHES_PER_BUS: Final = 4
PERIOD_MS: Final = 100
_SETTLED_S: Final = 1.0
"""Time from bring-up to measurement in seconds; all presses reach full depth during this time."""

Row = dict[str, Any]


def run(patches: Sequence[int] = PATCHES, scans: int = 20) -> dict[str, Any]:
    """Measure CPU time as a function of skin area and of the number of touched patches.

    Args:
        patches: Patch counts to measure; one patch of each hand is touched.
        scans: Number of scans per measurement; fewer for large hands (:data:`MOST_FIELDS`), and at least
            :data:`CHANGED_SCANS` if only changed chunks are sent.

    Returns:
        The processor and the library versions (``machine``); the lists of rows ``area``, ``contact`` and
        ``changed``; and the result of :func:`physics`. In ``changed``, the patches send only changed chunks.
        A row contains the numbers of ``patches`` and ``touched`` patches, a flag that is true if only changed
        chunks are sent (``changed_only``), the CPU times per patch and scan in ms (``nodes_ms``, ``bus_ms``,
        ``host_ms``), the numbers of measured ``scans`` and solved ``fields``, the ratio of virtual to real
        time (``faster``), and the resident memory of the process (``memory_mb``).
    """
    for count in patches:  # reject an oversized hand now rather than after minutes of measurement
        hand_of(count)
    measure(1, 1, 2)  # compile the kernels and fill the caches
    contact = [measure(FIXED, count, scans) for count in TOUCHED]
    many = max(scans, CHANGED_SCANS)
    changed = [measure(FIXED, count, many, changed_only=True) for count in TOUCHED[:2]]
    return {
        "machine": machine(),
        "area": [measure(count, 1, scans_of(count, scans)) for count in sorted(patches)],
        "contact": contact,
        "changed": changed,
        "physics": physics(),
    }


def scans_of(patches: int, scans: int) -> int:
    """Return the number of scans to measure on a hand: ``scans``, or fewer if the hand is large."""
    return min(scans, max(LEAST_SCANS, MOST_FIELDS // patches))


def measure(patches: int, touched: int, scans: int, *, changed_only: bool = False) -> Row:
    """Measure a hand in which ``touched`` patches are touched.

    Args:
        patches: Number of patches.
        touched: Number of touched patches.
        scans: Number of scans to measure.
        changed_only: Whether the patches send only changed chunks.

    Returns:
        A row as in :func:`run`.
    """
    hand = hand_of(patches)
    with VirtualClock() as virtual:
        rates = BitRates(hand.buses[0].bitrate_bps)
        segments = [segment(bus.channel, virtual, rates) for bus in hand.buses]
        with Fleet(hand, scene=scene_of(touched)) as fleet, Host.from_config(hand) as host:
            clock.sleep(_SETTLED_S)
            if changed_only:
                _send_changed_only(hand)
            memory_mb = resident_mb()
            with without_long_collections():  # as in the commands that run nodes or a host
                solved, start = _solved(host), time.perf_counter()
                clock.sleep(scans * PERIOD_MS * 1e-3)
                real_s = time.perf_counter() - start
                fields = _solved(host) - solved
                for bus in segments:  # measuring the CPU time of a bus slows it down, hence the second run
                    bus.cpu_ns = Counter()
                before = _cpu_ns(segments)
                clock.sleep(scans * PERIOD_MS * 1e-3)
                spent = _cpu_ns(segments) - before
            assert not fleet.failed
    each = 1e-6 / (patches * scans)
    return {
        "patches": patches,
        "touched": touched,
        "changed_only": changed_only,
        "nodes_ms": spent["nodes"] * each,
        "bus_ms": spent["bus"] * each,
        "host_ms": spent["host"] * each,
        "scans": scans,
        "fields": fields,
        "faster": scans * PERIOD_MS * 1e-3 / real_s,
        "memory_mb": memory_mb,
    }


def physics() -> dict[str, float]:
    """Time the simulation of one scan, without the node and its frames.

    Returns:
        ``untouched_us`` and ``touched_us``, the times in µs to compute the resistances of an untouched and a
        pressed patch; ``converter_us``, the time in µs to add the converter noise.
    """
    scenes = bind_scene(scene_of(1), hand_of(2))
    patches = {"touched": _Skin(scenes["patch0"]), "untouched": _Skin(scenes["patch1"])}
    timed = take_turns({**patches, "read": patches["untouched"].read})
    times_us = {f"{name}_us": timed[name].call_us for name in patches}
    return {**times_us, "converter_us": timed["read"].call_us - timed["untouched"].call_us}


class _Skin:
    """Simulates a patch, advancing its time with each call."""

    def __init__(self, scene: PatchScene) -> None:
        self._patch, self._t_ns = SimulatedPatch(scene), 1_500_000_000
        self._patch.start(0)

    def __call__(self) -> None:
        self._patch.exact_ohm(self._next_ns())

    def read(self) -> None:
        """Simulate the patch and the noise of its converter."""
        self._patch.read(self._next_ns())

    def _next_ns(self) -> int:
        self._t_ns += 1_000_000
        return self._t_ns


def hand_of(patches: int) -> HandConfig:
    """Return a hand of reference patches, :data:`PATCHES_PER_BUS` per bus."""
    return parse_hand(
        {
            "buses": [
                {"name": f"can{i}", "interface": "timed", "channel": f"can{i}"}
                for i in range(-(-patches // PATCHES_PER_BUS))
            ],
            "sync": {"period_ms": PERIOD_MS},
            "patches": [
                {
                    "name": f"patch{i}",
                    "node_id": i % PATCHES_PER_BUS + 1,
                    "bus": f"can{i // PATCHES_PER_BUS}",
                    "tolerances": "exact",
                }
                for i in range(patches)
            ],
        }
    )


def scene_of(touched: int) -> SceneConfig:
    """Return a scene in which a sphere presses with 1 N on each of the first ``touched`` patches."""
    if not touched:  # without a scene, random strokes touch every patch
        return parse_scene({"faults": [{"where": "patch0", "fault": "silent", "from_s": 86_400.0}]})
    sphere = {"shape": "sphere", "radius_m": 0.01}
    touch = {"at_m": [0.016, 0.016], "force_n": 1.0, "from_s": 0.1, "to_s": 3600.0}
    return parse_scene(
        {
            "bodies": [{"name": f"ball{i}", **sphere} for i in range(touched)],
            "touches": [{"body": f"ball{i}", "patch": f"patch{i}", **touch} for i in range(touched)],
        }
    )


def _send_changed_only(hand: HandConfig) -> None:
    """Command all patches to send only changed chunks, and wait until they do so."""
    command = pack_command(send_mode=SendMode.CHANGED)
    for bus in hand.buses:
        with CanPort(bus) as port:
            for patch in hand.patches:
                if patch.bus == bus.name:
                    port.send(od.command_cob_id(patch.node_id), command)
            clock.sleep(2 * PERIOD_MS * 1e-3)


def _solved(host: Host) -> int:
    return sum(patch.solved for patch in host.stats().patches.values())


def _cpu_ns(segments: Sequence[Segment]) -> Counter[str]:
    """Return the CPU time in ns that the nodes, the buses and the host have used so far."""
    by_bus: Counter[str] = Counter()
    for each in segments:
        by_bus.update(each.cpu_ns or {})
    spent: Counter[str] = Counter(bus=by_bus.total())
    for thread in threading.enumerate():
        if thread is threading.main_thread() or thread.ident is None:
            continue
        owner = "nodes" if thread.name.startswith("nodes ") else "host"
        cpu_clock = time.pthread_getcpuclockid(thread.ident)
        spent[owner] += time.clock_gettime_ns(cpu_clock) - by_bus[thread.name]
    return spent
