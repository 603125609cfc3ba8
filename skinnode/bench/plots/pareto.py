"""Plots the results of ``skinnode bench accuracy --only pareto``: error and coverage against CPU time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from skinnode.bench.accuracy_pareto import METHODS, MOTIONS, pooled, sigmas
from skinnode.files.plot_file import save_figure

MARKS: Final = {
    "exact": ("exact inverse", "0.35", "s"),
    "cells": ("posterior", "tab:orange", "o"),
    "cells, past": ("posterior, earlier frames", "tab:red", "D"),
    "discs": ("discs", "tab:cyan", "^"),
    "discs, past": ("discs, earlier frames", "tab:blue", "v"),
}
"""Label, colour and marker of each method."""
SIZES: Final = {method: 55 if "past" in method else 140 for method in METHODS}
"""Marker size of each method; both markers of a prior remain visible even if earlier frames change
nothing."""
TITLES: Final = {"held": "body held still", "moving": "body moving"}
ASKED: Final = (0.92, 0.98)
"""Coverage range that is shaded."""


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the results of :func:`skinnode.bench.accuracy_pareto.run` and write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    noises = sigmas(figures)
    figure = Figure(figsize=(1.0 + 4.0 * len(noises), 11.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        2 * len(MOTIONS), len(noises), sharex=True, sharey="row", squeeze=False,
        height_ratios=[3, 1] * len(MOTIONS),
    )  # fmt: skip
    for row, motion in enumerate(MOTIONS):
        for column, sigma in enumerate(noises):
            errors, coverages = grid[2 * row, column], grid[2 * row + 1, column]
            _errors(errors, figures, sigma, motion)
            _coverages(coverages, pooled(figures, sigma, motion))
            errors.set_title(f"{TITLES[motion]}, noise {sigma:.0e}", fontsize=10)
        grid[2 * row, 0].set_ylabel("median error / displacement, %")
        grid[2 * row + 1, 0].set_ylabel("in 95 %\ninterval, %")
    for axes in grid[-1]:
        axes.set_xlabel("CPU time per frame, ms")
    figure.legend(
        handles=grid[0, 0].get_legend_handles_labels()[0], loc="outside lower center", ncols=4, frameon=False
    )
    figure.suptitle(
        f"skinnode bench accuracy --only pareto --scenes {figures['scenes']}: staggered, h = 0.5; "
        "left and down is better; small marks: one family of loads"
    )
    save_figure("--plot", file, figure, 100)


def _errors(axes: Any, figures: dict[str, Any], sigma: float, motion: str) -> None:
    rows = [row for row in figures["pareto"] if (row["sigma"], row["motion"]) == (sigma, motion)]
    for method in METHODS:
        label, colour, mark = MARKS[method]
        own = [row for row in rows if row["method"] == method and row["family"] != "all"]
        axes.scatter(
            [row["ms"] for row in own], [100.0 * row["error"] for row in own],
            s=12, color=colour, marker=mark, alpha=0.45, lw=0,
        )  # fmt: skip
        (every,) = (row for row in rows if row["method"] == method and row["family"] == "all")
        axes.scatter(
            every["ms"], 100.0 * every["error"], s=SIZES[method], color=colour, marker=mark, label=label,
            edgecolors="black", linewidths=0.7, zorder=3,
        )  # fmt: skip
    front = sorted(
        (row["ms"], 100.0 * row["error"]) for row in rows if row["family"] == "all" and row["front"]
    )
    axes.step(*zip(*front, strict=True), where="post", color="0.2", lw=1.0, zorder=2, label="Pareto front")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(color="0.9", lw=0.5)
    axes.set_axisbelow(True)


def _coverages(axes: Any, rows: list[dict[str, Any]]) -> None:
    axes.axhspan(*(100.0 * limit for limit in ASKED), color="tab:green", alpha=0.15, lw=0)
    for row in rows:
        _, colour, mark = MARKS[row["method"]]
        axes.scatter(
            row["ms"], 100.0 * row["coverage"], s=0.6 * SIZES[row["method"]], color=colour, marker=mark,
            edgecolors="black", linewidths=0.5, zorder=3,
        )  # fmt: skip
    axes.set_ylim(88.0, 100.5)
    axes.grid(color="0.9", lw=0.5)
    axes.set_axisbelow(True)
