"""Window of grid cells under a body, large enough for the deepest contact of a touch."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Layer
from vcan_sim.contact.solve import press
from vcan_sim.scenes.shapes import Float, Shape

MOST_CELLS: Final = 1.4
"""Approximate maximum number of cells in a window, as a multiple of n², where n is the number of cells
requested across the narrow side. Elongated windows have larger cells, up to twice the size."""
MARGIN: Final = 0.1
"""Margin of the window around the deepest contact, relative to the contact's half width. The minimum is
``MARGIN_CELLS`` cells."""
FRICTION_MARGIN: Final = 0.15
"""Additional margin per unit of the friction coefficient. A sliding body piles up the skin ahead of it."""
MARGIN_CELLS: Final = 2
CLOSE: Final = 3e-4
"""Tolerance of the contact solver (:func:`vcan_sim.contact.solve.press`), relative to the depth."""
FORCE_CLOSE: Final = 2e-3
"""Relative tolerance on the normal force of a force-controlled touch."""
_TURNS: Final = 12
"""Maximum number of window sizes tried for one contact."""
_SEARCHES: Final = 40
"""Maximum number of depths tried in a search for a given force."""
_NOWHERE_M: Final = -1.0
"""Lower limit of the overlap, in metres. Points outside the body have this value."""


class TooMuch(ValueError):
    """The requested force exceeds ``most_n`` (N), the force at the maximum allowed depth."""

    def __init__(self, most_n: float) -> None:
        self.most_n = most_n
        super().__init__(f"at most {most_n:.3g} N")


@dataclass(frozen=True, eq=False)
class Window:
    """Window of grid cells under a body.

    Attributes:
        grid: Grid of cells and their elastic response.
        half_m: Half widths of the deepest contact along x and y, in metres.
        deepest_m: Depth of the deepest contact, metres, computed without friction.
        force_n: Normal force of the deepest contact, N, computed without friction.
    """

    grid: Grid
    half_m: tuple[float, float]
    deepest_m: float
    force_n: float


def overlap_m(grid: Grid, shape: Shape, offset_m: Float, yaw_rad: float, depth_m: float) -> Float:
    """Return the overlap of a rigid body with the undeformed surface.

    Args:
        grid: Cells at which the overlap is computed.
        shape: Shape of the body.
        offset_m: (2,) centre of the first cell relative to the lowest point of the body, in metres.
        yaw_rad: Rotation of the body about z, rad.
        depth_m: Depth of the body's lowest point below the surface, in metres.

    Returns:
        (X, Y) overlap, in metres; negative where the body is above the surface.
    """
    return np.maximum(depth_m - shape.over(grid.centres_m(offset_m), yaw_rad), _NOWHERE_M)


def centred_m(grid: Grid) -> Float:
    """Return the centre (2,) of a grid's first cell relative to the middle of the grid, in metres."""
    return -0.5 * grid.size_m * (np.array(grid.shape, float) - 1.0)


@functools.lru_cache(maxsize=512)
def window_of(  # noqa: PLR0913 - all inputs of a contact
    layer: Layer,
    body: BodyKey,
    yaws_rad: tuple[float, ...],
    level: float,
    by_force: bool,
    most_m: float,
    cells: int,
    margin: float = MARGIN,
) -> Window:
    """Return a window that covers the deepest contact of a touch.

    Args:
        layer: Elastic layer.
        body: Shape of the body.
        yaws_rad: Rotations of the body during the touch, rad.
        level: Maximum depth (m) or maximum normal force (N) of the touch.
        by_force: Whether ``level`` is a force.
        most_m: Maximum allowed depth, in metres.
        cells: Number of cells across the narrow side of the window.
        margin: Margin around the frictionless contact, relative to its half width.

    Raises:
        TooMuch: If the force requires a depth greater than ``most_m``.
    """
    if not by_force:
        return _fit(layer, body.shape, yaws_rad, level, cells, margin)
    found: dict[float, Window] = {}

    def force_n(depth_m: float) -> float:
        found[depth_m] = _fit(layer, body.shape, yaws_rad, depth_m, cells, margin)
        return found[depth_m].force_n

    if force_n(most_m) < level:
        raise TooMuch(found[most_m].force_n)
    depth = solve_depth(force_n, level, (most_m, found[most_m].force_n), 0.01)
    return found[depth]


@dataclass(frozen=True, eq=False)
class BodyKey:
    """Shape of a body, wrapped for use as a cache key."""

    shape: Shape

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BodyKey) and self.shape.key == other.shape.key

    def __hash__(self) -> int:
        return hash(self.shape.key)


def solve_depth(
    force_n: Callable[[float], float],
    target_n: float,
    known: tuple[float, float],
    close: float = FORCE_CLOSE,
) -> float:
    """Find the depth at which the contact force reaches a target.

    Force is nearly a power of depth, so the search is a bracketed secant method in the logarithms of both.
    The power law fails if few cells are in contact, so every second step bisects the bracket.

    Args:
        force_n: Function that returns the force (N) at a given depth (m). Its last call is made at the
            returned depth.
        target_n: Target force, N, positive.
        known: Known depth (m) and force (N). The first trial depth is derived from them, assuming F ∝ δ^1.5.
        close: Tolerance on the force, relative to the target.

    Raises:
        ArithmeticError: If the search does not converge.
    """
    low, high = 0.0, math.inf
    last = known
    depth = float(known[0] * (target_n / known[1]) ** (2.0 / 3.0))
    for trial in range(_SEARCHES):
        force = force_n(depth)
        if abs(force - target_n) <= close * target_n:
            return depth
        if force < target_n:
            low = max(low, depth)
        else:
            high = min(high, depth)
        if high - low < 0.1 * close * high:  # the remaining error is no larger than the contact solver's own
            return depth
        power = 1.5
        if force > 0.0 and last[1] > 0.0 and last[0] != depth and last[1] != force:
            power = min(max(math.log(force / last[1]) / math.log(depth / last[0]), 0.7), 60.0)
        last = (depth, force)
        following = (
            depth * (target_n / force) ** (1.0 / power) if force > 0.0 else math.sqrt(depth * known[0])
        )
        halve = trial % 2 and low > 0.0 and math.isfinite(high)
        if halve or not low < following < high:
            following = 0.5 * (low + high) if math.isfinite(high) else 1.5 * low
        depth = following
    raise ArithmeticError(
        f"no depth found for a force of {target_n:g} N in {_SEARCHES} trials; last trial: {depth:g} m"
    )


def _fit(  # noqa: PLR0913 - all inputs of a contact
    layer: Layer,
    shape: Shape,
    yaws_rad: tuple[float, ...],
    depth_m: float,
    cells: int,
    margin: float,
) -> Window:
    """Return a window that covers the contact at a given depth, for all rotations in ``yaws_rad``."""
    half = 1.5 * np.max([_extent_m(shape, yaw, depth_m) for yaw in yaws_rad], axis=0)
    for _ in range(_TURNS):
        grid = _grid(layer, half, cells)
        reached, force = np.zeros(2), 0.0
        for yaw in yaws_rad:
            pressure = press(grid, overlap_m(grid, shape, centred_m(grid), yaw, depth_m), close=CLOSE)
            places = np.abs(grid.centres_m(centred_m(grid))[pressure > 0.0]) + 0.5 * grid.size_m
            reached = np.maximum(reached, places.max(axis=0, initial=0.5 * grid.size_m))
            force = max(force, float(pressure.sum()) * grid.size_m**2)
        wanted = reached + np.maximum(margin * reached, MARGIN_CELLS * grid.size_m)
        has = 0.5 * grid.size_m * np.array(grid.shape)
        if (has >= reached + (MARGIN_CELLS - 0.5) * grid.size_m).all():
            if (has <= 1.15 * wanted + grid.size_m).all():
                return Window(grid, (float(reached[0]), float(reached[1])), depth_m, force)
            half = wanted
        else:
            half = np.where(has < wanted, np.maximum(1.3 * has, wanted), has)
    return Window(grid, (float(reached[0]), float(reached[1])), depth_m, force)


@functools.lru_cache(maxsize=256)
def _grid_of(layer: Layer, shape: tuple[int, int], size_m: float) -> Grid:
    return Grid.of(layer, shape, size_m)


def _grid(layer: Layer, half_m: Float, across: int) -> Grid:
    """Return a grid that extends at least ``half_m`` (2,) metres from its middle along x and y."""
    wide = 2.0 * half_m
    narrow = float(wide.min())
    size = max(narrow / across, math.sqrt(float(wide.prod()) / MOST_CELLS) / across)
    size = min(size, 2.0 * narrow / across)
    size = min(size, layer.thickness_m)  # larger cells would not resolve the response of the layer
    size = float(f"{size:.2g}")  # rounded, so that similar windows share a cached response
    cells = np.maximum(np.ceil(wide / size - 1e-9), 4).astype(int)
    return _grid_of(layer, (int(cells[0]), int(cells[1])), size)


def _extent_m(shape: Shape, yaw_rad: float, depth_m: float) -> Float:
    """Return upper bounds (2,) on the half widths (m) of a body along x and y at a given depth."""
    reach = 1e-5
    for _ in range(20):
        line = np.linspace(-reach, reach, 65)
        places = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
        inside = shape.over(places, yaw_rad) <= depth_m
        extent = np.abs(places[inside]).max(axis=0, initial=0.0)
        if extent.max() < reach * (1.0 - 1e-9):
            break
        reach *= 2.0
    for axis in (0, 1):  # a narrow body can fall between the points sampled above
        line = np.linspace(0.0, extent[axis] + 2.0 * reach / 64, 257)
        places = np.stack([line, 0.0 * line] if axis == 0 else [0.0 * line, line], axis=-1)
        inside = shape.over(places, yaw_rad) <= depth_m
        along = float(line[inside].max(initial=0.0)) + float(line[1])
        extent[axis] = max(extent[axis], along)
    return np.asarray(extent)
