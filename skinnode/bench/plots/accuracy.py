"""Plots the results of ``skinnode bench accuracy``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench.accuracy_front import SOLVED
from skinnode.files.plot_file import save_figure

MARKS: Final = (
    ("skinnode", "tab:blue", "o"),
    ("solve_path", "tab:cyan", "s"),
    ("SciPy root", "tab:orange", "^"),
    ("SciPy least_squares", "tab:red", "v"),
    ("Ceres", "tab:green", "D"),
)
LAYOUTS: Final = {("staggered", 0.3): "#9ecae1", ("staggered", 0.5): "#4292c6", ("staggered", 1.0): "#08306b"}
ALIGNED: Final = {("aligned", 0.3): "#fdae6b", ("aligned", 0.5): "#e6550d", ("aligned", 1.0): "#7f2704"}


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the results of :func:`skinnode.bench.accuracy.run` and write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 14), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(3, 3)
    for axes in grid[0, len(figures["front"]) :]:
        axes.axis("off")
    for axes, panel in zip(grid[0], figures["front"], strict=False):
        _front(axes, panel)
    grid[0, 0].set_ylabel("error / displacement")
    grid[0, 0].legend(loc="upper right", fontsize=8, frameon=False)
    _noise(grid[1, 0], figures["noise"], "exact")
    _noise(grid[1, 1], figures["noise"], "posterior")
    _codes(grid[1, 2], figures["codes"])
    _honesty(grid[2, 0], figures["coverage"], "coverage", (0.90, 0.98), "fraction within the 95 % interval")
    _honesty(grid[2, 1], figures["coverage"], "ratio", (0.0, 1.15), "RMS error / RMS reported std. dev.")
    _time(grid[2, 2], figures["time"])
    reached = sum(row["reached"] for row in figures["must"])
    figure.suptitle(
        f"skinnode bench accuracy, {figures['scenes']} random scenes per row: "
        f"{reached} of {len(figures['must'])} requirements met"
    )
    save_figure("--plot", file, figure, 100)


def _front(axes: Any, panel: dict[str, Any]) -> None:
    rows = [row for row in panel["rows"] if row["error"] is not None and row["error"] <= SOLVED]
    for start, colour, mark in MARKS:
        own = [row for row in rows if row["who"].startswith(start)]
        axes.scatter(
            [row["us"] for row in own],
            [row["error"] for row in own],
            s=22,
            color=colour,
            marker=mark,
            label=start,
            alpha=0.75,
            lw=0,
        )
    front = sorted((row["us"], row["error"]) for row in rows if row["front"])
    if front:
        us, error = np.array(front).T
        axes.step(us, error, where="post", color="0.2", lw=1.0, label="Pareto front")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(15, 2e4)
    axes.set_title(f"four wires, no noise, {panel['scene']}", fontsize=10)
    axes.set_xlabel("µs per wire")
    axes.grid(color="0.9", lw=0.5)


def _noise(axes: Any, rows: list[dict[str, Any]], method: str) -> None:
    for (layout, height), colour in (LAYOUTS | ALIGNED).items():
        own = [
            row
            for row in rows
            if (row["layout"], row["height"], row["method"]) == (layout, height, method)
            and row["error"] is not None
        ]
        sigma = [row["sigma"] for row in own]
        label = f"{layout} h={height:g}"
        axes.plot(sigma, [row["error"] for row in own], "o-", ms=4, color=colour, label=label)
        axes.plot(sigma, [row["reported"] for row in own], "--", lw=0.9, color=colour)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(1e-3, 1e2)
    axes.axhline(1.0, color="0.6", lw=0.7)
    axes.set_xlabel("relative noise in each resistance")
    axes.set_ylabel("error (dashed: reported), share")
    axes.set_title(f"10% press, {method}, CONVERGED wires", fontsize=10)
    axes.grid(color="0.9", lw=0.5)
    axes.legend(fontsize=8, frameon=False, loc="upper left" if method == "posterior" else "lower right")


def _codes(axes: Any, rows: list[dict[str, Any]]) -> None:
    for (layout, method), (colour, line) in {
        ("staggered", "exact"): ("#4292c6", ":"),
        ("staggered", "posterior"): ("#4292c6", "-"),
        ("aligned", "exact"): ("#e6550d", ":"),
        ("aligned", "posterior"): ("#e6550d", "-"),
    }.items():
        own = [row for row in rows if (row["layout"], row["method"]) == (layout, method) and row["error"]]
        bits = [row["bits"] for row in own]
        axes.plot(
            bits, [row["error"] for row in own], "o" + line, ms=4, color=colour, label=f"{layout}, {method}"
        )
    axes.set_yscale("log")
    axes.set_xticks(sorted({row["bits"] for row in rows}))
    axes.set_xlabel("bits of a code")
    axes.set_ylabel("error, share")
    axes.set_title("10% press with codes, h=0.5", fontsize=10)
    axes.grid(color="0.9", lw=0.5)
    axes.legend(fontsize=8, frameon=False)


def _honesty(
    axes: Any, rows: list[dict[str, Any]], key: str, limits: tuple[float, float], title: str
) -> None:
    labels = list(
        dict.fromkeys(f"{row['layout']}\nh={row['height']:g}\nσ={row['sigma']:.0e}" for row in rows)
    )
    for shift, (method, colour) in enumerate((("exact", "0.6"), ("posterior", "tab:orange"))):
        values = [np.nan if row[key] is None else row[key] for row in rows if row["method"] == method]
        axes.bar(np.arange(len(labels)) + 0.4 * shift - 0.2, values, 0.38, color=colour, label=method)
    axes.axhspan(*limits, color="tab:green", alpha=0.15, lw=0, zorder=0, label="required of the posterior")
    axes.set_xticks(range(len(labels)), labels, fontsize=8)
    axes.set_ylim((0.8, 1.05) if key == "coverage" else (0.0, 1.7))
    axes.set_title(f"random scenes: {title}", fontsize=10)
    axes.legend(fontsize=8, frameon=False, loc="upper center", ncols=3)


def _time(axes: Any, rows: list[dict[str, Any]]) -> None:
    place = np.arange(len(rows))
    axes.barh(place, [row["us"] for row in rows], 0.5, color="tab:blue", label="measured")
    limits = [row["limit_us"] for row in rows]
    axes.plot(limits, place, "|", ms=30, mew=2, color="tab:red", ls="none", label="limit")
    axes.set_yticks(place, [row["what"].replace(", ", ",\n") for row in rows])
    axes.set_xscale("log")
    axes.set_xlim(50, 1e4)
    axes.invert_yaxis()
    axes.set_xlabel("µs per frame")
    axes.set_title("time per tracked frame, staggered h=0.5", fontsize=10)
    axes.legend(fontsize=8, frameon=False, loc="upper right", markerscale=0.4)
