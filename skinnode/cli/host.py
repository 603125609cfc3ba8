"""``skinnode host hand.toml``: bring a hand up, solve what it feels, say every second how it does."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Protocol

import typer

from skinnode.cli._bus import OtherChannel, OtherInterface
from skinnode.cli._usage import Seconds
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.config import HandConfig
    from skinnode.host import Host, HostStats
    from skinnode.host.health import PatchHealth
    from skinnode.model.frames import FieldFrame

_LONGEST_WAIT_S = 0.1
"""How long Ctrl-C may go unnoticed."""

_OVERRUN_S, _OVERRUN_SYNCS = 1.0, 3
"""Maximum wait at the end for an overrun to clear: seconds, or SYNC periods if that is longer."""

_POLL_S = 0.01

_FIRST_SCANS = 3
"""SYNCs after which a patch must have sent a scan."""


def host(
    hand: Annotated[Path, typer.Argument(help="The hand to run.", metavar="HAND.toml")],
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    seconds: Seconds = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line instead of text.")] = False,
) -> None:
    """Bring a hand's patches up as CANopen manager, solve their scans and report every second.

    With --json each patch has `contacts` (null unless solver.method is "posterior"):
    centroid, area, normal and shear force with standard deviations, in m, m² and N.
    Ctrl-C ends it; the nodes are left pre-operational. Exit status 1 if a patch was not operational at the
    end, a scan was torn or a frame lost (unless its node reported that its computer was too slow), an
    interface failed or reported errors, or a guest heard no SYNC; 2 if the hand could not be run, or if a
    node sent frames whose content does not match their identifier.
    """
    from skinnode.compiled.jit import is_cold
    from skinnode.config import load_hand
    from skinnode.host.patch_stream import check_solvable
    from skinnode.process.signals import stop_on_signal

    plan = load_hand(hand).on(interface, channel)
    report = _JsonReport() if as_json else _TextReport()
    if is_cold():
        report.note("compiling the kernels, once: takes some seconds")
    for patch in plan.patches:  # compiles; nothing is open yet, so Ctrl-C still ends the program by itself
        check_solvable(patch, plan.solver)
    with stop_on_signal() as told:
        status = _run(plan, seconds, report, told)
    if status:
        raise typer.Exit(status)


def _run(plan: HandConfig, seconds: float | None, report: _Report, told: threading.Event) -> int:
    """Run the hand until told to end or time is up; the exit status. Of a frame that was not what its
    identifier promises the host has said so in the log, which Python writes to stderr."""
    from skinnode.host import BringUpCancelled, Host
    from skinnode.process.garbage_collection import short_pauses

    try:
        with short_pauses(), Host.from_config(plan, cancelled=told.is_set) as running:
            where = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in plan.buses)
            report.note(f"{operational(running)} on {where}; Ctrl-C ends")
            _watch(running, told, seconds, report)
            faults, notes = verdict(running)
    except BringUpCancelled:
        return 0
    report.note(left(plan))
    for note in notes:
        report.note(f"note: {note}")
    for fault in faults:
        report.note(f"fault: {fault}")
    if running.stats().malformed:
        return 2
    return 1 if faults else 0


def operational(running: Host) -> str:
    """Who runs by its heartbeat: on the bus of another master, or where one is waited for, not all need."""
    from skinnode.canopen.nmt import NmtState

    patches, name = running.hand.patches, running.hand.name
    healths = [running.health(patch.name) for patch in patches]
    others = [f"{h.patch} {h.condition}" for h in healths if h.nmt_state != NmtState.OPERATIONAL]
    if not others:
        return f"{counted(len(patches), 'patch', 'patches')} of {name!r} operational"
    up = len(patches) - len(others)
    return (
        f"{up} of {counted(len(patches), 'patch', 'patches')} of {name!r} operational ({', '.join(others)})"
    )


def left(plan: HandConfig) -> str:
    """In what state the nodes are left."""
    ends = {"master": "pre-operational", "guest": "left to their master"}
    used = [bus for bus in plan.buses if plan.patches_on(bus.name)]
    if len({bus.role for bus in used}) == 1:
        return f"nodes are {ends[used[0].role]}"
    return "; ".join(f"nodes on {bus.name} are {ends[bus.role]}" for bus in used)


_OF_SLOWNESS: Final = ("scans_torn", "scans_missed", "scans_mixed", "chunks_lost", "summaries_lost")
"""Counters of what is missing or came too late, which a slow computer explains; it does not explain frames
that were wrong."""


def verdict(running: Host) -> tuple[list[str], list[str]]:
    """Return the faults, and the notes that are not faults, one line each.

    A node that skips scans because its own computer is too slow sends EMCY 0x8110. What is missing of it, or
    came too late, is then a note, and so is that emergency at the end. Frames that were wrong stay a fault.
    """
    from skinnode.canopen.emergency import EmcyCode
    from skinnode.host.accounting import losses_of_bus, losses_of_stream

    _let_overruns_end(running)
    stats, notes = running.stats(), list[str]()
    found = [
        f"{name}: {text}" for name, counts in stats.buses.items() for text in losses_of_bus(counts).values()
    ]
    for name in stats.buses:
        bus = running.bus_health(name)
        if bus.no_sync:
            found.append(f"{name}: no SYNC of its master is heard")
        if bus.controller in ("error warning", "error passive", "bus-off"):
            found.append(f"{name}: its controller is {bus.controller} at the end")
    for name, stream in stats.patches.items():
        health = running.health(name)
        condition = health.condition
        due = stats.sync.sent + stats.sync.received > _FIRST_SCANS
        overrun = health.last_emergency == EmcyCode.CAN_OVERRUN and health.defect is None
        slow_still = condition == "faulty" and overrun and health.slow_overruns > 0
        if slow_still:
            notes.append(f"{name}: {condition} at the end{reason(health, ': ')}")
        elif condition != "operational" and (due or stream.offered > 0):
            found.append(f"{name}: {condition} at the end{reason(health, ': ')}")
        elif due and not stream.solved:
            found.append(f"{name}: no scan was solved")
        losses = losses_of_stream(stream)
        slow = slow_still or (condition == "operational" and health.slow_overruns > 0)
        explained = [losses.pop(counter) for counter in _OF_SLOWNESS if slow and counter in losses]
        if explained:
            notes.append(
                f"{name}: {', '.join(explained)}, while the computer that runs the node was too slow "
                f"(EMCY 0x8110{'' if slow_still else ', since cleared'})"
            )
        found += [f"{name}: {text}" for text in losses.values()]
    for name, defects in stats.defects.items():
        if defects.count:
            found.append(f"{name}: {counted(defects.count, 'defect')} of the host, last {defects.newest}")
    return found, notes


def faults_of(running: Host) -> list[str]:
    """Return the faults, one line each."""
    return verdict(running)[0]


def reason(health: PatchHealth, before: str = "") -> str:
    """Return why a patch is faulty or refused, prefixed with ``before``; empty for other conditions."""
    if health.condition == "refused" and health.refusal:
        return f"{before}{health.refusal}"
    if health.condition == "faulty" and health.defect is not None:
        return f"{before}{health.defect}"
    if health.condition == "faulty":
        from skinnode.canopen.emergency import register_text

        if health.last_emergency is None:  # the fault is older than the host
            text = register_text(health.error_register)
            return f"{before}error register 0x{health.error_register:02X} ({text})"
        return f"{before}EMCY 0x{health.last_emergency:04X} {health.emergency_text}"
    return ""


def _let_overruns_end(running: Host) -> None:
    """Wait briefly for nodes on slow computers to clear the emergency, which lasts one scan."""
    end_s = time.monotonic() + max(_OVERRUN_S, _OVERRUN_SYNCS * running.hand.sync.period_s)
    while time.monotonic() < end_s:
        healths = [running.health(patch.name) for patch in running.hand.patches]
        if not any(h.condition in ("faulty", "stale") and h.slow_overruns for h in healths):
            return
        time.sleep(_POLL_S)


def _watch(running: Host, told: threading.Event, seconds: float | None, report: _Report) -> None:
    """Follow the fields, a report a second, until told to end or time is up."""
    start_s = time.monotonic()
    end_s = float("inf") if seconds is None else start_s + seconds
    latencies_s: list[float] = []
    with running.fields() as fields:
        before, due_s = running.stats(), start_s + 1.0
        while not told.is_set():
            now_s = time.monotonic()
            if now_s >= min(due_s, end_s):
                now = running.stats()
                report.second(_Second(running, now_s - start_s, before, now, latencies_s, fields.dropped))
                before, latencies_s, due_s = now, [], due_s + 1.0
                if now_s >= end_s:
                    return
            field = fields.get(max(0.0, min(due_s, end_s, now_s + _LONGEST_WAIT_S) - now_s))
            if field is not None and field.stamp is not None:
                latencies_s.append((field.stamp.t_solved_ns - field.stamp.t_receive_ns) * 1e-9)


class _Second:
    """What happened in a second, as data."""

    def __init__(
        self,
        running: Host,
        elapsed_s: float,
        before: HostStats,
        now: HostStats,
        latencies_s: Sequence[float],
        dropped: int,
    ) -> None:
        ordered = sorted(latencies_s)
        self.elapsed_s = elapsed_s
        self.latency_p50_ms = _percentile(ordered, 0.50)
        self.latency_p99_ms = _percentile(ordered, 0.99)
        self.fields_dropped = dropped
        self.patches = {
            name: _patch(running, name, before, now)
            for name in (patch.name for patch in running.hand.patches)
        }
        self.buses = {
            name: {
                "frames": new.received - before.buses[name].received,
                "dropped": new.dropped,
                "malformed": new.malformed,
                "foreign": new.foreign,
                "load": new.load,
            }
            for name, new in now.buses.items()
        }


def _patch(running: Host, name: str, before: HostStats, now: HostStats) -> dict[str, object]:
    from skinnode.cli._contacts import contact_tables

    new, old, field = now.patches[name], before.patches[name], running.latest(name)
    health = running.health(name)
    return {
        "condition": str(health.condition),
        "reason": reason(health) or health.reason or None,
        "solved": new.solved - old.solved,
        "skipped": new.skipped,
        "torn": new.assembler.scans_torn,
        "corrupt": new.assembler.scans_corrupt,
        "missed": new.assembler.scans_missed,
        "chunks_lost": new.assembler.chunks_lost,
        "trusted": field.trusted if field is not None else None,
        "scan": field.stamp.scan if field is not None and field.stamp is not None else None,
        **_deepest(field),
        "contacts": contact_tables(field),
    }


def _deepest(field: FieldFrame | None) -> dict[str, float | None]:
    """Depth of the deepest electrode and its deviation; a press moves electrodes to −z."""
    if field is None:
        return {"deepest_m": None, "deepest_std_m": None}
    z = field.displacement_m[..., 2]
    figures = {"deepest_m": -z.min(), "deepest_std_m": field.displacement_std_m[..., 2].flat[z.argmin()]}
    return {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}


def _percentile(ordered: Sequence[float], share: float) -> float | None:
    """In milliseconds; None of nothing."""
    return round(ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1e3, 3) if ordered else None


class _Report(Protocol):
    """How a person or a program is told."""

    def note(self, text: str) -> None: ...

    def second(self, second: _Second) -> None: ...


class _TextReport:
    """A line for the bus and one a patch, every second."""

    def note(self, text: str) -> None:
        print(text, flush=True)

    def second(self, second: _Second) -> None:
        buses = "  ".join(
            f"{name} {facts['frames']} frames, load {facts['load']:.0%}, {facts['dropped']} dropped"
            for name, facts in second.buses.items()
        )
        latency = ""
        if second.latency_p50_ms is not None:
            latency = f"  latency {second.latency_p50_ms:.1f}, p99 {second.latency_p99_ms:.1f} ms"
        lines = [f"{second.elapsed_s:6.1f} s  {buses}{latency}"]
        lines += [f"          {_patch_text(name, facts)}" for name, facts in second.patches.items()]
        print("\n".join(lines), flush=True)


def _patch_text(name: str, facts: Mapping[str, object]) -> str:
    deepest_m, std_m = facts["deepest_m"], facts["deepest_std_m"]
    deepest = ""
    if facts["solved"] and isinstance(deepest_m, float):
        std = f" ± {std_m * 1e6:.1f}" if isinstance(std_m, float) else ""
        deepest = f"  deepest {deepest_m * 1e6:.1f}{std} µm"
    worst = "".join(f"  {facts[key]} {key}" for key in ("torn", "corrupt", "missed", "skipped") if facts[key])
    doubt = "  untrusted" if facts["trusted"] is False else ""
    why = f" ({facts['reason']})" if facts["reason"] else ""
    return (
        f"{name} {facts['condition']}{why}  {facts['solved']} fields{deepest}{doubt}"
        f"{worst and '  in all' + worst}"
    )


class _JsonReport:
    """An object a line: {"note": …} or the figures of a second."""

    def note(self, text: str) -> None:
        print(json.dumps({"note": text}), flush=True)

    def second(self, second: _Second) -> None:
        print(json.dumps(vars(second)), flush=True)
