"""Plots the results of ``skinnode bench scale``: CPU time versus area and number of touches."""

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

    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    area, contact = figure.subplots(1, 2, sharey=True)
    for axes, rows, key in ((area, figures["area"], "patches"), (contact, figures["contact"], "touched")):
        for part, (label, colour) in _PARTS.items():
            axes.plot(
                [row[key] for row in rows], [row[part] for row in rows], "o-", color=colour, label=label
            )
        axes.grid(visible=True, color="0.9")
    area.set_xscale("log", base=2)
    ticks = [row["patches"] for row in figures["area"]]
    area.set_xticks(ticks, [str(tick) for tick in ticks])
    area.set_xlabel("patches, one of them touched")
    contact.set_xlabel(f"touched patches of {figures['contact'][0]['patches']}")
    area.set_ylabel("CPU time per patch and scan, ms")
    area.set_ylim(bottom=0.0)
    area.legend(fontsize="small")
    machine = ", ".join(f"{key} {value}".strip() for key, value in figures["machine"].items())
    figure.supxlabel("\n".join(textwrap.wrap(machine, 150)), fontsize="x-small", color="0.35")
    save_figure("--plot", file, figure, 110)
