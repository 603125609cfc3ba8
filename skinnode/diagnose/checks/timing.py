"""Doctor checks for SYNC, scan durations and lost frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from skinnode.diagnose.facts import BusFacts, Finding, Sure
from skinnode.text.words import counted

_JITTER: Final = 0.1
"""SYNC jitter, as a fraction of the period, above which SYNC is reported as irregular."""

_PERIOD_ERROR: Final = 0.02
_LATE: Final = 0.95
"""Time from SYNC to the end of a scan, as a fraction of the period, above which scans are reported as
late."""


def check_timing(bus: BusFacts) -> Iterator[Finding]:
    """Check SYNC, and check that scans end before the next SYNC."""

    def found(where: str, what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("timing", where, what, sure, evidence, advice)

    awaited = (bus.running and not bus.sync_ours) or bus.role == "guest"  # another master must send SYNC
    if awaited and len(bus.sync_s) == 0 and bus.seconds > 0 and not bus.failure:
        timers = any(p.info and p.info.patch and p.info.patch.period_ms for p in bus.patches)
        if not timers:
            yield found(
                bus.name,
                "no node sends SYNC",
                Sure.CERTAIN,
                f"no SYNC in {bus.seconds:.1f} s, and "
                + ("nodes are operational" if bus.running else "the host is a guest on this bus"),
                "start the host or the robot's master, because patches scan only at SYNC",
            )
    yield from _check_sync(bus)
    for patch in bus.patches:
        if patch.scans is None or bus.period_s is None:
            continue
        latency_s = patch.scans.latency_s[np.isfinite(patch.scans.latency_s)]
        period_s = max(bus.period_s, bus.own_period_s)
        if len(latency_s) and float(np.median(latency_s)) > _LATE * period_s:
            yield found(
                patch.name,
                "scans end after the next scan has begun",
                Sure.CERTAIN,
                f"median {np.median(latency_s) * 1e3:.1f} ms after SYNC; the period is {period_s * 1e3:g} ms",
                "set a shorter inhibit time or a longer SYNC period, or reduce the bus load",
            )


def _check_sync(bus: BusFacts) -> Iterator[Finding]:
    """Check SYNC for a wrong period, missing frames and jitter."""

    def found(where: str, what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("timing", where, what, sure, evidence, advice)

    intervals = np.diff(bus.sync_s)
    if len(intervals) >= 5:
        period_s = float(np.median(intervals))
        if bus.period_s is not None and abs(period_s / bus.period_s - 1) > _PERIOD_ERROR:
            yield found(
                bus.name,
                "the SYNC period differs from the hand file",
                Sure.CERTAIN,
                f"{period_s * 1e3:.2f} ms; the hand file specifies {bus.period_s * 1e3:g} ms",
                "look for a second master, or for a host that uses another hand file",
            )
        missing = int(np.sum(np.rint(intervals / period_s) - 1))
        if missing > 0:
            yield found(
                bus.name,
                "SYNCs are missing",
                Sure.CERTAIN,
                f"{missing} of {len(intervals) + missing}",
                "check the bus, and the load on the machine that sends SYNC",
            )
        regular = intervals[intervals < 1.5 * period_s]
        jitter_s = float(np.percentile(np.abs(regular - period_s), 99)) if len(regular) else 0.0
        if jitter_s > _JITTER * period_s:
            yield found(
                bus.name,
                "SYNC is irregular",
                Sure.LIKELY,
                f"99 % of the intervals are within {jitter_s * 1e3:.1f} ms of the "
                f"{period_s * 1e3:.1f} ms period",
                "reduce the load on the machine that sends SYNC; give the host real-time priority",
            )


def check_losses(bus: BusFacts) -> Iterator[Finding]:
    """Check for frames lost by this machine, on the bus or by a node, and for unexpected scan frames."""

    def found(where: str, what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("losses", where, what, sure, evidence, advice)

    if bus.dropped:
        yield found(
            bus.name,
            "this machine dropped frames",
            Sure.CERTAIN,
            f"{bus.dropped} of {bus.frames + bus.dropped} frames, dropped by the kernel or the receive queue",
            "raise net.core.rmem_max or reduce the load; the dropped frames may explain findings about scans",
        )
    for patch in bus.patches:
        if patch.scans is None:
            continue
        stats, scans = patch.scans.stats, patch.scans.scans
        if stats.chunks_lost or stats.scans_torn or stats.summaries_lost:
            yield found(
                patch.name,
                "incomplete scans",
                Sure.LIKELY if bus.dropped else Sure.CERTAIN,
                f"{stats.scans_torn} of {scans} scans torn; {counted(stats.chunks_lost, 'chunk')} and "
                f"{counted(stats.summaries_lost, 'summary', 'summaries')} lost",
                "check the bus errors and the bus load, and whether other patches lose frames too",
            )
        if stats.scans_missed:
            yield found(
                patch.name,
                "whole scans are missing",
                Sure.CERTAIN,
                f"{stats.scans_missed} of {scans + stats.scans_missed}",
                "look for EMCY 0x8110: the node skips scans that take longer than the period",
            )
        if stats.conflicts:
            yield found(
                patch.name,
                "two different chunks with the same number",
                Sure.LIKELY,
                counted(stats.conflicts, "time"),
                "look for two nodes with the same node-ID: skinnode scan",
            )
        if stats.scans_corrupt:
            yield found(
                patch.name,
                "codes differ from the codes that the node packed",
                Sure.CERTAIN,
                f"{stats.scans_corrupt} of {scans + stats.scans_corrupt} scans failed the check",
                "check the node's memory and software, and any gateways on the path; "
                "CAN itself detects transmission errors",
            )
        wrong = stats.bad_length + stats.bad_index + stats.bad_counter + stats.bad_form
        if wrong:
            yield found(
                patch.name,
                "frames that are not chunks of this patch",
                Sure.CERTAIN,
                f"{stats.bad_length} with a wrong length, {stats.bad_index} with a wrong index, "
                f"{stats.bad_counter} with a wrong counter, {stats.bad_form} summaries without a check",
                "look for another node that uses the COB-IDs of this patch, and check its PDO mapping",
            )
