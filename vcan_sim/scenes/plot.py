"""Preview plot of a scene: the force of each body over time, and the pressure at maximum depth.

Requires matplotlib.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.files.plot_file import save_figure
from vcan_sim.scenes.bind import bind_scene
from vcan_sim.scenes.patch import PatchScene
from vcan_sim.scenes.tables import SceneConfig
from vcan_sim.scenes.truth import PatchTruth

_COLOURS: Final = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown")


def write_plot(scene: SceneConfig, hand: HandConfig, file: Path) -> None:
    """Plot a scene to an image file, with one column per touched patch.

    Args:
        scene: Scene to plot.
        hand: Hand whose patches the scene touches.
        file: Image file. Its suffix selects the format.

    Raises:
        ConfigError: If the scene has no touches, a touch is impossible on its patch, or the file cannot be
            written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    touched = {name: patch for name, patch in bind_scene(scene, hand).items() if patch.histories}
    if not touched:
        raise ConfigError("--plot", str(file), "only for a scene with touches")
    colours = {body.name: _COLOURS[i % len(_COLOURS)] for i, body in enumerate(scene.bodies)}
    end_s = max(patch.end_s for patch in touched.values()) + 4.0 * scene.step_s
    times = scene.step_s * np.arange(int(end_s / scene.step_s) + 1)
    figure = Figure(figsize=(1.5 + 4.0 * len(touched), 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, len(touched), squeeze=False, height_ratios=[1.0, 1.6])
    for column, (name, patch) in enumerate(touched.items()):
        truths = [patch.truth(float(t)) for t in times]
        _forces(grid[0, column], times, truths, colours)
        grid[0, column].set_title(name)
        deepest = max(truths, key=_depth_m)
        image = _pressures(grid[1, column], patch, deepest, colours)
        figure.colorbar(image, ax=grid[1, column], label="pressure (kPa)")
        grid[0, column].axvline(deepest.t_s, color="0.6", lw=0.8)
    grid[0, 0].set_ylabel("force (N), dashed: shear")
    grid[1, 0].set_ylabel("y (mm)")
    save_figure("--plot", file, figure, 110)


def _depth_m(truth: PatchTruth) -> float:
    """Return the maximum contact depth (m) on a patch; 0 if there is no contact."""
    return max((contact.depth_m for contact in truth.contacts), default=0.0)


def _forces(axes: Any, times_s: Any, truths: list[PatchTruth], colours: dict[str, str]) -> None:
    """Plot the normal and shear forces of each body over time."""
    present = {contact.body for truth in truths for contact in truth.contacts}
    for body, colour in colours.items():
        if body not in present:
            continue
        force = np.zeros((len(truths), 3))
        for i, truth in enumerate(truths):
            force[i] = sum((each.force_n for each in truth.contacts if each.body == body), np.zeros(3))
        axes.plot(times_s, -force[:, 2], color=colour, label=body)
        axes.plot(times_s, np.hypot(force[:, 0], force[:, 1]), "--", color=colour)
    axes.set_xlabel("time (s)")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left", fontsize="small", frameon=False)


def _pressures(axes: Any, patch: PatchScene, truth: PatchTruth, colours: dict[str, str]) -> Any:
    """Plot the electrodes and all contact pressures at one instant, and return the pressure image."""
    highest_kpa = 1e-3 * max(float(contact.pressure_pa.max()) for contact in truth.contacts)
    image = None
    for contact in truth.contacts:
        pressure = np.ma.masked_less_equal(contact.pressure_pa, 0.0)
        cells = 1e3 * contact.cells_m
        image = axes.pcolormesh(
            cells[..., 0],
            cells[..., 1],
            1e-3 * pressure,
            shading="nearest",
            cmap="magma_r",
            vmin=0.0,
            vmax=highest_kpa,
        )
        x, y = 1e3 * contact.centre_m
        axes.annotate(contact.body, (x, y + 1e3 * contact.radius_m), ha="center", color=colours[contact.body])
    electrodes = 1e3 * patch.layout.upper_m.reshape(-1, 3)
    axes.plot(electrodes[:, 0], electrodes[:, 1], ".", ms=3, color="0.5")
    axes.set_aspect("equal")
    axes.set_title(f"{truth.t_s:.2f} s, deepest", fontsize="medium")
    axes.set_xlabel("x (mm)")
    return image
