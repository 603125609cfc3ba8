"""Scenes for the families of ``skinnode bench accuracy``: loads that violate the prior's assumptions.

Half of the scenes are closed-form loads on a half-space (:mod:`skinnode.bench.trust_loads`). In the other
half, a rigid body presses on a bonded layer in the simulator (:mod:`vcan_sim.contact`), which shares no code
with the solvers: the pressure is the solution of the contact problem, and friction is fully mobilised. A dent
and a plate over the whole patch exist only in closed form.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.bench import trust_loads
from skinnode.bench.truth import Load, Skin
from skinnode.model.layout import Float, PatchLayout
from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Layer
from vcan_sim.contact.solve import press

FAMILIES: Final = ("sphere", "punch", "ridge", "dent", "edge", "two", "whole patch")
BONDED: Final = ("sphere", "punch", "ridge", "edge", "two")
"""Families with scenes on a bonded layer."""
THICKNESSES: Final = (1.0, 2.0, 4.0)
"""Thicknesses of the bonded layers, as multiples of the height of the upper electrodes."""
APART: Final = (3.0, 6.0)
"""Minimum and maximum distance between two presses, in pitches."""
FINE: Final = 3
"""Number of simulator cells per pitch."""
MARGIN: Final = 3
"""Width of the simulated skin beyond the outermost electrodes, in pitches."""
CLOSE: Final = 1e-4
"""Maximum gap or overlap in a simulated contact, relative to the depth."""


@dataclass(frozen=True, eq=False)
class Scene:
    """True displacement of a patch under one or two loads."""

    truth_m: Float
    """(U, N, 3), m: displacement."""
    centers_m: tuple[tuple[float, float], ...]
    """Centre of each load, in m."""
    force_n: Float
    """(3,), N: total force; NaN if unknown."""
    bonded: bool
    """Whether the skin is the simulator's bonded layer."""


def draw(  # noqa: PLR0913 - the parts of a scene
    family: str,
    skin: Skin,
    rng: np.random.Generator,
    *,
    bonded: bool = False,
    depth: float | None = None,
    shift_m: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """Return a random scene of a family.

    Args:
        family: One of :data:`FAMILIES`.
        skin: Patch to press.
        rng: Random generator.
        bonded: Whether the body presses on a bonded layer; only for the families in :data:`BONDED`.
        depth: Depth divided by the height of the upper layer; random by default.
        shift_m: Displacement of the loads from their random positions, in metres. Scenes generated from the
            same generator state and with a given depth differ only in the depth and position of the loads.
    """
    layout = skin.layout
    loads: tuple[Load, ...] = (
        _pair(layout, rng, depth) if family == "two" else (trust_loads.draw(family, layout, rng, depth),)
    )
    loads = tuple(_shifted(load, shift_m) for load in loads)
    centers = tuple((float(load.center_m[0]), float(load.center_m[1])) for load in loads)
    if bonded and family in BONDED:
        kind = "sphere" if family in ("edge", "two") else family
        return _on_layer(kind, layout, loads, rng)
    truth = skin.displacement_m(loads, 1.0)
    return Scene(truth, centers, np.sum([load.force_n(1.0) for load in loads], axis=0), bonded=False)


def _shifted(load: Load, shift_m: tuple[float, float]) -> Load:
    if shift_m == (0.0, 0.0):
        return load
    x, y = load.center_m
    moved: Load = dataclasses.replace(load, center_m=(x + shift_m[0], y + shift_m[1]))  # type: ignore[type-var]
    return moved


def _pair(layout: PatchLayout, rng: np.random.Generator, depth: float | None) -> tuple[Load, Load]:
    """Return two spheres separated by a distance in the range :data:`APART`."""
    while True:
        first, second = (trust_loads.draw("sphere", layout, rng, depth) for _ in range(2))
        gap = np.subtract(second.center_m, first.center_m)
        apart = float(np.hypot(*gap)) / layout.pitch_m
        if APART[0] <= apart <= APART[1]:
            return first, second


@functools.lru_cache
def _grid(thickness_m: float, cells: tuple[int, int], size_m: float) -> Grid:
    return Grid.of(Layer(thickness_m), cells, size_m)


def _on_layer(kind: str, layout: PatchLayout, loads: tuple[Load, ...], rng: np.random.Generator) -> Scene:
    """Press rigid bodies into a bonded layer, at the positions and to the depths of ``loads``."""
    pitch = layout.pitch_m
    thickness = float(rng.choice(THICKNESSES)) * layout.height_m
    _, low, high = trust_loads.surface_m(layout)
    cells = tuple(round(float(n)) for n in ((high - low) / pitch + 2 * MARGIN) * FINE + 1)
    grid = _grid(thickness, (cells[0], cells[1]), pitch / FINE)
    place = grid.centres_m(low - MARGIN * pitch)
    overlap = np.full(grid.shape, -np.inf)
    for load in loads:
        offset = place - load.center_m
        depth, size = load.depth_m, rng.uniform(0.8, 2.0) * pitch
        if kind == "sphere":
            gap = (offset**2).sum(axis=-1) / (2.0 * rng.uniform(1.5, 3.5) * pitch)
        elif kind == "punch":
            gap = np.where(np.hypot(*np.moveaxis(offset, -1, 0)) <= size, 0.0, 20.0 * depth)
        else:
            angle = rng.uniform(0.0, math.pi)
            along = offset @ [math.cos(angle), math.sin(angle)]
            across = offset @ [-math.sin(angle), math.cos(angle)]
            gap = across**2 / (2.0 * pitch) + np.where(np.abs(along) <= 2.0 * pitch, 0.0, 20.0 * depth)
        overlap = np.maximum(overlap, depth - gap)
    pressure = press(grid, overlap, close=CLOSE)
    angle, friction = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, trust_loads.SHEAR)
    ratio = np.array([friction * math.cos(angle), friction * math.sin(angle), -1.0])
    traction = ratio[:, None, None] * pressure
    moved = np.moveaxis(grid.displacement_m(traction), 0, -1)
    at = np.rint((layout.upper_m[..., :2] - (low - MARGIN * pitch)) / grid.size_m).astype(int)
    centers = tuple((float(load.center_m[0]), float(load.center_m[1])) for load in loads)
    force = traction.sum(axis=(1, 2)) * grid.size_m**2
    return Scene(moved[at[..., 0], at[..., 1]], centers, force, bonded=True)
