"""Plots a demo run: true displacement, estimate and error of each patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skinnode.files.plot_file import save_figure
from skinnode.model.layout import Float


@dataclass(frozen=True, slots=True, eq=False)
class PatchTrace:
    """Plot data for T scans of one patch; times are in seconds since the start, lengths in metres."""

    name: str
    rest_m: Float
    """(U, N, 3) positions of the upper electrodes at rest."""
    time_s: Float
    """(T,) reception time of each scan."""
    depth_m: Float
    """(T,) true depth of the deepest electrode in each scan."""
    error_m: Float
    """(T,) RMS error of the field for each scan."""
    reported_m: Float
    """(T,) RMS of the standard deviations reported for each scan."""
    snapshot_truth_m: Float
    """(U, N, 3) true displacement in the scan with the deepest press."""
    snapshot_m: Float
    """(U, N, 3) displacement computed by the host for the same scan."""


def _map(  # noqa: PLR0913 - the options of an image
    axes: Any, field_m: Float, rest_m: Float, *, scale_um: float, colours: str, low: float
) -> Any:
    """Plot the depth of a displacement field as an image, one pixel per electrode."""
    x, y = 1e3 * rest_m[..., 0], 1e3 * rest_m[..., 1]
    half = 0.5 * (x[0, 1] - x[0, 0]) if x.shape[1] > 1 else 1.0
    extent = (x.min() - half, x.max() + half, y.min() - half, y.max() + half)
    image = axes.imshow(
        -1e6 * field_m[..., 2],
        origin="lower",
        extent=extent,
        cmap=colours,
        vmin=low * scale_um,
        vmax=scale_um,
        interpolation="nearest",
    )
    axes.set_xticks([])
    axes.set_yticks([])
    return image


def draw_demo(file: Path, traces: Sequence[PatchTrace]) -> None:
    """Write a figure with one column per patch.

    Each column shows the true displacement, the displacement computed by the host, their difference, and the
    error over time.

    Args:
        file: Output file; its suffix determines the format.
        traces: Plot data of each patch.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(traces)
    figure = Figure(figsize=(2.2 + 2.6 * count, 9.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(4, count, squeeze=False, height_ratios=[1, 1, 1, 0.9])
    deepest_um = 1e6 * max(float(-trace.snapshot_truth_m[..., 2].min()) for trace in traces)
    full_um = max(deepest_um, 1.0)  # prevents an empty axis range if no patch was pressed
    shear_um = 1e6 * max(float(np.abs(trace.snapshot_truth_m[..., :2]).max()) for trace in traces)
    highest_um = 1e6 * max(float(np.fmax(trace.error_m, trace.reported_m).max()) for trace in traces)
    errors = [trace.snapshot_m - trace.snapshot_truth_m for trace in traces]
    error_um = 1e6 * max(float(np.abs(error[..., 2]).max()) for error in errors)
    for column, (trace, error) in enumerate(zip(traces, errors, strict=True)):
        x, y = 1e3 * trace.rest_m[..., 0], 1e3 * trace.rest_m[..., 1]
        shown = (trace.snapshot_truth_m, trace.snapshot_m)
        for row, displacement in enumerate(shown):
            axes = grid[row, column]
            image = _map(axes, displacement, trace.rest_m, scale_um=full_um, colours="magma", low=0.0)
            tangential = 1e6 * displacement
            axes.quiver(
                x,
                y,
                tangential[..., 0],
                tangential[..., 1],
                color="tab:cyan",
                angles="xy",
                scale=5.0 * max(shear_um, 1e-3),
                width=0.012,
            )
            if row == 0:
                axes.set_title(trace.name)
        if column == count - 1:
            figure.colorbar(image, ax=grid[:2, :].ravel().tolist(), label="depth (µm); arrows: shear")
        image = _map(grid[2, column], error, trace.rest_m, scale_um=error_um, colours="coolwarm", low=-1.0)
        if column == count - 1:
            figure.colorbar(image, ax=grid[2, :].ravel().tolist(), label="depth error (µm)")
        axes = grid[3, column]
        axes.plot(trace.time_s, 1e6 * trace.error_m, ".", ms=3, color="tab:blue", label="error (RMS)")
        axes.plot(trace.time_s, 1e6 * trace.reported_m, "-", color="tab:orange", label="reported std. dev.")
        axes.set_ylim(0, 1.5 * highest_um)
        axes.set_xlabel("time (s)")
        depth = axes.twinx()
        depth.fill_between(trace.time_s, 1e6 * trace.depth_m, color="0.5", alpha=0.2, lw=0)
        depth.set_ylim(0, 1.5 * full_um)
        if column == count - 1:
            depth.set_ylabel("true depth (µm), grey")
        else:
            depth.set_yticklabels([])
        if column == 0:
            axes.set_ylabel("displacement (µm)")
            axes.legend(loc="upper left", fontsize="small", frameon=False)
        else:
            axes.set_yticklabels([])
    for row, label in enumerate(("true, deepest scan", "decoded", "decoded − true")):
        grid[row, 0].set_ylabel(label)
    save_figure("--plot", file, figure, 110)
