"""Soak test: after random faults, the host and patches must recover, and all frame counts must agree.

The host and the simulated nodes run in one process and communicate over two virtual buses. Each round injects
one to three kinds of fault, such as dropped frames, into one or all patches, while subscribers join and
leave. In some rounds, child processes also keep all processors busy. At the end of a round, the faults are
removed. The next round starts when every patch is operational and publishing fields again. The resident
memory and the number of blocks allocated by Python (:func:`sys.getallocatedblocks`) are each measured twice
without injected faults: after a warm-up and at the end. The number of blocks reveals even a leak of one
object per scan. This module imports the simulator to inject the faults.
"""

from __future__ import annotations

import logging
import os
import random
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from sys import getallocatedblocks
from typing import Any, Final

from skinnode.bench import soak_sums as sums
from skinnode.bench.memory import resident_mb
from skinnode.bench.soak_starvation import starved_processor
from skinnode.bus_load.stuffing import load_kernels
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import BusError
from skinnode.host import Condition, Host, HostStats
from skinnode.host.accounting import discrepancies
from skinnode.host.scan_solver import check_solvable
from skinnode.model.frames import FieldFrame
from skinnode.protocol.device_time import TIME_STEP_US
from skinnode.text.words import counted
from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.fleet import Fleet
from vcan_sim.sensor import REMEMBERED_READINGS

WARM_UP: Final = 0.25
"""Warm-up time before the first memory measurement, as a fraction of the test duration."""
BLOCKS: Final = 2000
"""Maximum increase in the number of memory blocks. The number normally varies by a few hundred; a leak of one
block per scan adds 10,000 in three minutes."""
RESIDENT_MB: Final = 8.0
"""Maximum increase in resident memory, in MB. The C allocator does not return all freed memory at once, so
small increases are normal."""
BACK_S: Final = 15.0
"""Time limit for the recovery of all patches after a round, in s. Recovery normally takes less than a second,
but can take longer on a loaded machine."""
SLOW_S: Final = 1.0
"""Recovery time above which a round is reported as slow, in s."""
STARVED: Final = 0.1
"""Fraction of the rounds in which child processes keep all processors busy."""
STARVED_S: Final = 3.0
TARED: Final = 0.2
"""Fraction of the rounds in which a patch is tared."""
CALM_S: Final = 1.5
_PATCHES: Final = 4
_MANY: Final = 8
"""Minimum number of faults in a round at which the report shows their count instead of their names."""

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
    {"corrupted": 0.02},
    {"displaced": 0.1},
    {"understated": 0.1},
    {"unchecked": 0.1},
    {"reset": 0.05},
    {"sync_lost": 0.1},
    {"long": 0.5},
    {"silent": True},
    {"deaf": True},
    {"frozen": True},
    {"frozen": True, "uncounted": True},
    {"frozen_upper": 1},
    {"frozen_lower": 2},
    {"stuck_upper": 1, "stuck_lower": 3},
    {"crossed_upper": 0},
    {"crossed_lower": 1},
    {"flipped": 0.1},
    {"drift_per_s": 0.01},
    {"warmer_k": 5.0},
    {"error_passive": True},
    {"duplicate_node_id": True},
    {"unplugged": True},
    {"restart_every_s": 0.7},
    {"emcy_per_s": 200.0},
    {"babble_per_s": 500.0},
    {"unplugged": True, "wrong_identity": True},
    {"unplugged": True, "wrong_layout": True},
    {"sdo_request_lost": 0.2},
    {"sdo_response_lost": 0.2},
    {"sdo_request_lost": 0.05, "sdo_response_lost": 0.05, "restart_every_s": 0.7},
    {"sdo_response_lost": 1.0, "restart_every_s": 1.5},
    {"lss_request_lost": 0.3, "lss_response_lost": 0.3, "sdo_response_lost": 1.0, "heartbeat_lost": 1.0},
    {"lss_request_lost": 0.3, "sdo_request_lost": 1.0, "heartbeat_lost": 1.0},
    {"nmt_lost": 0.5, "restart_every_s": 0.7},
    {"heartbeat_lost": 0.3},
    {"heartbeat_lost": 1.0},
    {"boot_up_lost": 1.0, "restart_every_s": 0.7},
    {"emcy_lost": 0.5, "emcy_per_s": 20.0},
    {"command_lost": 0.5},
    dict.fromkeys(
        (
            "lost",
            "summary_lost",
            "sync_lost",
            "nmt_lost",
            "sdo_request_lost",
            "sdo_response_lost",
            "lss_request_lost",
            "lss_response_lost",
            "heartbeat_lost",
            "boot_up_lost",
            "emcy_lost",
            "command_lost",
        ),
        0.05,
    ),
)


@dataclass(frozen=True, slots=True)
class _Size:
    """Resource usage of the test process, which must not increase during the test."""

    blocks: int
    resident_mb: float
    threads: int
    descriptors: int


def warm_up() -> None:
    """Compile all kernels used by a soak test."""
    hand = _hand()
    load_kernels()
    for patch in hand.patches:
        check_solvable(patch, hand.solver, hand.sync.period_s)


def run(minutes: float, seed: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Run a soak test and return its results. Raises the same errors as :meth:`Host.from_config`.

    Args:
        minutes: Duration of the test.
        seed: Seed for the random faults.
        report: Function that receives the progress messages.
    """
    chance = random.Random(seed)
    hand = _hand()
    counter = sums.FrameCounter([bus.name for bus in hand.buses])
    kept = logging.getLogger("skinnode")
    level = kept.level
    kept.setLevel(logging.CRITICAL)  # hide the thousands of warnings caused by injected faults
    try:
        fleet = Fleet(hand, faults=Faults(seed=seed))
        for source in fleet.patches.values():
            for k in range(
                REMEMBERED_READINGS
            ):  # fill the history of readings now, so that it does not grow later
                source.read(-1000 * TIME_STEP_US * (k + 1))
        with fleet:
            before = {bus.name: Counter(fleet.passed(bus.name).sent) for bus in hand.buses}
            with Host.from_config(hand, tap=counter) as host:
                figures = _soak(host, fleet, chance, minutes * 60.0, report)
                names = [patch.name for patch in hand.patches]
                back_s, _ = _wait_for_patches(host, names)
                figures["not_operational"] = _not_operational(host) if back_s >= BACK_S else []
                fleet.inject(Faults(silent=True))
                stats = _standing_still(host)
                injected = {patch.name: fleet.injected(patch.name) for patch in hand.patches}
                wrong = [
                    *discrepancies(stats),
                    *sums.injected_otherwise(stats, injected),
                    *sums.received_otherwise(fleet, counter, before),
                ]
            time.sleep(CALM_S)  # wait until the host's last frames have reached the nodes
        wrong += sums.sent_otherwise(fleet, counter)
    finally:
        kept.setLevel(level)
    streams = stats.patches.values()
    figures["frames"] = sum(bus.received for bus in stats.buses.values())
    figures["scans"] = sum(stream.offered + stream.withheld + stream.partial for stream in streams)
    figures["fields"] = sum(stream.solved for stream in streams)
    figures["rejoins"] = sum(node.rejoins for node in stats.nodes.values())
    figures["defects"] = [
        f"{name}: {each.newest}" for name, each in stats.defects.items() if each.newest is not None
    ]
    figures["discrepancies"] = wrong
    figures["from_nodes"] = [asdict(each) for each in sums.of_nodes(fleet)]
    figures["from_host"] = [asdict(each) for each in sums.of_host(fleet)]
    figures["injected"] = {
        name: sum(getattr(each, name) for each in injected.values()) for name in Injected.__dataclass_fields__
    }
    figures["must"] = _must(figures)
    return figures


def summary_lines(figures: dict[str, Any]) -> list[str]:
    """Format the results as lines of text."""
    lines = [
        f"{figures['rounds']} rounds, {figures['starved_rounds']} of which were starved of CPU time; "
        f"{figures['frames']} frames received, {figures['scans']} scans, {figures['fields']} fields, "
        f"{figures['rejoins']} bring-ups",
        f"all patches back within {figures['slowest_back_s']:.2f} s; "
        f"{counted(figures['slow_rounds'], 'round')} took more than {SLOW_S:g} s",
    ]
    columns = f"{'sent':>9} {'dropped':>9} {'held back':>9} {'arrived':>9}"
    for key, direction in (("from_nodes", "nodes to the host"), ("from_host", "host to the nodes")):
        lines.append(f"frames from the {direction:<17}{columns}")
        for row in figures[key]:
            numbers = (row["wanted"], row["dropped"], row["held_back"], row["arrived"])
            lines.append(f"  {row['kind']:<30} " + " ".join(f"{number:>9}" for number in numbers))
    lines.append("dropped: frames lost in transit because of an injected fault")
    lines.append("held back: frames of a silent, unplugged, deaf or bus-off node, and late chunks")
    for key in ("not_back", "not_operational", "defects", "discrepancies"):
        lines += [f"  {line}" for line in figures[key]]
    return lines


def _hand() -> HandConfig:
    small = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
    buses = [
        {"name": f"can{i}", "channel": f"soak-{uuid.uuid4().hex}", "heartbeat_node_id": 1} for i in range(2)
    ]
    made: dict[str, Any] = {"layout": small, "tolerances": "exact"}
    patches = [
        {"name": f"p{i}", "node_id": 5 + i, "serial": 1 + i, "bus": f"can{i % 2}", **made}
        for i in range(_PATCHES)
    ]
    beat = {"heartbeat_ms": 100}
    return parse_hand({"buses": buses, "patches": patches, "sync": {"period_ms": 40}, "bring_up": beat})


def _soak(
    host: Host, fleet: Fleet, chance: random.Random, seconds: float, report: Callable[[str], None]
) -> dict[str, Any]:
    names = [patch.name for patch in host.hand.patches]
    begin_s, rounds, starved, slow, slowest_s = time.monotonic(), 0, 0, 0, 0.0
    lost: list[str] = []
    first: _Size | None = None

    def say(text: str) -> None:
        report(f"{time.monotonic() - begin_s:6.0f} s: {text}")

    while (passed_s := time.monotonic() - begin_s) < seconds:
        if first is None and passed_s > WARM_UP * seconds:
            _all_at_once(host, fleet, names)
            first = _size()
            say(_size_text(first))
        hungry = chance.random() < STARVED
        with ExitStack() as round_:
            what = _inject(fleet, chance, names)
            if chance.random() < TARED:
                what += f"; {_tare(host, chance.choice(names))}"
            if hungry:
                what += f" with {round_.enter_context(starved_processor())} busy child processes"
            with host.fields(capacity=2) as abandoned:
                callback = host.on_field(_broken if rounds % 2 else _patient, capacity=4)
                abandoned.get(0.1)
                time.sleep(STARVED_S if hungry else chance.uniform(0.3, 2.0))
                callback.close()
            _calm(fleet)
        back_s, waited_for = _wait_for_patches(host, names)
        rounds += 1
        starved += hungry
        slow += back_s >= SLOW_S
        slowest_s = max(slowest_s, back_s)
        if back_s >= BACK_S:
            lost.append(f"round {rounds} ({what}): {waited_for}")
        if rounds % 20 == 0 or back_s >= SLOW_S:
            late = f"; the last patch was {waited_for}" if back_s >= SLOW_S else ""
            say(f"round {rounds}, {what}: all patches back after {back_s:.2f} s{late}")
    time.sleep(CALM_S)
    last = _size()
    say(_size_text(last))
    first = first or last
    return {
        "seconds": time.monotonic() - begin_s,
        "rounds": rounds,
        "starved_rounds": starved,
        "slow_rounds": slow,
        "slowest_back_s": slowest_s,
        "not_back": lost,
        "grown_blocks": last.blocks - first.blocks,
        "grown_mb": last.resident_mb - first.resident_mb,
        "grown_threads": last.threads - first.threads,
        "grown_descriptors": last.descriptors - first.descriptors,
    }


def _all_at_once(host: Host, fleet: Fleet, names: list[str]) -> None:
    """Restart all patches at once, so that the number of threads reaches its maximum."""
    fleet.inject(Faults(unplugged=True))
    time.sleep(CALM_S)
    _calm(fleet)
    _wait_for_patches(host, names)
    time.sleep(CALM_S)


def _inject(fleet: Fleet, chance: random.Random, names: list[str]) -> str:
    """Inject random faults and return a description of them."""
    if chance.random() < 0.05:
        bus = chance.choice(fleet.hand.buses).name
        fleet.bus_off(bus, off=True)
        return f"nodes of {bus} bus-off"
    kinds: dict[str, Any] = {}
    for kind in chance.sample(_KINDS, chance.choice((1, 2, 3))):
        kinds |= kind
    patch = None if chance.random() < 0.2 else chance.choice(names)
    fleet.inject(Faults(**kinds), patch)
    what = ", ".join(kinds) if len(kinds) < _MANY else f"{len(kinds)} kinds of fault"
    return f"{what} of {patch or 'all patches'}"


def _tare(host: Host, name: str) -> str:
    """Try to tare a patch, and return a description of the result."""
    try:
        host.tare(name)
    except BusError:  # also catches NodeError, which is raised if the patch is not operational
        return f"{name} could not be tared"
    return f"{name} tared"


def _calm(fleet: Fleet) -> None:
    for bus in fleet.hand.buses:
        fleet.bus_off(bus.name, off=False)
    fleet.inject(NO_FAULTS)
    fleet.faults.forget_log()  # a growing log would look like a memory leak


def _wait_for_patches(host: Host, names: list[str]) -> tuple[float, str]:
    """Wait until every patch is operational and has published a field from a SYNC sent after the call.

    Returns:
        The waiting time in seconds, and a text that names the last patch to recover and the reason for its
        delay.
    """
    begin_ns, waited_for = time.monotonic_ns(), ""

    def waits_for(name: str) -> str:
        health, field = host.health(name), host.latest(name)
        if health.condition is not Condition.OPERATIONAL:
            return f"{name}, {health.condition}: {health.reason}"
        streams = field is not None and field.stamp is not None and field.stamp.t_sync_ns > begin_ns
        return "" if streams else f"{name}, operational, no field yet"

    while reasons := [reason for name in names if (reason := waits_for(name))]:
        waited_for = reasons[0]
        if time.monotonic_ns() > begin_ns + BACK_S * 1e9:
            return BACK_S, waited_for
        time.sleep(0.01)
    return (time.monotonic_ns() - begin_ns) * 1e-9, waited_for


def _not_operational(host: Host) -> list[str]:
    """Return one line for each patch that is not operational, with the reason."""
    healths = (host.health(patch.name) for patch in host.hand.patches)
    return [f"{health.patch}, {health.condition}: {health.reason}" for health in healths if health.reason]


def _broken(field: FieldFrame) -> None:
    raise RuntimeError("deliberate failure of a subscriber")


def _patient(field: FieldFrame) -> None:
    time.sleep(0.2)


def _standing_still(host: Host) -> HostStats:
    """Wait until the host's counters stop changing, and return them."""
    last, stats = None, host.stats()
    for _ in range(100):
        now = (
            [stats.buses[name].read for name in stats.buses],
            [stream.solved for stream in stats.patches.values()],
        )
        if now == last:
            break
        last = now
        time.sleep(0.3)
        stats = host.stats()
    return stats


def _size() -> _Size:
    for _ in range(3):
        resident = resident_mb()
    return _Size(
        getallocatedblocks(),
        resident,
        threading.active_count(),
        len(os.listdir("/proc/self/fd")),
    )


def _size_text(size: _Size) -> str:
    return (
        f"{size.blocks} blocks, {size.resident_mb:.1f} MB resident, {size.threads} threads, "
        f"{size.descriptors} file descriptors"
    )


def _must(figures: dict[str, Any]) -> list[dict[str, Any]]:
    asked = (
        ("growth: blocks of Python", figures["grown_blocks"], BLOCKS),
        ("growth: resident memory, MB", figures["grown_mb"], RESIDENT_MB),
        ("growth: threads", figures["grown_threads"], 0),
        ("growth: file descriptors", figures["grown_descriptors"], 0),
        (f"rounds after which a patch did not recover within {BACK_S:g} s", len(figures["not_back"]), 0),
        ("patches not operational at the end", len(figures["not_operational"]), 0),
        ("defects of the host", len(figures["defects"]), 0),
        ("frame counts that do not agree", len(figures["discrepancies"]), 0),
    )
    return [{"what": what, "got": got, "asked": most, "reached": got <= most} for what, got, most in asked]
