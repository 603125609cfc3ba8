"""Plots the results of ``skinnode bench pipeline``: latency and CPU load for each hand."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any, Final

from skinnode.bench.pipeline import LATENCY_MS, hand_name, lost
from skinnode.files.plot_file import save_figure

_GROUPS: Final = {"receive": "tab:blue", "mainline": "tab:orange", "solve": "tab:green", "subscriber": "0.5"}


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the results of :func:`skinnode.bench.pipeline.run` and write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = figures["rows"]
    figure = Figure(figsize=(11, 2.2 + 0.55 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    latency, cpu = figure.subplots(1, 2, sharey=True)
    names = [f"{hand_name(row)}\n{row['frames_hz']:.0f} frames/s, {lost(row)} lost" for row in rows]
    heights = range(len(rows))
    for quantile, shade in (("max", "0.85"), ("p99", "0.65"), ("p50", "tab:blue")):
        latency.barh(
            heights, [row["published_ms"][quantile] or 0 for row in rows], color=shade, label=quantile
        )
    latency.axvline(LATENCY_MS, color="black", linestyle=":", label="limit for p99")
    latency.set_yticks(heights, names, fontsize="small")
    latency.invert_yaxis()
    latency.set_xlabel("time from the last frame of a scan to its field, ms")
    latency.legend(fontsize="small")
    left = [0.0] * len(rows)
    for group, colour in _GROUPS.items():
        shares = [100 * row["cpu"].get(group, 0.0) for row in rows]
        cpu.barh(heights, shares, left=left, color=colour, label=group)
        left = [a + b for a, b in zip(left, shares, strict=True)]
    cpu.set_xlabel("CPU time of the host's threads, % of a core")
    cpu.legend(fontsize="small")
    machine = ", ".join(f"{key} {value}".strip() for key, value in figures["machine"].items())
    figure.supxlabel("\n".join(textwrap.wrap(machine, 150)), fontsize="x-small", color="0.35")
    save_figure("--plot", file, figure, 110)
