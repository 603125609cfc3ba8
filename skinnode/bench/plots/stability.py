"""Plots the hard cases: verdicts for each case and method, and error versus reported uncertainty."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench.verdict import LIMIT, named
from skinnode.files.plot_file import save_figure

COLUMNS: Final = (
    ("path\nGN", "path gauss_newton"),
    ("path\nLM", "path levenberg_marquardt"),
    ("path\ndogleg", "path dogleg"),
    ("path\nadaptive", "path adaptive"),
    ("exact", "exact"),
    ("posterior", "posterior"),
    ("auto", "auto"),
)
VERDICTS: Final = (("accurate", "#3a9e6e"), ("flagged", "#e3b23c"), ("wrong", "#c8322b"))
COLOURS: Final = {"path": "0.5", "exact": "tab:blue", "posterior": "tab:orange", "auto": "tab:purple"}
LEAST: Final = 1e-13
"""Lower limit of both axes; smaller errors and standard deviations are plotted at this value."""


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the results of :func:`skinnode.bench.stability.run` and write the plot to ``file``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row["case"] for row in figures["rows"]))
    height = max(9.5, 2.0 + 0.155 * len(names))
    figure = Figure(figsize=(17, height), layout="constrained")
    FigureCanvasAgg(figure)
    halves: Any = figure.subfigures(1, 2)
    left, right = halves
    _verdicts(left.subplots(), figures["rows"], names)
    above, below = right.subplots(2, 1, height_ratios=[8.0, height - 8.0])
    _scatter(above, figures["rows"])
    _list(below, [row for row in figures["rows"] if row["wrong"]], int((height - 9.0) / 0.16))
    wrong = sum(row["wrong"] > 0 for row in figures["rows"])
    figure.suptitle(
        f"skinnode bench stability: {len(figures['rows'])} rows, {figures['seeds']} seeds each, "
        f"{wrong} converged and wrong"
    )
    save_figure("--plot", file, figure, 110)


def _verdicts(axes: Any, rows: list[dict[str, Any]], names: list[str]) -> None:
    """Plot each row's verdicts as a stacked bar of fractions; enlarge the fraction ``wrong``."""
    place = {name: number for number, name in enumerate(names)}
    column = {method: number for number, (_, method) in enumerate(COLUMNS)}
    for row in rows:
        shares = np.array([row[verdict] / row["wires"] for verdict, _ in VERDICTS])
        if row["wrong"]:
            shares[2] = max(shares[2], 0.08)
            shares[:2] *= (1.0 - shares[2]) / max(shares[:2].sum(), 1e-12)
        start = column[row["method"]] + 0.04
        for part, (_, colour) in zip(0.92 * shares, VERDICTS, strict=True):
            axes.barh(place[row["case"]], part, left=start, height=0.8, color=colour, lw=0)
            start += part
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xticks(np.arange(len(COLUMNS)) + 0.5, [label for label, _ in COLUMNS])
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_xlim(0, len(COLUMNS))
    axes.set_ylim(len(names) - 0.4, -0.6)
    numbers = {row["case"]: row["number"] for row in rows}
    for above, below in itertools.pairwise(names):
        if numbers[above] != numbers[below]:
            axes.axhline(place[below] - 0.5, color="0.3", lw=0.5)
    for spine in axes.spines.values():
        spine.set_visible(False)
    handles = [axes.barh(-5, 0, color=colour, label=verdict) for verdict, colour in VERDICTS]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.005), ncols=3, frameon=False, fontsize=8
    )


def _scatter(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Plot each row's median error versus its median standard deviation, relative to the displacement."""
    for kind, colour in COLOURS.items():
        points = [
            (max(row["reported"], LEAST), max(row["median_error"], LEAST), row["wrong"] > 0)
            for row in rows
            if row["method"].startswith(kind) and None not in (row["reported"], row["median_error"])
        ]
        if not points:
            continue
        reported, error, wrong = np.array(points).T
        label = "path solver (std. dev. = error estimate / 5)" if kind == "path" else kind
        axes.scatter(reported, error, s=14, color=colour, label=label, alpha=0.8, lw=0)
        bad = wrong > 0
        axes.scatter(reported[bad], error[bad], s=46, facecolors="none", edgecolors=VERDICTS[2][1], lw=1)
    axes.scatter([], [], s=46, facecolors="none", edgecolors=VERDICTS[2][1], lw=1, label="with a wrong wire")
    line = np.array([LEAST, 1e5])
    axes.plot(line, line, color="0.3", lw=0.8)
    axes.plot(line, LIMIT * line, color="0.3", lw=0.8, ls="--")
    axes.text(1e-9, 1e-10, "error = reported", fontsize=8)
    axes.text(1e-9, 1e-7, f"{LIMIT:g} times reported", fontsize=8, ha="right")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("reported standard deviation / displacement (median over seeds)")
    axes.set_ylabel("error / displacement (median over seeds)")
    axes.set_aspect("equal")
    axes.grid(color="0.9", lw=0.5)
    axes.legend(loc="lower right", frameon=False, fontsize=8)


def _list(axes: Any, wrong: list[dict[str, Any]], most: int) -> None:
    """Write the rows with the largest errors as text."""
    axes.axis("off")
    worst = sorted(wrong, key=lambda row: -row["wrong"] / row["wires"])
    lines = [named(row) for row in worst[:most]]
    if len(worst) > most:
        lines.append(f"and {len(worst) - most} more rows")
    text = "\n".join(lines) if lines else "Nothing converged and wrong."
    axes.text(-0.1, 1.0, text, va="top", fontsize=6.5, transform=axes.transAxes)
