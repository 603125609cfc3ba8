"""Prints the ``skinnode host`` reports: text or a JSON object every second, and faults at the end."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, Protocol

from skinnode.process import clock
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.config import HandConfig
    from skinnode.host import Host, HostStats
    from skinnode.host.health import PatchHealth
    from skinnode.host.patch_stream import StreamStats
    from skinnode.model.frames import FieldFrame

_OVERRUN_S, _OVERRUN_SYNCS = 1.0, 3
"""Maximum time to wait at the end of a run for nodes to clear overrun emergencies: 1 s or three SYNC periods,
whichever is longer."""

_POLL_S = 0.01

_FIRST_SCANS = 3
"""Number of SYNCs after which a patch without a solved scan is reported as faulty."""

_EXPLAINED_BY_SLOWNESS: Final = (
    "scans_torn",
    "scans_missed",
    "scans_mixed",
    "chunks_lost",
    "summaries_lost",
)
"""Counters of missing and late frames, which a slow computer can cause. Invalid frames are always faults."""


def operational_text(running: Host) -> str:
    """Describe how many patches are operational, and the condition of every other patch."""
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


def final_state_text(plan: HandConfig) -> str:
    """Describe the NMT state of the nodes on each bus after the host has stopped."""
    ends = {"master": "pre-operational", "guest": "left to their master"}
    used = [bus for bus in plan.buses if plan.patches_on(bus.name)]
    if len({bus.role for bus in used}) == 1:
        return f"nodes are {ends[used[0].role]}"
    return "; ".join(f"nodes on {bus.name} are {ends[bus.role]}" for bus in used)


def exit_status(running: Host, faults: Sequence[str]) -> int:
    """Return the exit status of a run.

    Args:
        running: The host, after it has stopped.
        faults: Faults of the run.

    Returns:
        2 if a node sent frames whose content does not match their identifier, 1 for other faults, 0 for none.
    """
    if running.stats().malformed:
        return 2
    return 1 if faults else 0


def faults_and_notes(running: Host) -> tuple[list[str], list[str]]:
    """Return the run's faults and notes, one line each.

    A node whose computer is too slow skips scans and sends EMCY 0x8110. The node's missing and late frames
    are then reported as notes, not as faults, as is an EMCY 0x8110 that is still active at the end. Invalid
    frames remain faults.
    """
    _let_overruns_end(running)
    stats = running.stats()
    faults, notes = _bus_faults(running, stats), list[str]()
    first_scans_due = stats.sync.sent + stats.sync.received > _FIRST_SCANS
    for name, stream in stats.patches.items():
        patch_faults, patch_notes = _patch_faults_and_notes(running.health(name), stream, first_scans_due)
        faults += [f"{name}: {text}" for text in patch_faults]
        notes += [f"{name}: {text}" for text in patch_notes]
        noise = _noise(running, name)
        if noise:
            notes.append(f"{name}: {noise}")
    for name, defects in stats.defects.items():
        if defects.count:
            defect = f"{counted(defects.count, 'defect')} in the host, most recent: {defects.newest}"
            faults.append(f"{name}: {defect}")
    return faults, notes


def _bus_faults(running: Host, stats: HostStats) -> list[str]:
    from skinnode.host.accounting import losses_of_bus

    faults = [
        f"{name}: {text}" for name, counts in stats.buses.items() for text in losses_of_bus(counts).values()
    ]
    for name in stats.buses:
        bus = running.bus_health(name)
        if bus.no_sync:
            faults.append(f"{name}: no SYNC received from its master")
        if bus.controller in ("error warning", "error passive", "bus-off"):
            faults.append(f"{name}: CAN controller {bus.controller} at the end")
    return faults


def _patch_faults_and_notes(
    health: PatchHealth, stream: StreamStats, first_scans_due: bool
) -> tuple[list[str], list[str]]:
    from skinnode.canopen.emergency import EmcyCode
    from skinnode.host.accounting import losses_of_stream

    faults, notes = list[str](), list[str]()
    condition = health.condition
    overrun = health.last_emergency == EmcyCode.CAN_OVERRUN and health.defect is None
    slow_still = condition == "faulty" and overrun and health.slow_overruns > 0
    if slow_still:
        notes.append(f"{condition} at the end{reason(health, ': ')}")
    elif condition != "operational" and (first_scans_due or stream.offered > 0):
        faults.append(f"{condition} at the end{reason(health, ': ')}")
    elif first_scans_due and not stream.solved:
        faults.append("no scan was solved")
    losses = losses_of_stream(stream)
    slow = slow_still or (condition == "operational" and health.slow_overruns > 0)
    explained = [losses.pop(counter) for counter in _EXPLAINED_BY_SLOWNESS if slow and counter in losses]
    if explained:
        notes.append(
            f"{', '.join(explained)}, because the computer running the node could not keep up "
            f"(EMCY 0x8110{'' if slow_still else ', since cleared'})"
        )
    return [*faults, *losses.values()], notes


def _noise(running: Host, name: str) -> str:
    """Describe the measured noise and the noise stated in the hand file; "" if they agree."""
    field = running.latest(name)
    if field is None or field.noise_factor == 1.0:
        return ""
    stated = next(patch.relative_noise for patch in running.hand.patches if patch.name == name)
    return f"noise is {field.noise_factor * stated:.1e}, relative_noise in the hand file is {stated:.1e}"


def reason(health: PatchHealth, before: str = "") -> str:
    """Return ``before`` and then the reason why the patch is faulty or refused; "" in other conditions."""
    if health.condition == "refused" and health.refusal:
        return f"{before}{health.refusal}"
    if health.condition == "faulty" and health.defect is not None:
        return f"{before}{health.defect}"
    if health.condition == "faulty":
        from skinnode.canopen.emergency import register_text

        if health.last_emergency is None:  # the fault occurred before the host started
            text = register_text(health.error_register)
            return f"{before}error register 0x{health.error_register:02X} ({text})"
        return f"{before}EMCY 0x{health.last_emergency:04X} {health.emergency_text}"
    return ""


def _let_overruns_end(running: Host) -> None:
    """Give nodes on slow computers time to clear their overrun emergencies."""
    end_s = clock.monotonic() + max(_OVERRUN_S, _OVERRUN_SYNCS * running.hand.sync.period_s)
    while clock.monotonic() < end_s:
        healths = [running.health(patch.name) for patch in running.hand.patches]
        if not any(h.condition in ("faulty", "stale") and h.slow_overruns for h in healths):
            return
        clock.sleep(_POLL_S)


class Second:
    """Values reported for one second of a run. The attribute names are the keys of the JSON object."""

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
    from skinnode.host.trust_report import trust_table

    new, old, field = now.patches[name], before.patches[name], running.latest(name)
    health = running.health(name)
    return {
        "condition": str(health.condition),
        "reason": reason(health) or health.reason or None,
        "alive": str(health.alive),
        "solved": new.solved - old.solved,
        "skipped": new.skipped,
        "torn": new.assembler.scans_torn,
        "corrupt": new.assembler.scans_corrupt,
        "missed": new.assembler.scans_missed,
        "chunks_lost": new.assembler.chunks_lost,
        **trust_table(field),
        "noise_factor": field.noise_factor if field is not None else None,
        "scan": field.stamp.scan if field is not None and field.stamp is not None else None,
        "touched": field.touched if field is not None else None,
        "touch_odds": _finite(field.touch_odds) if field is not None else None,
        **_deepest(field),
        "contacts": contact_tables(field),
    }


def _deepest(field: FieldFrame | None) -> dict[str, float | None]:
    """Return the deepest electrode's depth (positive towards −z) and its standard deviation, in metres."""
    if field is None:
        return {"deepest_m": None, "deepest_std_m": None}
    z = field.displacement_m[..., 2]
    figures = {"deepest_m": -z.min(), "deepest_std_m": field.displacement_std_m[..., 2].flat[z.argmin()]}
    return {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}


def _finite(value: float | None) -> float | None:
    """Replace a non-finite value with the largest float, because JSON cannot represent infinity."""
    return value if value is None or math.isfinite(value) else sys.float_info.max


def _percentile(ordered: Sequence[float], share: float) -> float | None:
    """Return a percentile (ms) of the sorted times (s); None if there are no times."""
    return round(ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1e3, 3) if ordered else None


class Report(Protocol):
    """Interface of the host's text and JSON reports."""

    def note(self, text: str) -> None:
        """Report an event or a fault."""

    def second(self, second: Second) -> None:
        """Report the values of the past second."""


class TextReport:
    """Prints one line for all buses and one line per patch, every second."""

    def note(self, text: str) -> None:
        """Print ``text``."""
        print(text, flush=True)

    def second(self, second: Second) -> None:
        """Print the values of the past second."""
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
        deepest = f"  touched{deepest}" if facts.get("touched") else deepest
    worst = "".join(f"  {facts[key]} {key}" for key in ("torn", "corrupt", "missed", "skipped") if facts[key])
    trust = f"  untrusted: {facts['distrust']}" if facts["trusted"] is False else _doubts(facts)
    if facts["noise_factor"] not in (None, 1.0):
        trust += f"  noise {facts['noise_factor']:.2g} times the stated value"
    why = f" ({facts['reason']})" if facts["reason"] else ""
    return (
        f"{name} {facts['condition']}{why}  {facts['solved']} fields{deepest}{trust}"
        f"{worst and '  in all' + worst}"
    )


def _doubts(facts: Mapping[str, object]) -> str:
    """Describe a field's imprecision and the number of faults in its readings; "" if it has neither."""
    doubts, faults = "  imprecise" if facts["precise"] is False else "", facts["data_faults"]
    if isinstance(faults, list) and faults:
        doubts += f"  {counted(len(faults), 'fault')} in the readings; the affected readings are excluded"
    return doubts


class JsonReport:
    """Prints one JSON object per line: {"note": …} or the values of the past second."""

    def note(self, text: str) -> None:
        """Print ``text`` as a note."""
        print(json.dumps({"note": text}), flush=True)

    def second(self, second: Second) -> None:
        """Print the values of the past second."""
        print(json.dumps(vars(second)), flush=True)
