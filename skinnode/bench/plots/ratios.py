"""Plots the results of ``skinnode bench kernel`` and ``skinnode bench solve``: times and time ratios."""

from __future__ import annotations

import textwrap
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from skinnode.files.plot_file import save_figure

OURS: Final = "tab:blue"
THEIRS: Final = "0.65"
BAR_INCH: Final = 0.27


def _figure(rows: float, width: float, columns: int) -> tuple[Any, list[Any]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 1.9 + BAR_INCH * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, columns, squeeze=False, sharey=True, width_ratios=[2.2, 1][:columns])
    return figure, list(axes[0])


def _save(figure: Any, file: Path, figures: dict[str, Any]) -> None:
    machine = ", ".join(f"{key} {value}" for key, value in figures["machine"].items())
    lines = textwrap.wrap(f"one run on: {machine}", width=int(15 * figure.get_figwidth()))
    figure.supxlabel("\n".join(lines), fontsize="x-small", color="0.35")
    save_figure("--plot", file, figure, 110)


def _bars(axes: Any, rows: list[dict[str, Any]], heights: list[float], ours: list[bool]) -> None:
    """Plot times as bars on a logarithmic axis; label each bar with its time and ratio."""
    times = [row["us"] for row in rows if row["us"] is not None]
    low = 0.5 * min(times)
    axes.set_xscale("log")
    axes.set_xlim(low, 8.0 * max(times))
    for row, height, own in zip(rows, heights, ours, strict=True):
        if row["us"] is None:
            axes.text(1.1 * low, height, "accuracy not reached", va="center", fontsize="small", color="0.35")
            continue
        axes.barh(height, row["us"] - low, left=low, height=0.72, color=OURS if own else THEIRS)
        digits = 1 if row["us"] < 100 else 0
        ratio = "" if row["ratio"] == 1 else f"  ({row['ratio']:.{'2g' if row['ratio'] < 10 else '0f'}}×)"
        label = f" {row['us']:.{digits}f} µs{ratio}"
        axes.text(row["us"], height, label, va="center", fontsize="small")
    axes.grid(axis="x", which="major", color="0.9")
    axes.set_axisbelow(True)


def draw_kernel(file: Path, figures: dict[str, Any]) -> None:
    """Plot a group of bars for each operation; ratios are relative to the compiled kernel."""
    heights, rows, heads = [], figures["rows"], []
    height = 0.0
    for what, group in groupby(rows, key=lambda row: row["what"]):
        heads.append((height, what))
        members = list(group)
        heights += [height + 1 + i for i in range(len(members))]
        height += len(members) + 1.4
    figure, (axes,) = _figure(height, 8.0, 1)
    _bars(axes, rows, heights, [row["who"] == "compiled" for row in rows])
    for at, what in heads:
        axes.text(axes.get_xlim()[0] * 1.05, at + 0.1, what, va="center", fontweight="bold", fontsize="small")
    axes.set_yticks(heights, [row["who"] for row in rows], fontsize="small")
    axes.set_ylim(height - 0.6, -0.8)
    axes.set_xlabel("time (µs; for F + J and steps: per wire); ratio to ours in brackets")
    axes.set_title("Compiled kernels (blue) and their peers, one thread each")
    _save(figure, file, figures)


def draw_solve(file: Path, figures: dict[str, Any]) -> None:
    """Plot each solver's time per wire, fastest first; label each bar with the error of the result."""
    rows = sorted(figures["rows"], key=lambda row: (row["us"] is None, row["us"] or 0.0))
    heights = [float(i) for i in range(len(rows))]
    ours = [row["who"].startswith("skinnode") for row in rows]
    figure, (time, error) = _figure(len(rows), 10.0, 2)
    _bars(time, rows, heights, ours)
    time.set_yticks(heights, [row["who"] for row in rows], fontsize="small")
    time.set_ylim(len(rows) - 0.4, -0.6)
    time.set_xlabel("time per wire (µs); ratio to skinnode dogleg in brackets")
    error.scatter([row["error"] for row in rows], heights, c=[OURS if own else "0.35" for own in ours], s=22)
    error.axvline(figures["accuracy"], color="tab:red", lw=1)
    error.annotate(
        "asked for", (figures["accuracy"], -0.45), xytext=(-4, 0), textcoords="offset points",
        ha="right", va="top", fontsize="x-small", color="tab:red",
    )  # fmt: skip
    error.set_xscale("log")
    error.grid(axis="both", which="major", color="0.9")
    error.set_axisbelow(True)
    error.tick_params(axis="y", length=0)
    error.set_xlabel("largest error / displacement")
    figure.suptitle("One wire of the reference patch, starting close to the solution (skinnode in blue)")
    _save(figure, file, figures)
