"""Plots the results of ``skinnode bench path`` as figures 8 to 13 of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.files.plot_file import save_figure

COLOURS: Final = ("tab:blue", "tab:orange", "tab:green", "tab:red")


def draw(file: Path, figures: dict[str, Any]) -> None:
    """Plot the cost per step (top), the optimality along the path (middle) and the surface (bottom)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 15.5), layout="constrained")
    FigureCanvasAgg(figure)
    thirds: Any = figure.subfigures(3, 1)
    upper, middle, lower = thirds
    setting = figures["settings"][0]
    where = f"{setting['layout']}, h = {setting['height']:g} pitches, press {setting['depth']:.0%}"
    upper.suptitle(f"Cost: {where}; F with J, mean of {figures['experiments']} presses", fontsize="large")
    calls, uniform, table = upper.subplots(1, 3)
    _draw_calls(calls, setting)
    _draw_iterations(uniform, setting, figures["paper"])
    _draw_table(table, setting, figures["paper"])
    middle.suptitle(
        f"First-order optimality ‖Jᵀr‖∞ along the path: {where}; one press, steps as in the paper",
        fontsize="large",
    )
    _draw_optimality(middle, setting)
    last = figures["settings"][-1]
    where = f"{last['layout']}, h = {last['height']:g} pitches, press {last['depth']:.0%}"
    lower.suptitle(f"Recovered surface: {where}; hatched wires did not converge", fontsize="large")
    _draw_surface(lower, figures["surface"])
    save_figure("--plot", file, figure, 100)


def _draw_calls(axes: Any, setting: dict[str, Any]) -> None:
    for colour, (steps, calls) in zip(COLOURS, setting["figure8"].items(), strict=True):
        at = np.arange(1, len(calls) + 1) / int(steps)
        axes.plot(at, calls, "o-", ms=3, color=colour, label=f"{steps} steps")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("position of the step on the path (fraction of the press)")
    axes.set_ylabel("function calls per step")
    axes.set_title("Calls at each step (figure 8)")
    axes.legend(frameon=False, ncols=2)


def _draw_iterations(axes: Any, setting: dict[str, Any], paper: dict[str, Any]) -> None:
    """Plot the cumulative iteration count along the path for the first press."""
    for colour, marker, size, steps in ((COLOURS[0], "s", 8, "50"), (COLOURS[1], "o", 4, "100")):
        data = setting["figure11"][steps]
        each = np.array(data["uniform_each"])
        at = np.arange(1, len(each) + 1) / int(steps)
        axes.plot(at, np.cumsum(each), "-", color=colour, label=f"uniform, {steps} samples")
        kept = np.array(data["periodic_at"]) / int(steps)
        label = f"periodic, {steps} samples, {len(kept)} solved"
        solves = np.cumsum(data["periodic_each"])
        axes.plot(kept, solves, f"{marker}--", ms=size, mfc="none", color=colour, label=label)
    theirs = paper["figure11_iterations"]
    axes.set_xlabel("position on the path (fraction of the press)")
    axes.set_ylabel("iterations so far")
    axes.set_title(
        "Iterations, uniform and periodic (figure 11)\n"
        f"paper, 100 samples: {theirs['uniform_100_steps']} and {theirs['periodic_100_steps']}"
    )
    axes.legend(frameon=False)


def _draw_table(axes: Any, setting: dict[str, Any], paper: dict[str, Any]) -> None:
    """Plot the time per path versus the number of steps, for our solvers and the paper's."""
    table = paper["table4_dogleg"]
    axes.loglog(table["steps"], table["runtime_s"], "s-", color="0.5", label="paper (dogleg)")
    for colour, key, label in (
        (COLOURS[0], "dogleg", "dogleg as in the paper"),
        (COLOURS[1], "ours", "ours, Uniform()"),
    ):
        rows = setting[key]
        times = [row["runtime_ms"] / 1e3 for row in rows]
        axes.loglog([row["steps"] for row in rows], times, "o-", color=colour, label=label)
    adaptive = setting["adaptive"]["runtime_ms"] / 1e3
    axes.loglog([1], [adaptive], "*", ms=11, color=COLOURS[2], label="Adaptive, last sample only")
    axes.set_xlabel("steps")
    axes.set_ylabel("time per path of one wire (s)")
    axes.set_title("Time per path (table 4)")
    axes.legend(frameon=False, loc="upper left")
    axes.set_ylim(top=1e5)


def _draw_optimality(figure: Any, setting: dict[str, Any]) -> None:
    by_samples, by_tolerance, last = figure.subplots(1, 3, width_ratios=[1, 1, 0.8])
    for colour, (samples, values) in zip(COLOURS, setting["figure9"].items(), strict=True):
        _trace(by_samples, values, int(samples), colour, f"{samples} samples")
    by_samples.axhline(1e-4, color="k", lw=0.8, ls=":")
    by_samples.set_title("Tolerance 1e-4 (figure 9)")
    for colour, (tolerance, values) in zip(COLOURS, setting["figure10"].items(), strict=True):
        _trace(by_tolerance, values, 50, colour, f"tolerance {float(tolerance):.0e}")
        by_tolerance.axhline(float(tolerance), color=colour, lw=0.8, ls=":")
    by_tolerance.set_title("50 samples (figure 10)")
    lowest = min(min(values) for values in setting["figure10"].values())
    for axes in (by_samples, by_tolerance):
        axes.set_xlabel("position on the path (fraction of the press)")
        axes.set_ylabel("‖Jᵀr‖∞ (r relative, lengths in pitches)")
        axes.set_ylim(1e-3 * max(1e-18, lowest), 1e-1)
        axes.legend(frameon=False, loc="lower right", ncols=2)
    for colour, (label, values) in zip(COLOURS, setting["figure12"].items(), strict=False):
        last.semilogy(range(len(values)), np.maximum(values, 1e-18), "o-", color=colour, label=label)
    last.set_title("Last of 50 samples (figure 12)")
    last.set_xlabel("iteration")
    last.set_ylabel("‖Jᵀr‖∞")
    last.xaxis.get_major_locator().set_params(integer=True)
    last.legend(frameon=False)


def _trace(axes: Any, values: list[float], samples: int, colour: str, label: str) -> None:
    at = np.arange(1, len(values) + 1) / samples
    axes.semilogy(at, np.maximum(values, 1e-18), ".-", ms=4, lw=0.9, color=colour, label=label)


def _draw_surface(figure: Any, surface: dict[str, Any]) -> None:
    truth = np.array(surface["truth_um"])
    maps = figure.subplots(1, 1 + len(surface["paths"]))
    low = truth.min()
    shown: list[tuple[str, Any, list[bool]]] = [("true", truth, [])]
    for path in surface["paths"]:
        bad = path["converged"].count(False)
        largest = _length(path["error_um"])
        state = f"{bad} of {len(truth)} wires failed" if bad else "all wires converged"
        shown.append(
            (
                f"{path['title']}\nlargest error {largest}, {state}",
                np.array(path["depth_um"]),
                path["converged"],
            )
        )
    for axes, (title, depth, converged) in zip(maps, shown, strict=True):
        image = axes.imshow(depth, origin="lower", cmap="viridis", vmin=low, vmax=0.0)
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("electrode on the wire")
        for wire, solved in enumerate(converged):
            if not solved:
                axes.axhspan(wire - 0.5, wire + 0.5, fill=False, hatch="//", edgecolor="tab:red", lw=0)
    maps[0].set_ylabel("upper wire")
    figure.colorbar(image, ax=list(maps), label="displacement along z (µm)")


def _length(um: float) -> str:
    """Format a length with a suitable unit."""
    if not um < 1e6:
        return "beyond 1 m"
    if um >= 1e3:
        return f"{um / 1e3:.2g} mm"
    if um >= 1e-2:
        return f"{um:.2g} µm"
    return f"{um * 1e-6:.0e} m"
