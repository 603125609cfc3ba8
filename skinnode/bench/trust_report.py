"""Checks the targets of ``skinnode bench trust`` and formats the report."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final

from skinnode.bench import trust_road, trust_speed, trust_table
from skinnode.bench.trust_faults import singles
from skinnode.bench.trust_score import BEYOND, rate_bounds
from skinnode.bench.trust_signal import RATE_HZ, Setting

SECTIONS: Final = ("healthy", "single", "pair", "hours")
HEALTHY: Final = 0.99
"""Minimum fraction of fault-free fields that are trusted, at a relative noise of 1e-5 or 1e-4."""
FALSE_PER_HOUR: Final = 0.1
"""Maximum number of false alarms per patch-hour."""


def _sum(rows: Iterable[dict[str, Any]], key: str) -> float:
    return float(sum(row[key] for row in rows))


def verdicts(rows: Sequence[dict[str, Any]], settings: Sequence[Setting]) -> list[dict[str, Any]]:
    """Return the targets that apply to ``rows``, with the measured values and the verdicts."""
    by_section = {name: [row for row in rows if row["section"] == name] for name in SECTIONS}
    found = []
    for section, what in (("healthy", "no fault"), ("single", "one fault"), ("pair", "two faults")):
        if not by_section[section]:
            continue
        share = _sum(by_section[section], "beyond") / max(1.0, _sum(by_section[section], "coordinates"))
        found.append(_must(f"trusted coordinates beyond 5σ, {what}", share, BEYOND))
        if section == "single":
            missed = [row for row in by_section[section] if row["share_beyond"] > BEYOND]
            found.append(_must("faults with over 1 in 1000 coordinates beyond 5σ", len(missed), 0))
    if by_section["healthy"]:
        quiet = {setting.name for setting in settings if setting.noise <= 1e-4}
        cells = [
            cell for row in by_section["healthy"] for name, cell in row["settings"].items() if name in quiet
        ]
        if cells:
            share = _sum(cells, "trusted") / _sum(cells, "frames")
            found.append(
                _must("trusted fields without a fault, noise up to 1e-4", share, HEALTHY, least=True)
            )
    local = {fault.name for fault in singles() if fault.local}
    named = [row for row in by_section["single"] if row["row"] in local]
    if named:
        after = _sum(named, "after")
        share = _sum(named, "after_trusted") / after if after else 0.0
        found.append(
            _must("trusted fields with one fault, after its detection", share, trust_table.NAMED, least=True)
        )
    if by_section["hours"]:
        found.append(_false_namings(by_section["hours"]))
    return found


def part_verdicts(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the targets for the table of earlier failures and for fault injection on a bus."""
    found = []
    if "table" in figures:
        missed = sum(not row["reached"] for row in figures["table"])
        found.append(_must("earlier failures that persist", missed, 0))
    if "road" in figures:
        share = _sum(figures["road"], "beyond") / max(1.0, _sum(figures["road"], "coordinates"))
        found.append(_must("trusted coordinates beyond 5σ, over a bus", share, BEYOND))
    return found


def _must(what: str, got: float, asked: float, *, least: bool = False) -> dict[str, Any]:
    reached = got >= asked if least else got <= asked
    return {"what": what, "got": got, "asked": asked, "least": least, "reached": reached, "note": ""}


def _false_namings(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compare the false-alarm rate with its target; the row's note gives the confidence bounds."""
    hours, events = _sum(rows, "frames") / RATE_HZ / 3600.0, round(_sum(rows, "false_names"))
    low, high = rate_bounds(events, hours)
    verdict = _must("false alarms per patch-hour", events / hours, FALSE_PER_HOUR)
    bounds = f"{low:.2g} to {high:.2g}" if events else f"at most {high:.2g}"
    verdict["note"] = f"{events} in {hours:.2f} patch-hours: {bounds} per hour with 95 % confidence"
    return verdict


# --- text

HEAD: Final = (
    f"{'':34}{'fields':>8}{'trusted':>9}{'beyond 5':>10}{'worst':>9}{'named':>7}{'scans':>7}"
    f"{'then':>8}{'false':>7}{'contacts':>10}{'force':>7}  worst setting"
)
LEGEND: Final = (
    "trusted: fraction of fields that are trusted. beyond 5: fraction of trusted coordinates whose error\n"
    "exceeds 5 reported standard deviations. worst: largest such error, in standard deviations.\n"
    "named: fraction of streams in which the fault was identified. scans: median number of scans until it\n"
    "was identified. then: fraction of trusted fields from that scan on. false: faults reported for correct\n"
    "readings. contacts: fraction of trusted fields with the right number of contacts.\n"
    "force: fraction of contact forces within 5 standard deviations."
)


def lines(figures: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the complete report."""
    if figures["rows"]:
        yield HEAD
    for section, rows in itertools.groupby(figures["rows"], key=lambda row: str(row["section"])):
        yield f"{section}"
        for row in rows:
            yield line(row)
    if figures["rows"]:
        yield LEGEND
    yield from _parts(figures)
    yield ""
    yield from verdict_lines(figures["must"])


def _parts(figures: dict[str, Any]) -> Iterator[str]:
    """Yield the report lines of the additional parts of the benchmark."""
    for name, title, head, text in (
        ("table", "scenes whose fields were trusted but wrong in an earlier version", "", trust_table.text),
        (
            "speed",
            "speed versus error, staggered h=0.5, noise 1e-5, touched frames",
            trust_speed.HEAD,
            _one(trust_speed.text),
        ),
        (
            "road",
            "faults injected by the simulator, from node to host over a bus",
            trust_road.HEAD,
            _one(trust_road.text),
        ),
    ):
        if name not in figures:
            continue
        yield f"\n{title}"
        if head:
            yield head
        for row in figures[name]:
            yield from text(row)


def _one(text: Callable[[dict[str, Any]], str]) -> Callable[[dict[str, Any]], Iterator[str]]:
    return lambda row: iter((text(row),))


def line(row: dict[str, Any]) -> str:
    """Format a row of the report."""
    return (
        f"  {row['row']:32}{row['frames']:8}{_percent(row['share_trusted']):>9}"
        f"{_percent(row['share_beyond']):>10}{_number(row['worst']):>9}{_percent(row['share_named']):>7}"
        f"{_number(row['median_scans']):>7}{_percent(row['share_after']):>8}{row['false_names']:7}"
        f"{_percent(row['share_contacts']):>10}{_percent(row['share_forces']):>7}  "
        f"{row['worst_setting'] if row['worst'] > 5.0 else ''}"
    )


def verdict_lines(must: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yield one line for each target."""
    for row in must:
        bound = "at least" if row["least"] else "at most"
        verdict = "met" if row["reached"] else "NOT MET"
        note = f" ({row['note']})" if row["note"] else ""
        yield f"{row['what']:58}{row['got']:>10.4g}  {bound} {row['asked']:g}: {verdict}{note}"


def _percent(share: float | None) -> str:
    if share is None or math.isnan(share):
        return "-"
    if 0 < share < 1e-3:
        return f"{100 * share:.3f}%"
    return f"{100 * share:.0f}%" if share in (0.0, 1.0) else f"{100 * share:.1f}%"


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "-"
    return "inf" if math.isinf(value) else f"{value:.3g}"
