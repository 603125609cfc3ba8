"""Plots the results of ``skinnode bench accuracy --only detection``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from skinnode.files.plot_file import save_figure

LINES: Final = {
    "one frame": ("tab:blue", "-"),
    "mean of three frames": ("tab:green", "-"),
    "largest χ² of a wire": ("tab:orange", "--"),
    "known load": ("tab:gray", ":"),
}
"""Line colour and style of each detector."""


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the fraction of presses found against the false-alarm rate (ROC); write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = figures["roc"]
    figure = Figure(figsize=(4.5 * len(rows), 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, row in zip(figure.subplots(1, len(rows), squeeze=False)[0], rows, strict=True):
        for name, (colour, style) in LINES.items():
            axes.semilogx(row["alarms_per_hour"], row[name], color=colour, linestyle=style, label=name)
        axes.axvline(0.1, color="black", linewidth=0.5)
        axes.set_title(f"{row['kind']}, {row['depth']:.0%} of the layer height")
        axes.set_xlabel("false alarms per patch, 1/h")
        axes.set_ylim(0.0, 1.02)
        axes.grid(visible=True, alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("fraction of presses found")
    first.legend(loc="upper left", fontsize=8, frameon=False)
    figure.suptitle(
        "skinnode bench accuracy --only detection: staggered, h = 0.5, noise 1e-3, 12.5 scans/s; "
        "known load: the detector knows its position, size and depth, and sees one frame"
    )
    save_figure("--plot", file, figure, 100)
