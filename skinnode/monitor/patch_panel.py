"""Renders a patch as one of several tiles, or on its own with all its values."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from rich.segment import Segment
from rich.style import Style

from skinnode.canopen.nmt import STATE_NAMES
from skinnode.monitor import field_map
from skinnode.monitor.field_map import Line
from skinnode.monitor.theme import Paint, Theme, beside, centred, pad, spread
from skinnode.monitor.view_model import PatchView
from skinnode.text.words import counted

GONE: Final = ("lost", "never seen", "stale", "refused", "restarting", "booting", "starting")
"""Conditions in which the last displacement field of a patch is out of date."""
_AROUND: Final = 3
"""Number of lines in a tile, excluding its map."""
_LEAST_OUTLINED: Final = (8, 5)
"""Minimum size of a box in which the map has an outline: width in characters, height in lines."""
_LABEL: Final = 10
"""Width of the value-name column, in characters."""


def tiles(patches: Sequence[PatchView], paint: Paint, width: int, height: int) -> list[Line]:
    """Draw all patches as tiles in ``height`` lines, with as many columns as give the largest maps."""
    theme = paint.theme
    count = len(patches)
    aspect = max((patch.surface.aspect for patch in patches if patch.surface is not None), default=1.0)

    def high_of(columns: int) -> int:
        """Return the height of a map, in lines, if the tiles are arranged in ``columns`` columns."""
        box = width // columns - 1, height // -(-count // columns) - _AROUND
        across, down, frame = _fit(*box, aspect) if min(box) > 0 else (0, 0, 0)
        return down + frame if across else 0

    columns = max(range(1, count + 1), key=high_of)
    wide, high = width // columns, max(1, high_of(columns)) + _AROUND
    lines: list[Line] = []
    for first in range(0, count, columns):
        row = [
            (_tile(first + number, patch, paint, wide - 1, high), wide)
            for number, patch in enumerate(patches[first : first + columns], 1)
        ]
        lines += [pad(line, width, theme) for line in beside(row, high, theme)]
    return lines[:height]


def _tile(number: int, patch: PatchView, paint: Paint, width: int, height: int) -> list[Line]:
    theme, ui = paint.theme, paint.ui
    chosen = theme.chosen if patch.name == ui.selected else theme.strong
    forces = [touch.force_n for touch in patch.touches if touch.force_n is not None]
    force = [Segment(f"{sum(forces):.2f} N ", theme.text)] if forces and patch.condition not in GONE else []
    name = f" {number} {patch.name} " if width >= 12 else patch.name
    title = spread([Segment(name, chosen)], force if width >= 16 else [], width, theme)
    body = _map(patch, paint, width, height - _AROUND, arrows=ui.arrows)
    return [title, *body, _figures(patch, theme, width), _health(patch, theme, width)]


def _map(patch: PatchView, paint: Paint, width: int, height: int, *, arrows: bool) -> list[Line]:
    """Draw the depth map of a patch, centred in its box.

    Untouched skin is as dark as the background, so an outline marks the edge of the map. If a patch has
    stopped sending data, its last map is drawn without colours, with the condition of the patch written
    across it.
    """
    theme = paint.theme
    if patch.surface is None:
        blank = [pad([], width, theme) for _ in range(height)]
        blank[height // 2] = centred([Segment("no field", theme.dim)], width, theme)
        return blank
    across, down, frame = _fit(width, height, patch.surface.aspect)
    gone = patch.condition in GONE
    lines = field_map.paint_map(
        patch.surface,
        replace(paint.map_style, colours="none") if gone else paint.map_style,
        across,
        down,
        arrows=arrows and not gone and down > 3,
    )
    if gone:
        lines = [[Segment(segment.text, theme.dim) for segment in line] for line in lines]
        age_s = patch.health.scan_age_s
        texts = [f" {patch.condition} ", *([f" for {_span(age_s)} "] if age_s is not None else [])]
        for row, text in enumerate(texts, max(0, down // 2 - 1)):
            if row < down:
                lines[row] = centred([Segment(text[:across], theme.alarm)], across, theme)
    if frame:
        lines = outlined(lines, across, theme)
    lines = [centred(line, width, theme) for line in lines]
    return lines + [pad([], width, theme) for _ in range(height - len(lines))]


def _fit(width: int, height: int, aspect: float) -> tuple[int, int, int]:
    """Return the width and height of the largest map in a box, and the extra characters for its outline.

    A small box has no outline.
    """
    frame = 2 if width >= _LEAST_OUTLINED[0] and height >= _LEAST_OUTLINED[1] else 0
    return (*field_map.fit(width - frame, height - frame, aspect), frame)


def outlined(lines: Sequence[Line], across: int, theme: Theme) -> list[Line]:
    """Draw an outline around the lines of a map that is ``across`` characters wide."""
    side = Segment("│", theme.dim)
    return [
        [Segment(f"┌{'─' * across}┐", theme.dim)],
        *([side, *line, side] for line in lines),
        [Segment(f"└{'─' * across}┘", theme.dim)],
    ]


def _figures(patch: PatchView, theme: Theme, width: int) -> Line:
    """Draw the depth and shear of a patch as numbers."""
    if patch.depth_m is None or patch.condition in GONE:
        return pad([], width, theme)
    line = [Segment(f" {1e6 * patch.depth_m:.0f}", theme.text)]
    if patch.depth_std_m is not None and width >= 18:
        line.append(Segment(f" ± {1e6 * patch.depth_std_m:.1f}", theme.dim))
    line.append(Segment(" µm", theme.dim))
    shear = shear_text(patch.shear_m)
    return spread(line, [Segment(f"{shear} ", theme.text)] if width >= 20 else [], width, theme)


def _health(patch: PatchView, theme: Theme, width: int) -> Line:
    """Draw a line that shows the patch's most severe fault or, if it has no fault, its field rate."""
    style = theme.of(patch.level)
    if patch.words:
        return pad([Segment(f" {patch.condition}: {patch.words[0]}", style)], width, theme)
    if patch.depth_m is not None and not patch.trusted:
        return pad([Segment(f" not trusted: {patch.distrust}", theme.note)], width, theme)
    if not patch.precise:
        return pad([Segment(" not precise", theme.note)], width, theme)
    if patch.data_faults:
        return pad([Segment(f" left out: {patch.data_faults[0]}", theme.note)], width, theme)
    if width < 14 and patch.level == "good":
        return pad([Segment(f" {patch.rate_hz:.1f}/s", style)], width, theme)
    rate = [Segment(f"{patch.rate_hz:.1f}/s", theme.dim)] if width >= 18 else []
    return spread([Segment(f" {patch.condition}", style)], rate, width, theme)


def shear_text(shear_m: tuple[float, float]) -> str:
    """Format a shear in metres as an arrow and a magnitude; return an empty string below 1 µm."""
    size_um = 1e6 * float((shear_m[0] ** 2 + shear_m[1] ** 2) ** 0.5)
    return "" if size_um < 1.0 else f"{field_map.arrow(*shear_m)} {size_um:.0f} µm"


def alone(patch: PatchView, paint: Paint, width: int, height: int) -> list[Line]:
    """Draw one patch: depth map, shear map and all values."""
    theme, style = paint.theme, paint.map_style
    high = height - 2
    aspect = 1.0 if patch.surface is None else patch.surface.aspect
    wide = max(8, (width - 36) // 2)
    across, down, frame = _fit(wide, high, aspect)
    depth = _map(patch, paint, across + frame, down + frame, arrows=False)
    blocks = [
        (
            [
                _caption("depth", theme),
                *depth,
                field_map.legend(style, max(2, min(12, across - 8)), theme.text),
            ],
            across + frame + 2,
        )
    ]
    if patch.surface is not None and patch.condition not in GONE:
        shear = field_map.paint_shear(patch.surface, style, across, down)
        if frame:
            shear = outlined(shear, across, theme)
        caption = f"→ brightest {1e6 * style.full_shear_m:.0f} µm"
        blocks.append(([_caption("shear", theme), *shear, [Segment(caption, theme.dim)]], across + frame + 2))
    else:
        blocks.append(([_caption("shear", theme)], across + frame + 2))
    rest = width - sum(wide for _, wide in blocks) - 1
    margin: tuple[list[Line], int] = ([], 1)
    return [
        pad(line, width, theme)
        for line in beside([margin, *blocks, (facts(patch, theme, rest), rest)], height, theme)
    ]


def _caption(text: str, theme: Theme) -> Line:
    return [Segment(text, theme.dim)]


def facts(patch: PatchView, theme: Theme, width: int) -> list[Line]:
    """Return all values of a patch as lines, each with a name and a value."""
    health = patch.health
    lines = [
        spread(
            [
                Segment(f" {patch.name} ", theme.chosen),
                Segment(f" node {patch.node_id}, {patch.bus}", theme.dim),
            ],
            [Segment(f" {patch.condition} ", theme.of(patch.level))],
            width,
            theme,
        )
    ]

    def fact(name: str, text: str, style: Style = theme.text) -> None:
        for part in _wrapped(text, max(8, width - _LABEL - 1)):
            lines.append([Segment(f"{name:<{_LABEL}}", theme.dim), Segment(part, style)])
            name = ""

    for word in patch.words:
        fact("wrong", word, theme.of("bad" if patch.level == "bad" else "note"))
    for name, text, style in _field_facts(patch, theme):
        fact(name, text, style)
    for fault in patch.data_faults:
        fact("left out", str(fault), theme.note)
    fact("scans", f"{patch.rate_hz:.1f}/s, newest {patch.scan}" if patch.scan is not None else "none yet")
    if patch.latency_s is not None and patch.latency_max_s is not None:
        fact("latency", f"{1e3 * patch.latency_s:.1f} ms, worst {1e3 * patch.latency_max_s:.1f}")
    for name, text, style in _losses(patch, theme):
        fact(name, text, style)
    state = (
        "unknown" if health.nmt_state is None else STATE_NAMES.get(health.nmt_state, str(health.nmt_state))
    )
    age = "" if health.heartbeat_age_s is None else f", heard {_span(health.heartbeat_age_s)} ago"
    fact("NMT", f"{state}{age}")
    fact("boots", f"{health.boot_ups} heard, {health.rejoins} rejoins")
    last = f", last 0x{health.last_emergency:04X} {health.emergency_text}" if health.last_emergency else ""
    fact("EMCY", f"{health.emergencies}{last}", theme.note if health.emergencies else theme.text)
    wires = ", ".join(f"{fault.side} {fault.number} {fault.state}" for fault in health.wires)
    fact("wires", wires or "all well", theme.bad if wires else theme.good)
    if health.life:
        fact("converter", health.life, theme.note)
    return lines


def _field_facts(patch: PatchView, theme: Theme) -> list[tuple[str, str, Style]]:
    """Return the values of a patch's newest field as (name, text, style); empty if there is no field."""
    if patch.depth_m is None:
        return []
    std = "" if patch.depth_std_m is None else f" ± {1e6 * patch.depth_std_m:.1f}"
    trust = "trusted" if patch.trusted else "not trusted"
    precise = "precise" if patch.precise else "not precise"
    style = theme.text if patch.trusted and patch.precise else theme.note
    found = [
        ("deepest", f"{1e6 * patch.depth_m:.1f}{std} µm", theme.text),
        ("shear", shear_text(patch.shear_m) or "none", theme.text),
        ("field", f"{patch.method}, {trust}, {precise}", style),
    ]
    if patch.distrust:
        found.append(("because", patch.distrust, theme.note))
    if patch.data_share is not None:
        found.append(("data", f"{patch.data_share:.0%} of the depth comes from the data", theme.text))
    return found


def _losses(patch: PatchView, theme: Theme) -> list[tuple[str, str, Style]]:
    """Return a patch's losses since the start or, for a remote hand, the transit losses and delay."""
    stream, arrivals = patch.stream, patch.arrivals
    if stream is None:
        delay = "" if arrivals.transit_s is None else f", {1e3 * arrivals.transit_s:.1f} ms"
        transit = f"{counted(arrivals.lost or 0, 'field')} lost{delay}"
        style = theme.note if arrivals.lost else theme.good
        return [("transit", transit, style), ("losses", "not available", theme.dim)]
    counts = stream.assembler
    lost = {
        "scans torn": counts.scans_torn,
        "scans corrupt": counts.scans_corrupt,
        "scans missed": counts.scans_missed,
        "scans skipped": stream.skipped,
        "scans withheld": stream.withheld + stream.partial,
        "chunks lost": counts.chunks_lost,
    }
    losses = ", ".join(f"{count} {what}" for what, count in lost.items() if count)
    return [("losses", losses or "none", theme.note if losses else theme.good)]


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width) or [""]


def _span(seconds: float) -> str:
    """Format a duration in a suitable unit."""
    if seconds < 1.0:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200.0 else f"{seconds / 3600:.0f} h"
