"""Draws the demo on a terminal: the bus load, and the height map, health and scan rate of each patch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.panel import Panel
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from skinnode.model.layout import Float
from skinnode.monitor.field_map import MapStyle, Surface, mean_shear_m, paint_map
from skinnode.monitor.patch_panel import shear_text

MAP_SIZE = 16
"""Width of a height map, in characters. Each character shows two pixels, one above the other, so that the map
is square."""


@dataclass(frozen=True, slots=True)
class PatchView:
    """Display data of one patch. Lengths are in metres; NaN stands for an unknown length."""

    name: str
    health: str
    displacement_m: Float | None
    """(U, N, 3) displacement in the newest field; None if there is no field yet."""
    depth_std_m: float
    """Reported standard deviation of the depth of the deepest electrode."""
    error_m: float
    """RMS error of the newest field."""
    rate_hz: float
    torn: int
    distrust: str = ""
    """Reason why the newest field is not trusted; empty if it is trusted."""


@dataclass(frozen=True, slots=True)
class BusView:
    """Display data of the bus and the run."""

    elapsed_s: float
    seconds: float
    load: float
    frames: int
    lost: int
    latency_p50_ms: float
    latency_p99_ms: float


class HeightMap:
    """Height map of a patch in the style of the monitor; upper wire 0 is at the bottom."""

    def __init__(self, surface: Surface, full_scale_m: float) -> None:
        height = MAP_SIZE // 2
        self._lines = paint_map(surface, MapStyle(full_scale_m, "rgb"), MAP_SIZE, height, arrows=False)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(MAP_SIZE, MAP_SIZE)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for line in self._lines:
            yield from line
            yield Segment.line()


def _surface(displacement_m: Float | None) -> Surface:
    """Return the surface to draw, which is flat if there is no field yet."""
    moved = np.zeros((2, 2, 3)) if displacement_m is None else displacement_m
    unknown = np.zeros(moved.shape[:2], dtype=np.bool_)
    return Surface(-moved[..., 2], np.moveaxis(moved[..., :2], -1, 0), np.zeros(unknown.shape), unknown, 1.0)


def _micro(value_m: float) -> str:
    return "-" if not np.isfinite(value_m) else f"{1e6 * value_m:.1f} µm"


def _patch_panel(patch: PatchView, full_scale_m: float) -> Panel:
    rows = Table.grid(padding=(0, 1), expand=True)
    rows.add_column(style="dim")
    rows.add_column(justify="right")
    surface = _surface(patch.displacement_m)
    depth_m = math.nan if patch.displacement_m is None else surface.deepest_m
    shear = shear_text(mean_shear_m(surface)) or "-"
    rows.add_row("depth", _micro(depth_m))
    rows.add_row("±", _micro(patch.depth_std_m))
    rows.add_row("shear", shear)
    rows.add_row("err RMS", _micro(patch.error_m))
    rows.add_row("rate", f"{patch.rate_hz:.1f} Hz")
    rows.add_row("trusted", "no" if patch.distrust else "yes" if patch.displacement_m is not None else "-")
    good = patch.health == "operational" and patch.torn == 0 and not patch.distrust
    return Panel(
        Group(HeightMap(surface, full_scale_m), rows),
        title=Text(patch.name),
        subtitle=Text("not trusted" if patch.distrust else patch.health, "green" if good else "red"),
        width=MAP_SIZE + 4,
        border_style="dim" if good else "red",
    )


def panels_in(columns: int, lines: int) -> int:
    """Return the number of patches that fit on a terminal of the given size, at least 1."""
    across, down = columns // (MAP_SIZE + 4), (lines - 4) // (MAP_SIZE // 2 + 8)
    return max(1, across) * max(1, down)


def render(
    patches: Sequence[PatchView], bus: BusView, full_scale_m: float, room: int = 1000
) -> RenderableType:
    """Return the contents of the screen.

    Args:
        patches: Data of each patch.
        bus: Data of the bus and of the run.
        full_scale_m: Depth drawn at full brightness, in metres.
        room: Maximum number of patches to draw.
    """
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
    doubts = [f" {patch.name} not trusted: {patch.distrust}" for patch in patches if patch.distrust]
    return Group(
        panels, line, timing, *(Text(each, "red", no_wrap=True, overflow="ellipsis") for each in doubts[:1])
    )
