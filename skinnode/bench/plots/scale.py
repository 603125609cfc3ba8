"""Plots the results of ``skinnode bench scale``: CPU time and memory versus area and number of touches."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any, Final

from skinnode.files.plot_file import save_figure

_PARTS: Final = {
    "nodes_ms": ("nodes (simulator)", "tab:green"),
    "bus_ms": ("timed bus (simulator)", "tab:orange"),
    "host_ms": ("host", "tab:blue"),
}


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the results of :func:`skinnode.bench.scale.run` and write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    FigureCanvasAgg(figure)
    area, contact, memory = figure.subplots(1, 3)
    contact.sharey(area)
    for axes, rows, key in ((area, figures["area"], "patches"), (contact, figures["contact"], "touched")):
        for part, (label, colour) in _PARTS.items():
            axes.plot(
                [row[key] for row in rows], [row[part] for row in rows], "o-", color=colour, label=label
            )
    ticks = [row["patches"] for row in figures["area"]]
    memory.plot(ticks, [row["memory_mb"] for row in figures["area"]], "o-", color="tab:purple")
    for axes in (area, contact, memory):
        axes.grid(visible=True, color="0.9")
    for axes in (area, memory):
        axes.set_xlabel("patches, one of them touched")
    area.set_xscale("log", base=2)
    area.set_xticks(ticks, [str(tick) for tick in ticks])
    contact.set_xticks([row["touched"] for row in figures["contact"]])
    memory.set_ylabel("memory of the process, MB")
    memory.set_ylim(bottom=0.0)
    contact.set_xlabel(f"touched patches of {figures['contact'][0]['patches']}")
    area.set_ylabel("CPU time per patch per scan (ms)")
    area.set_ylim(bottom=0.0)
    area.legend(fontsize="small")
    machine = ", ".join(f"{key} {value}".strip() for key, value in figures["machine"].items())
    figure.supxlabel("\n".join(textwrap.wrap(machine, 150)), fontsize="x-small", color="0.35")
    save_figure("--plot", file, figure, 110)
