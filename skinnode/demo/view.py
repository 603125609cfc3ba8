"""What the demo shows on a terminal: a height map per patch, health, rates and bus load."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.color import Color
from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.panel import Panel
from rich.segment import Segment
from rich.style import Style
from rich.table import Table
from rich.text import Text

from skinnode.model.layout import Float

# Five points of matplotlib's "magma" (CC0): equal steps of depth look like equal steps of brightness.
_COLOURS = np.array([(0, 0, 4), (81, 18, 124), (183, 55, 121), (252, 137, 97), (252, 253, 191)], dtype=float)
_LEVELS = 48
"""Shades on the screen; more could not be told apart and would cost time to draw."""
_ARROWS = "→↗↑↖←↙↓↘"
MAP_SIZE = 16
"""Characters across a height map; two pixels above each other make one character, so it is square."""


@dataclass(frozen=True, slots=True)
class PatchView:
    """One patch as the view shows it. Lengths in metres, NaN where not known yet."""

    name: str
    health: str
    displacement_m: Float | None
    """(U, N, 3)"""
    depth_std_m: float
    """Reported deviation of the depth of the deepest electrode."""
    error_m: float
    """RMS error of the last field against the true deformation."""
    rate_hz: float
    torn: int


@dataclass(frozen=True, slots=True)
class BusView:
    """The bus and the clock of the demo as the view shows them."""

    elapsed_s: float
    seconds: float
    load: float
    frames: int
    lost: int
    latency_p50_ms: float
    latency_p99_ms: float


@functools.lru_cache(maxsize=_LEVELS * _LEVELS)
def _style(above: int, below: int) -> Style:
    """A character's upper half in the colour of one level, its lower half in that of another."""
    return Style(color=Color.from_rgb(*_rgb(above)), bgcolor=Color.from_rgb(*_rgb(below)))


def _rgb(level: int) -> tuple[float, float, float]:
    position = level / (_LEVELS - 1) * (len(_COLOURS) - 1)
    low = min(int(position), len(_COLOURS) - 2)
    red, green, blue = _COLOURS[low] + (position - low) * (_COLOURS[low + 1] - _COLOURS[low])
    return float(red), float(green), float(blue)


def _resample(grid: Float, size: int) -> Float:
    """Bilinear, so that ten electrodes fill sixteen pixels without steps."""
    rows, columns = (np.linspace(0, n - 1, size) for n in grid.shape)
    across = np.stack([np.interp(columns, np.arange(grid.shape[1]), row) for row in grid])
    return np.stack([np.interp(rows, np.arange(grid.shape[0]), column) for column in across.T], axis=1)


class HeightMap:
    """Depth of the surface as coloured half blocks; the first upper wire is at the bottom.

    Segments are made directly, a run of equal colours in one: as text with a style a character it would cost
    the host milliseconds a redraw.
    """

    def __init__(self, displacement_m: Float | None, full_scale_m: float) -> None:
        depth = np.zeros((2, 2)) if displacement_m is None else -displacement_m[..., 2] / full_scale_m
        levels = np.rint(np.clip(_resample(depth, MAP_SIZE), 0.0, 1.0) * (_LEVELS - 1))
        self._levels = levels[::-1].astype(int).tolist()

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(MAP_SIZE, MAP_SIZE)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for upper, lower in zip(self._levels[0::2], self._levels[1::2], strict=True):
            for pair, run in itertools.groupby(zip(upper, lower, strict=True)):
                yield Segment("▀" * sum(1 for _ in run), _style(*pair))
            yield Segment.line()


def shear_arrow(displacement_m: Float) -> str:
    """Direction and size of the mean tangential displacement, weighted by depth; blank without contact."""
    weight = np.clip(-displacement_m[..., 2], 0.0, None)
    if weight.sum() <= 0.0:
        return "-"
    x, y = (float((displacement_m[..., axis] * weight).sum() / weight.sum()) for axis in (0, 1))
    size_um = 1e6 * float(np.hypot(x, y))
    if size_um < 1.0:
        return "-"
    return f"{_ARROWS[round(np.arctan2(y, x) / (np.pi / 4)) % 8]} {size_um:.0f} µm"


def _micro(value_m: float) -> str:
    return "-" if not np.isfinite(value_m) else f"{1e6 * value_m:.1f} µm"


def _patch_panel(patch: PatchView, full_scale_m: float) -> Panel:
    rows = Table.grid(padding=(0, 1), expand=True)
    rows.add_column(style="dim")
    rows.add_column(justify="right")
    if patch.displacement_m is None:
        depth, shear = float("nan"), "-"
    else:
        depth, shear = float(-patch.displacement_m[..., 2].min()), shear_arrow(patch.displacement_m)
    rows.add_row("depth", _micro(depth))
    rows.add_row("±", _micro(patch.depth_std_m))
    rows.add_row("shear", shear)
    rows.add_row("err RMS", _micro(patch.error_m))
    rows.add_row("rate", f"{patch.rate_hz:.1f} Hz")
    good = patch.health == "operational" and patch.torn == 0
    return Panel(
        Group(HeightMap(patch.displacement_m, full_scale_m), rows),
        title=Text(patch.name),
        subtitle=Text(patch.health, "green" if good else "red"),
        width=MAP_SIZE + 4,
        border_style="dim" if good else "red",
    )


def panels_in(columns: int, lines: int) -> int:
    """How many patches a terminal of this size has room for."""
    across, down = columns // (MAP_SIZE + 4), (lines - 4) // (MAP_SIZE // 2 + 7)
    return max(1, across) * max(1, down)


def render(
    patches: Sequence[PatchView], bus: BusView, full_scale_m: float, room: int = 1000
) -> RenderableType:
    """The whole screen. ``full_scale_m`` is the depth drawn brightest, ``room`` the most patches to draw."""
    line = Text.assemble(
        f" {bus.elapsed_s:.1f} of {bus.seconds:g} s   ",
        ("bus load ", "dim"),
        f"{100 * bus.load:.0f} % of 1 Mbit/s   ",
        ("frames ", "dim"),
        f"{bus.frames}   ",
        ("lost ", "dim"),
        (str(bus.lost), "bold red" if bus.lost else ""),
    )
    timing = Text.assemble(
        (" last frame to field ", "dim"),
        f"p50 {bus.latency_p50_ms:.1f} ms  p99 {bus.latency_p99_ms:.1f} ms   ",
        ("bright = ", "dim"),
        f"{1e6 * full_scale_m:.0f} µm deep",
    )
    panels = Columns([_patch_panel(p, full_scale_m) for p in patches[:room]], padding=(0, 0))
    if len(patches) > room:
        line.append(f"   and {len(patches) - room} more patches", style="dim")
    return Group(panels, line, timing)
