"""Formats the doctor's report as a self-contained HTML page with findings, measured values and plots."""

from __future__ import annotations

import datetime
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from skinnode.diagnose.checks.run import not_judged, others
from skinnode.diagnose.facts import BusFacts, Finding, PatchFacts, ScanFacts
from skinnode.diagnose.noise import LEAST_SCANS, analyse_noise
from skinnode.diagnose.root_causes import Group
from skinnode.model.layout import Float
from skinnode.text.html_page import escaped, page
from skinnode.text.words import counted, known

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #1b1b1b; background: #fff }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc }
table { border-collapse: collapse; width: 100% } td, th { text-align: left; padding: .3rem .8rem .3rem 0;
       border-bottom: 1px solid #e4e4e4; vertical-align: top }
.finding { border-left: .35rem solid; padding: .1rem 0 .1rem .9rem; margin: 1rem 0 }
.finding p { margin: .15rem 0 } .certain { border-color: #b3261e } .likely { border-color: #c77700 }
.possible { border-color: #2b6cb0 } .sure { font-variant: small-caps; color: #555 }
svg { max-width: 100%; height: auto; margin-top: 1.2rem }
"""


def as_html(buses: Sequence[BusFacts], groups: Sequence[Group], title: str) -> str:
    """Return the report as an HTML page. If scans were captured, matplotlib is required.

    Args:
        buses: Facts about each bus.
        groups: Findings, grouped by root cause.
        title: Name of the hand or of the bus.
    """
    when = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
    parts = [
        f"<h1>{escaped(title)}: {counted(len(groups), 'finding')}</h1>",
        f"<p>{escaped(when)}</p>",
        *(_group(group) for group in groups),
        *([] if groups else ["<p>The checks that were run found no faults.</p>"]),
        *(f"<p>Also on the bus: {escaped(line)}</p>" for bus in buses for line in others(bus)),
        *(f"<p>Not judged: {escaped(line)}</p>" for bus in buses for line in not_judged(bus)),
    ]
    for bus in buses:
        parts.append(_bus(bus))
        parts += [_patch(patch) for patch in bus.patches]
    return page(f"{title}: examination", _STYLE, parts)


def _group(group: Group) -> str:
    """Format a cause, followed by its probable consequences."""
    below = "".join(_finding(finding) for finding in group.consequences)
    return _finding(group.cause, f"<p>Probable consequences:</p>{below}" if below else "")


def _finding(finding: Finding, below: str = "") -> str:
    return (
        f'<div class="finding {finding.sure}"><p><b>{escaped(finding.where)}: {escaped(finding.what)}</b> '
        f'<span class="sure">{finding.sure}</span></p><p>{escaped(finding.evidence)}</p>'
        f"<p>→ {escaped(finding.advice)}</p>{below}</div>"
    )


def _bus(bus: BusFacts) -> str:
    rows = [
        ("interface", f"{bus.interface} {bus.channel}, {bus.bitrate_bps} bit/s"),
        ("controller", bus.link_state or "not reported"),
        ("heard", f"{bus.frames} frames in {bus.seconds:.1f} s, load {bus.load:.0%}"),
        ("error frames", bus.error_frames),
        ("dropped by this machine", bus.dropped),
        ("SYNC", "sent by the doctor" if bus.sync_ours else f"{len(bus.sync_s)} heard"),
    ]
    return f"<h2>Bus {escaped(bus.name)}</h2>{_table(rows)}"


def _patch(patch: PatchFacts) -> str:
    node, scans = patch.found, patch.scans
    rows: list[tuple[str, object]] = [("node", patch.node_id)]
    if node is None:
        rows.append(("state", "not there"))
    else:
        rows += [("state", node.state), ("serial", known(node.serial))]
    if patch.info is not None and patch.info.patch is not None:
        own = patch.info.patch
        rows.append(("layout", f"{own.layout}, {own.upper_wires} × {own.lower_wires} wires"))
        rows.append(("error history", "; ".join(patch.info.errors) or "empty"))
    if scans is not None:
        stats = scans.stats
        rows.append(("scans", f"{scans.scans}, {stats.scans_torn} torn, {stats.scans_missed} missing"))
    plots = ""
    if scans is not None and scans.scans >= LEAST_SCANS:
        plots = _maps(scans) + _timeline(scans)
    return f"<h2>Patch {escaped(patch.name)}</h2>{_table(rows)}{plots}"


def _table(rows: Sequence[tuple[str, object]]) -> str:
    lines = "".join(f"<tr><th>{escaped(name)}</th><td>{escaped(value)}</td></tr>" for name, value in rows)
    return f"<table>{lines}</table>"


def _maps(scans: ScanFacts) -> str:
    """Plot the noise and R/R0 of all crossings."""
    analysis = analyse_noise(scans)
    figure, axes = _figure(2, 1, height_in=5.6)
    title = "noise / stated noise (grey: no value)" + (
        ", including the effect of a touch" if analysis.is_touched else ""
    )
    _map(figure, axes[0], analysis.noise / analysis.stated, title, "viridis", 0.0, None)
    off = 100 * (analysis.level - 1.0)
    known = off[np.isfinite(off)]
    limit = max(0.05, float(np.abs(known).max())) if known.size else 1.0
    _map(figure, axes[1], off, "R/R0 − 1, % (grey: no value)", "RdBu", -limit, limit)
    return _svg(figure)


def _map(  # noqa: PLR0913 - one image
    figure: Any, axes: Any, values: Float, title: str, colours: str, low: float, high: float | None
) -> None:
    axes.set_facecolor("#888")  # shown where a crossing has no value
    image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, aspect="auto", interpolation="nearest")
    axes.set(title=title, xlabel="lower wire", ylabel="upper wire")
    figure.colorbar(image, ax=axes, pad=0.01)


def _timeline(scans: ScanFacts) -> str:
    """Plot the delay of each scan after its SYNC (or the scan interval), and mark incomplete scans."""
    figure, (axes,) = _figure(1, 1, height_in=2.6)
    late_ms = np.where(scans.complete, 1e3 * scans.latency_s, np.nan)  # a torn scan's end is unknown
    if np.isfinite(late_ms).any():
        axes.plot(scans.t_s, late_ms, ".-", color="#2b6cb0", lw=0.8, label="last frame after SYNC, ms")
        axes.set_ylabel("ms after SYNC")
    else:
        axes.plot(scans.t_s[1:], 1e3 * np.diff(scans.t_s), ".-", color="#2b6cb0", lw=0.8)
        axes.set_ylabel("ms since the previous scan")
    for number, t_s in enumerate(scans.t_s[~scans.complete]):
        axes.axvline(t_s, color="#b3261e", lw=1, label=None if number else "incomplete scan")
    axes.set(xlabel="s", title="scans")
    axes.margins(y=0.1)
    axes.set_ylim(bottom=0.0)
    if (~scans.complete).any():
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return _svg(figure)


def _figure(rows: int, columns: int, *, height_in: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, height_in), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _svg(figure: Any) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return text.getvalue()[text.getvalue().index("<svg") :]
