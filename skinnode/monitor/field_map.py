"""A field as characters: depth as brightness, shear as arrows. Plain functions; who paints gives the size.

A map is seen as the skin is: x, along the upper wires, to the right; y, across them, upwards. Two pixels one
above the other make a character, so they are about square. Where colours are few or none, a character shows
the mean of its two pixels by a sign that is the heavier the deeper.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.segment import Segment
from rich.style import Style

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float

Colours = Literal["rgb", "ansi", "none"]
"""What the terminal has: as many as wanted (or 256), the sixteen of old, or none, as NO_COLOR asks for."""

Line = list[Segment]
"""A line of the screen, or a part of one."""

# Five points of matplotlib's "magma" (CC0): equal steps of depth look like equal steps of brightness.
_MAGMA: Final = np.array([(0, 0, 4), (81, 18, 124), (183, 55, 121), (252, 137, 97), (252, 253, 191)], float)
LEVELS: Final = 24
"""Shades on the screen; more could not be told apart and would cost time and line to draw."""
_UNKNOWN: Final = -1
"""The level of skin of which nothing is known."""
_SIGNS: Final = "·:-=+*#%@"
"""From untouched to deep, each covering more of its character."""
_ANSI: Final = ("black", "blue", "magenta", "red", "yellow", "bright_white")
ARROWS: Final = "→↗↑↖←↙↓↘"

SURE: Final = 4.0
"""Deviations from which a shear is drawn."""
_SHORT: Final = 0.15
"""Share of the full scale of shear below which no arrow is drawn."""

_STEPS_M: Final = tuple(
    step * 10.0**power for power in (-5, -4, -3, -2) for step in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
)
_LEAST_M: Final = 5e-5
"""The finest full scale, so that noise does not look like a touch."""
_MEMORY_NS: Final = 6_000_000_000
"""How long a deep press keeps the scale coarse."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A field, as far as maps show it. All (U, N), the first upper wire first; metres."""

    depth_m: Float
    """Positive where the skin is pressed in."""
    shear_m: Float
    """(2, U, N) along the wires and across them."""
    shear_std_m: Float
    unknown: NDArray[np.bool_]
    """Electrodes of which nothing is known."""
    aspect: float
    """Width over height of the patch."""

    @property
    def deepest_m(self) -> float:
        """Of what is known."""
        return float(np.max(self.depth_m, initial=0.0, where=~self.unknown))


def surface_of(field: FieldFrame, upper_m: Float) -> Surface:
    """The surface of a patch with its electrodes at rest at ``upper_m`` (U, N, 3)."""
    moved = np.moveaxis(field.displacement_m, -1, 0)
    std_m = field.displacement_std_m
    return Surface(
        depth_m=-moved[2],
        shear_m=moved[:2],
        shear_std_m=np.max(std_m[..., :2], axis=-1),
        unknown=~np.isfinite(std_m[..., 2]),
        aspect=aspect_of(upper_m),
    )


def aspect_of(upper_m: Float) -> float:
    """Width over height of a patch, each electrode standing for a cell of its own."""
    wires, electrodes = upper_m.shape[:2]
    width, height = np.ptp(upper_m[..., :2].reshape(-1, 2), axis=0)
    width, height = width / max(electrodes - 1, 1) * electrodes, height / max(wires - 1, 1) * wires
    return float(np.clip(width / height, 0.2, 5.0)) if width > 0 and height > 0 else 1.0


def fit(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The largest map of this shape in a box of characters; a character is twice as high as wide."""
    across = min(width, round(2 * height * aspect))
    return max(2, across), max(1, min(height, round(across / (2 * aspect))))


@functools.lru_cache(maxsize=64)
def _weights(size: int, n: int) -> Float:
    """(size, n): how the pixels of a map take part in n electrodes; bilinear, each electrode in the middle of
    its cell."""
    at = np.clip((np.arange(size) + 0.5) / size * n - 0.5, 0.0, n - 1)
    low = np.minimum(at.astype(int), max(n - 2, 0))
    made = np.zeros((size, n))
    made[np.arange(size), low] = 1.0 - (at - low)
    made[np.arange(size), np.minimum(low + 1, n - 1)] += at - low
    return made


def resample(grid: Float, width: int, height: int) -> Float:
    """(height, width) pixels of a grid (U, N), the first upper wire in the last row."""
    rows, columns = _weights(height, grid.shape[0]), _weights(width, grid.shape[1])
    return np.asarray((rows @ grid @ columns.T)[::-1])


def arrow(x: float, y: float) -> str:
    """The arrow of eight that comes nearest."""
    return ARROWS[round(math.atan2(y, x) / (math.pi / 4)) % 8]


def mean_shear_m(surface: Surface) -> tuple[float, float]:
    """The mean of the shear, weighted by depth; nothing where nothing is pressed."""
    weight = np.where(surface.unknown, 0.0, np.clip(surface.depth_m, 0.0, None))
    total = float(weight.sum())
    if total <= 0.0:
        return 0.0, 0.0
    x, y = (surface.shear_m * weight).sum(axis=(1, 2)) / total
    return float(x), float(y)


class Scale:
    """The depth drawn brightest: the least round number that the deepest press of the last seconds has
    room in. One for all patches, so that they compare."""

    def __init__(self) -> None:
        self._peaks: deque[tuple[int, float]] = deque()
        self.full_m = _LEAST_M

    def update(self, t_ns: int, deepest_m: float) -> None:
        """Take a new picture into account."""
        while self._peaks and (self._peaks[0][0] < t_ns - _MEMORY_NS or self._peaks[0][0] > t_ns):
            self._peaks.popleft()
        while self._peaks and self._peaks[-1][1] <= deepest_m:
            self._peaks.pop()
        self._peaks.append((t_ns, deepest_m))
        peak_m = max(self._peaks[0][1], _LEAST_M)
        self.full_m = next((step for step in _STEPS_M if step >= 0.999 * peak_m), _STEPS_M[-1])


def paint_map(
    surface: Surface, width: int, height: int, full_m: float, colours: Colours, *, arrows: bool
) -> list[Line]:
    """Depth as ``height`` lines of ``width`` characters, ``full_m`` the brightest; with ``arrows`` for shear
    here and there, where there is any."""
    levels = np.rint(
        np.clip(resample(surface.depth_m, width, 2 * height) / full_m, 0.0, 1.0) * (LEVELS - 1)
    ).astype(int)
    unknown = resample(surface.unknown.astype(float), width, 2 * height) > 0.5
    levels[unknown] = _UNKNOWN
    drawn = _arrows_on(surface, width, height, full_m) if arrows else {}
    upper, lower = levels[0::2].tolist(), levels[1::2].tolist()
    return [
        _depth_line(above, below, {x: sign for (x, y), sign in drawn.items() if y == row}, colours)
        for row, (above, below) in enumerate(zip(upper, lower, strict=True))
    ]


def _arrows_on(surface: Surface, width: int, height: int, full_m: float) -> dict[tuple[int, int], str]:
    """Arrows by column and line, every few characters: a press has room for several."""
    down = 1 if height < 7 else 2 if height < 18 else 3
    across = 2 * down
    rows, columns = (
        range((height - 1) % down // 2, height, down),
        range((width - 1) % across // 2, width, across),
    )
    x, y = (resample(axis, width, height) for axis in surface.shear_m)
    std = resample(np.where(np.isfinite(surface.shear_std_m), surface.shear_std_m, 1.0), width, height)
    size = np.hypot(x, y)
    shown = size > np.maximum(SURE * std, _SHORT * shear_scale_m(full_m))
    return {
        (column, row): arrow(x[row, column], y[row, column])
        for row, column in itertools.product(rows, columns)
        if shown[row, column]
    }


def shear_scale_m(full_m: float) -> float:
    """The shear drawn brightest: rubber gives way along the skin less than into it."""
    return 0.25 * full_m


def paint_shear(surface: Surface, width: int, height: int, full_m: float, colours: Colours) -> list[Line]:
    """Shear as arrows, the brighter the larger: one for each electrode as far as there is room, and between
    them where there is more."""
    wires, electrodes = surface.depth_m.shape
    across, down = min(6, max(2, width // electrodes)), min(3, max(1, height // wires))
    columns, rows = width // across, height // down
    x, y = (resample(axis, columns, rows) for axis in surface.shear_m)
    std = resample(np.where(np.isfinite(surface.shear_std_m), surface.shear_std_m, 1.0), columns, rows)
    unknown = resample(surface.unknown.astype(float), columns, rows) > 0.5
    size = np.hypot(x, y)
    strength = np.clip(size / shear_scale_m(full_m), 0.0, 1.0)
    left, top = (width - across * columns + across) // 2, (height - down * rows + down) // 2
    drawn: dict[tuple[int, int], tuple[str, Style]] = {}
    for row, column in itertools.product(range(rows), range(columns)):
        if unknown[row, column]:
            cell = "?", _shear_style(0.0, colours)
        elif size[row, column] <= SURE * std[row, column] or strength[row, column] < 0.5 * _SHORT:
            cell = "·", _shear_style(0.0, colours)
        else:
            sign = arrow(x[row, column], y[row, column])
            cell = sign, _shear_style(math.ceil(8 * float(strength[row, column])) / 8, colours)
        drawn[left + column * across, top + row * down] = cell
    blank = " ", _back(colours)
    return [_grouped([drawn.get((column, row), blank) for column in range(width)]) for row in range(height)]


def legend(full_m: float, width: int, colours: Colours, text: Style) -> Line:
    """The colours from untouched to the brightest, with its depth."""
    levels = np.rint(np.linspace(0, LEVELS - 1, width)).astype(int).tolist()
    return [*_depth_line(levels, levels, {}, colours), Segment(f" {1e6 * full_m:.0f} µm", text)]


def _depth_line(above: Sequence[int], below: Sequence[int], arrows: dict[int, str], colours: Colours) -> Line:
    cells = []
    for column, pair in enumerate(zip(above, below, strict=True)):
        sign = arrows.get(column)
        cells.append(_cell(*pair, colours) if sign is None else (sign, _arrow_style(*pair, colours)))
    return _grouped(cells)


def _grouped(cells: Sequence[tuple[str, Style]]) -> Line:
    """Segments of equal style in one: what is drawn costs by the segment."""
    return [
        Segment("".join(sign for sign, _ in run), style)
        for style, run in itertools.groupby(cells, key=lambda cell: cell[1])
    ]


@functools.lru_cache(maxsize=4096)
def _cell(above: int, below: int, colours: Colours) -> tuple[str, Style]:
    if colours == "rgb":
        if above == below:
            return " ", Style(bgcolor=_rgb(above))
        return "▀", Style(color=_rgb(above), bgcolor=_rgb(below))
    if _UNKNOWN in (above, below):
        return "?", Style(dim=True)
    share = (above + below) / (2 * (LEVELS - 1))
    if colours == "ansi":
        upper, lower = (_ANSI[round(level / (LEVELS - 1) * (len(_ANSI) - 1))] for level in (above, below))
        return (" ", Style(bgcolor=lower)) if upper == lower else ("▀", Style(color=upper, bgcolor=lower))
    return _SIGNS[math.ceil(share * (len(_SIGNS) - 1))], Style(dim=share == 0.0)


@functools.lru_cache(maxsize=4096)
def _arrow_style(above: int, below: int, colours: Colours) -> Style:
    mean = max(0, above + below) // 2
    bright = mean > 0.6 * LEVELS
    if colours == "rgb":
        return Style(color=Color.from_rgb(0, 0, 0) if bright else _ARROW, bgcolor=_rgb(mean), bold=True)
    if colours == "ansi":
        colour = _ANSI[round(mean / (LEVELS - 1) * (len(_ANSI) - 1))]
        return Style(color="black" if bright else "bright_cyan", bgcolor=colour, bold=True)
    return Style(bold=True, reverse=bright)


@functools.lru_cache(maxsize=64)
def _shear_style(strength: float, colours: Colours) -> Style:
    if colours == "rgb":
        dark, light = np.array((58, 62, 74.0)), np.array((140, 245, 225.0))
        red, green, blue = dark + strength * (light - dark)
        return Style(color=Color.from_rgb(red, green, blue), bgcolor=_rgb(0), bold=strength > 0.5)
    if colours == "ansi":
        return Style(color="bright_cyan" if strength > 0.0 else "bright_black", bgcolor="black")
    return Style(bold=strength > 0.5, dim=strength == 0.0)


def _back(colours: Colours) -> Style:
    return {"rgb": Style(bgcolor=_rgb(0)), "ansi": Style(bgcolor="black"), "none": Style()}[colours]


_ARROW: Final = Color.from_rgb(140, 245, 225)


@functools.lru_cache(maxsize=LEVELS + 1)
def _rgb(level: int) -> Color:
    if level == _UNKNOWN:
        return Color.from_rgb(74, 78, 88)
    position = level / (LEVELS - 1) * (len(_MAGMA) - 1)
    low = min(int(position), len(_MAGMA) - 2)
    red, green, blue = _MAGMA[low] + (position - low) * (_MAGMA[low + 1] - _MAGMA[low])
    return Color.from_rgb(float(red), float(green), float(blue))
