"""Formats the results of a run as a self-contained HTML page with verdicts and recorded frames."""

from __future__ import annotations

import datetime
from typing import Final

from skinnode.conformance.case import Result, Verdict
from skinnode.conformance.report import summary_line
from skinnode.conformance.run import Report
from skinnode.text.html_page import escaped, page

AREA_NAMES: Final = {
    "EDS": "Data sheet",
    "SDO": "Service data objects",
    "PDO": "Process data objects",
    "OD": "Object dictionary",
    "EMCY": "Emergency",
    "SYNC": "Synchronisation",
    "GUARD": "Node guarding",
    "HB": "Heartbeat",
    "HBVG": "Heartbeat versus guarding",
    "OTHER": "Store, restore, restricted identifiers",
    "STATE": "NMT states",
    "TRANS": "NMT transitions",
}

_CLASS: Final = {
    Verdict.PASSED: "passed",
    Verdict.WARNING: "warned",
    Verdict.FAILED: "failed",
    Verdict.NOT_APPLICABLE: "na",
}

_STYLE: Final = """
:root { color-scheme: light dark; --ink: #1d2430; --dim: #667085; --paper: #fff; --line: #e3e7ee; --soft:
#f6f8fb; --ok: #18794e; --warn: #a05c00; --bad: #c62a2f; --na: #8a94a6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ef; --dim: #98a2b3; --paper: #14171c; --line:
#2b313b; --soft: #1c2129; --ok: #4cc38a; --warn: #ffb454; --bad: #ff6369; --na: #7e8796; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 2rem 1.25rem 4rem;
  background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.05rem; margin: 2.2rem 0 .5rem; }
p { margin: .3rem 0; } .dim, h2 span { color: var(--dim); font-weight: normal; }
.bar { display: flex; height: .7rem; border-radius: .35rem; overflow: hidden; margin: 1.2rem 0 .6rem;
  background: var(--line); }
.bar i { display: block; } .bar .passed { background: var(--ok); }
.bar .warned { background: var(--warn); } .bar .failed { background: var(--bad); }
.bar .na { background: var(--na); }
.counts { display: flex; gap: 2rem; flex-wrap: wrap; } .counts b { font-size: 1.5rem; }
.counts .passed b { color: var(--ok); } .counts .warned b { color: var(--warn); }
.counts .failed b { color: var(--bad); } .counts .na b { color:
var(--na); } .areas { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap:
.4rem 1.5rem; margin-top: 1.4rem; } .areas a { display: flex; align-items: center; gap: .6rem; color: inherit;
  text-decoration: none; } .areas .bar { flex: 1; margin: 0; height: .4rem; } .areas span { min-width: 4rem; }
details { border-top: 1px solid var(--line); } details:last-of-type { border-bottom: 1px solid var(--line); }
summary { display: grid; grid-template-columns: 5.5rem 7.5rem 1fr auto; gap: .6rem; padding: .45rem .3rem;
  cursor: pointer; list-style: none; align-items: baseline; } summary::-webkit-details-marker { display:
  none; } summary:hover { background: var(--soft); } summary code { font-weight: 600; }
.verdict { font-size: .8rem; font-weight: 600; } .verdict.passed { color: var(--ok); }
.verdict.warned { color: var(--warn); }
.verdict.failed { color: var(--bad); } .verdict.na { color: var(--na); }
summary small { color: var(--dim); display: block; overflow-wrap: anywhere; }
.failed small { color: var(--bad); } time { color: var(--dim); font-size: .8rem; white-space: nowrap; }
pre { margin: 0 0 .6rem; padding: .7rem .9rem; background: var(--soft); border-radius: .4rem; overflow-x:
auto; font: 12.5px/1.45 ui-monospace, monospace; max-height: 26rem; }
@media (max-width: 40rem) { summary { grid-template-columns: 5rem 1fr; } summary > span:last-of-type,
  summary time { grid-column: 1 / -1; } }
@media print { details { break-inside: avoid; } }
"""


def as_html(report: Report, title: str, when: datetime.datetime) -> str:
    """Return the report as an HTML page with the failed cases expanded.

    Args:
        report: Results of the run.
        title: Name of the node and of the bus.
        when: Date and time of the run.
    """
    areas: dict[str, list[Result]] = {}
    for result in report.results:
        areas.setdefault(result.case.area, []).append(result)
    body = [
        f"<h1>CANopen conformance: {escaped(title)}</h1>",
        f'<p class="dim">{escaped(summary_line(report))}</p>',
        f'<p class="dim">{when:%Y-%m-%d %H:%M}; clauses of CiA 301 v4.2.0 unless stated otherwise</p>',
        _bar(report.results),
        f'<div class="counts">{"".join(_count(report, verdict) for verdict in Verdict)}</div>',
        *(f'<p class="verdict failed">{escaped(problem)}</p>' for problem in report.problems),
        f'<div class="areas">{"".join(_area_link(area, results) for area, results in areas.items())}</div>',
    ]
    for area, results in areas.items():
        name = AREA_NAMES.get(area, area)
        count = f"{len(results)} case{'s' if len(results) > 1 else ''}"
        body.append(f'<h2 id="{escaped(area)}">{escaped(name)} <span>{escaped(area)}, {count}</span></h2>')
        body += map(_case, results)
    return page(f"CANopen conformance: {title}", _STYLE, body)


def _bar(results: tuple[Result, ...] | list[Result]) -> str:
    parts = "".join(
        f'<i class="{_CLASS[verdict]}" style="flex:{count}"></i>'
        for verdict in Verdict
        if (count := sum(result.verdict is verdict for result in results))
    )
    return f'<div class="bar">{parts}</div>'


def _count(report: Report, verdict: Verdict) -> str:
    return f'<div class="{_CLASS[verdict]}"><b>{report.count(verdict)}</b> {verdict}</div>'


def _area_link(area: str, results: list[Result]) -> str:
    return f'<a href="#{escaped(area)}"><span>{escaped(area)}</span>{_bar(results)}</a>'


def _case(result: Result) -> str:
    kind = _CLASS[result.verdict]
    why = f"<small>{escaped(result.why)}</small>" if result.why else ""
    frames = escaped("\n".join(map(str, result.trace))) or "no frames"
    return (
        f'<details class="{kind}"{" open" if kind == "failed" else ""}><summary>'
        f'<code>{escaped(result.case.id)}</code><span class="verdict {kind}">{result.verdict}</span>'
        f"<span>{escaped(result.case.title)}{why}</span>"
        f"<time>{escaped(result.case.clause)} · {result.seconds:.2f} s</time></summary>"
        f"<pre>{frames}</pre></details>"
    )
