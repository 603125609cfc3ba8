"""Renders a displacement field as characters: depth as brightness, shear as arrows.

The x axis of the patch (along the upper wires) points right, and its y axis points up. A character shows two
pixels, one above the other, so that pixels are roughly square. Without colours, the density of a character
represents the mean depth of its two pixels.
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
"""Colour support of the terminal: at least 256 colours, the 16 ANSI colours, or none (NO_COLOR)."""

Line = list[Segment]
"""Styled text that forms all or part of a screen line."""

MAGMA: Final = np.array([(0, 0, 4), (81, 18, 124), (183, 55, 121), (252, 137, 97), (252, 253, 191)], float)
"""Five equally spaced colours of matplotlib's "magma" colour map (CC0), (5, 3) RGB from 0 to 255.

Perceived brightness increases uniformly along the colour map.
"""
UNKNOWN_RGB: Final = (74, 78, 88)
"""Colour of pixels whose depth is unknown."""
LEVELS: Final = 24
"""Number of shades. More shades would look the same but take longer to draw and to transmit."""
_UNKNOWN: Final = -1
"""Shade of pixels whose depth is unknown."""
_SIGNS: Final = "·:-=+*#%@"
"""Characters for increasing depth on terminals without colours."""
_ANSI: Final = ("black", "blue", "magenta", "red", "yellow", "bright_white")
ARROWS: Final = "→↗↑↖←↙↓↘"

SURE: Final = 4.0
"""Minimum shear drawn as an arrow, as a multiple of its standard deviation."""
_SHORT: Final = 0.15
"""Minimum shear drawn as an arrow, as a fraction of the shear at full brightness."""

_STEPS_M: Final = tuple(
    step * 10.0**power for power in (-5, -4, -3, -2) for step in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
)
_LEAST_M: Final = 5e-5
"""Minimum depth (m) at full brightness. With a smaller minimum, noise would look like a touch."""
_MEMORY_NS: Final = 6_000_000_000
"""Time (ns) for which a press continues to affect the brightness scale after it has ended."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Quantities drawn on a field map: (U, N) arrays in metres, upper wire 0 first."""

    depth_m: Float
    """Depth, positive where the skin is pressed inwards."""
    shear_m: Float
    """(2, U, N) shear: components along and across the upper wires."""
    shear_std_m: Float
    unknown: NDArray[np.bool_]
    """(U, N) mask of the electrodes whose displacement is unknown."""
    aspect: float
    """Ratio of the patch's width to its height."""

    @property
    def deepest_m(self) -> float:
        """Maximum known depth, in metres."""
        return float(np.max(self.depth_m, initial=0.0, where=~self.unknown))


def surface_of(field: FieldFrame, upper_m: Float) -> Surface:
    """Return the quantities to draw on a field map.

    Args:
        field: Newest field of the patch.
        upper_m: (U, N, 3) positions of the electrodes at rest, in m.
    """
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
    """Return a patch's width-to-height ratio, treating the electrodes as the centres of equal cells."""
    wires, electrodes = upper_m.shape[:2]
    width, height = np.ptp(upper_m[..., :2].reshape(-1, 2), axis=0)
    width, height = width / max(electrodes - 1, 1) * electrodes, height / max(wires - 1, 1) * wires
    return float(np.clip(width / height, 0.2, 5.0)) if width > 0 and height > 0 else 1.0


def fit(width: int, height: int, aspect: float) -> tuple[int, int]:
    """Return the size of the largest map that fits in a box, if characters are twice as tall as wide."""
    across = min(width, round(2 * height * aspect))
    return max(2, across), max(1, min(height, round(across / (2 * aspect))))


@functools.lru_cache(maxsize=64)
def _weights(size: int, n: int) -> Float:
    """Return (size, n) weights that interpolate linearly from n electrodes to ``size`` pixels."""
    at = np.clip((np.arange(size) + 0.5) / size * n - 0.5, 0.0, n - 1)
    low = np.minimum(at.astype(int), max(n - 2, 0))
    made = np.zeros((size, n))
    made[np.arange(size), low] = 1.0 - (at - low)
    made[np.arange(size), np.minimum(low + 1, n - 1)] += at - low
    return made


def resample(grid: Float, width: int, height: int) -> Float:
    """Interpolate a (U, N) grid to a (height, width) image in which upper wire 0 is the last row."""
    rows, columns = _weights(height, grid.shape[0]), _weights(width, grid.shape[1])
    return np.asarray((rows @ grid @ columns.T)[::-1])


def arrow(x: float, y: float) -> str:
    """Return whichever of the eight arrows is closest to the direction (x, y)."""
    return ARROWS[round(math.atan2(y, x) / (math.pi / 4)) % 8]


def mean_shear_m(surface: Surface) -> tuple[float, float]:
    """Return the depth-weighted mean shear (x, y) in m; zero if nothing is pressing on the patch."""
    weight = np.where(surface.unknown, 0.0, np.clip(surface.depth_m, 0.0, None))
    total = float(weight.sum())
    if total <= 0.0:
        return 0.0, 0.0
    x, y = (surface.shear_m * weight).sum(axis=(1, 2)) / total
    return float(x), float(y)


class Scale:
    """Brightness scale of the maps; full brightness is the maximum depth of recent presses, rounded up.

    All patches share one scale, so that their maps are comparable.
    """

    def __init__(self) -> None:
        self._peaks: deque[tuple[int, float]] = deque()
        self.full_m = _LEAST_M

    def update(self, t_ns: int, deepest_m: float) -> None:
        """Update the scale with ``deepest_m``, the maximum depth (m) at ``t_ns``."""
        while self._peaks and (self._peaks[0][0] < t_ns - _MEMORY_NS or self._peaks[0][0] > t_ns):
            self._peaks.popleft()
        while self._peaks and self._peaks[-1][1] <= deepest_m:
            self._peaks.pop()
        self._peaks.append((t_ns, deepest_m))
        peak_m = max(self._peaks[0][1], _LEAST_M)
        self.full_m = next((step for step in _STEPS_M if step >= 0.999 * peak_m), _STEPS_M[-1])


@dataclass(frozen=True, slots=True)
class MapStyle:
    """Parameters that determine how maps are drawn."""

    full_m: float
    """Depth drawn at full brightness, in metres."""
    colours: Colours

    @property
    def full_shear_m(self) -> float:
        """Shear (m) at full brightness; a quarter of ``full_m``, because shear is smaller than depth."""
        return 0.25 * self.full_m


def paint_map(
    surface: Surface, style: MapStyle, width: int, height: int, *, arrows: bool = False
) -> list[Line]:
    """Draw depth as ``height`` lines of ``width`` characters and, if ``arrows`` is set, shear as arrows."""
    full_m, colours = style.full_m, style.colours
    levels = np.rint(
        np.clip(resample(surface.depth_m, width, 2 * height) / full_m, 0.0, 1.0) * (LEVELS - 1)
    ).astype(int)
    unknown = resample(surface.unknown.astype(float), width, 2 * height) > 0.5
    levels[unknown] = _UNKNOWN
    drawn = _arrows_on(surface, style, width, height) if arrows else {}
    upper, lower = levels[0::2].tolist(), levels[1::2].tolist()
    return [
        _depth_line(above, below, {x: sign for (x, y), sign in drawn.items() if y == row}, colours)
        for row, (above, below) in enumerate(zip(upper, lower, strict=True))
    ]


def _arrows_on(surface: Surface, style: MapStyle, width: int, height: int) -> dict[tuple[int, int], str]:
    """Return the arrows to draw, as a mapping from (column, line) to a character."""
    down = 1 if height < 7 else 2 if height < 18 else 3
    across = 2 * down
    rows, columns = (
        range((height - 1) % down // 2, height, down),
        range((width - 1) % across // 2, width, across),
    )
    x, y = (resample(axis, width, height) for axis in surface.shear_m)
    std = resample(np.where(np.isfinite(surface.shear_std_m), surface.shear_std_m, 1.0), width, height)
    size = np.hypot(x, y)
    shown = size > np.maximum(SURE * std, _SHORT * style.full_shear_m)
    return {
        (column, row): arrow(x[row, column], y[row, column])
        for row, column in itertools.product(rows, columns)
        if shown[row, column]
    }


def paint_shear(surface: Surface, style: MapStyle, width: int, height: int) -> list[Line]:
    """Draw shear as arrows. Arrows for stronger shear are brighter.

    If the map is large enough, every electrode has an arrow; larger maps also have arrows between electrodes.
    """
    colours = style.colours
    wires, electrodes = surface.depth_m.shape
    across, down = min(6, max(2, width // electrodes)), min(3, max(1, height // wires))
    columns, rows = width // across, height // down
    x, y = (resample(axis, columns, rows) for axis in surface.shear_m)
    std = resample(np.where(np.isfinite(surface.shear_std_m), surface.shear_std_m, 1.0), columns, rows)
    unknown = resample(surface.unknown.astype(float), columns, rows) > 0.5
    size = np.hypot(x, y)
    strength = np.clip(size / style.full_shear_m, 0.0, 1.0)
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


def legend(style: MapStyle, width: int, text: Style) -> Line:
    """Draw the colour scale, labelled with the depth at full brightness."""
    levels = np.rint(np.linspace(0, LEVELS - 1, width)).astype(int).tolist()
    return [*_depth_line(levels, levels, {}, style.colours), Segment(f" {1e6 * style.full_m:.0f} µm", text)]


def _depth_line(above: Sequence[int], below: Sequence[int], arrows: dict[int, str], colours: Colours) -> Line:
    cells = []
    for column, pair in enumerate(zip(above, below, strict=True)):
        sign = arrows.get(column)
        cells.append(_cell(*pair, colours) if sign is None else (sign, _arrow_style(*pair, colours)))
    return _grouped(cells)


def _grouped(cells: Sequence[tuple[str, Style]]) -> Line:
    """Merge neighbouring cells of the same style, because fewer segments are faster to draw."""
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
        return Color.from_rgb(*UNKNOWN_RGB)
    position = level / (LEVELS - 1) * (len(MAGMA) - 1)
    low = min(int(position), len(MAGMA) - 2)
    red, green, blue = MAGMA[low] + (position - low) * (MAGMA[low + 1] - MAGMA[low])
    return Color.from_rgb(float(red), float(green), float(blue))
