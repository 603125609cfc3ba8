"""A patch as lines of text: as a tile among others, or alone with all that is known of it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Final

from rich.segment import Segment
from rich.style import Style

from skinnode.canopen.nmt import STATE_NAMES
from skinnode.monitor import maps
from skinnode.monitor.look import Look, Ui, beside, centred, pad, spread
from skinnode.monitor.maps import Line
from skinnode.monitor.state import PatchView

GONE: Final = ("lost", "never seen", "stale", "refused", "restarting", "booting", "starting")
"""Conditions in which the newest field is an old one."""
_AROUND: Final = 3
"""Lines of a tile beside its map."""
_LEAST_OUTLINED: Final = (8, 5)
"""Minimum size of a box, in characters and lines, for a map with an outline."""
_LABEL: Final = 10
"""Width of the names of figures beside a patch alone."""


def tiles(
    patches: Sequence[PatchView], ui: Ui, full_m: float, look: Look, width: int, height: int
) -> list[Line]:
    """All patches, in as many columns as make the maps largest; at most ``height`` lines."""
    count = len(patches)
    aspect = max((patch.surface.aspect for patch in patches if patch.surface is not None), default=1.0)

    def high_of(columns: int) -> int:
        """Lines of a map in one of so many columns."""
        box = width // columns - 1, height // -(-count // columns) - _AROUND
        across, down, frame = _fit(*box, aspect) if min(box) > 0 else (0, 0, 0)
        return down + frame if across else 0

    columns = max(range(1, count + 1), key=high_of)
    wide, high = width // columns, max(1, high_of(columns)) + _AROUND
    lines: list[Line] = []
    for first in range(0, count, columns):
        row = [
            (_tile(first + number, patch, ui, full_m, look, wide - 1, high), wide)
            for number, patch in enumerate(patches[first : first + columns], 1)
        ]
        lines += [pad(line, width, look) for line in beside(row, high, look)]
    return lines[:height]


def _tile(
    number: int, patch: PatchView, ui: Ui, full_m: float, look: Look, width: int, height: int
) -> list[Line]:
    chosen = look.chosen if patch.name == ui.selected else look.strong
    forces = [touch.force_n for touch in patch.touches if touch.force_n is not None]
    force = [Segment(f"{sum(forces):.2f} N ", look.text)] if forces and patch.condition not in GONE else []
    name = f" {number} {patch.name} " if width >= 12 else patch.name
    title = spread([Segment(name, chosen)], force if width >= 16 else [], width, look)
    body = _map(patch, ui, full_m, look, width, height - _AROUND, arrows=ui.arrows)
    return [title, *body, _figures(patch, look, width), _health(patch, look, width)]


def _map(
    patch: PatchView, ui: Ui, full_m: float, look: Look, width: int, height: int, *, arrows: bool
) -> list[Line]:
    """Draw the height map centred in its box. It has an outline because untouched skin is as dark as the
    screen. The last map of a patch that is gone has no colours and shows the condition across it, so that
    nobody takes it for live data."""
    if patch.surface is None:
        blank = [pad([], width, look) for _ in range(height)]
        blank[height // 2] = centred([Segment("no field", look.dim)], width, look)
        return blank
    across, down, frame = _fit(width, height, patch.surface.aspect)
    gone = patch.condition in GONE
    lines = maps.paint_map(
        patch.surface,
        across,
        down,
        full_m,
        "none" if gone else look.colours,
        arrows=arrows and not gone and down > 3,
    )
    if gone:
        lines = [[Segment(segment.text, look.dim) for segment in line] for line in lines]
        age_s = patch.health.scan_age_s
        told = [f" {patch.condition} ", *([f" for {_span(age_s)} "] if age_s is not None else [])]
        for row, text in enumerate(told, max(0, down // 2 - 1)):
            if row < down:
                lines[row] = centred([Segment(text[:across], look.alarm)], across, look)
    if frame:
        lines = outlined(lines, across, look)
    lines = [centred(line, width, look) for line in lines]
    return lines + [pad([], width, look) for _ in range(height - len(lines))]


def _fit(width: int, height: int, aspect: float) -> tuple[int, int, int]:
    """Return the size of the largest map of this shape in a box, and the characters that the outline takes on
    each side: none in a small box."""
    frame = 2 if width >= _LEAST_OUTLINED[0] and height >= _LEAST_OUTLINED[1] else 0
    return (*maps.fit(width - frame, height - frame, aspect), frame)


def outlined(lines: Sequence[Line], across: int, look: Look) -> list[Line]:
    """Draw an outline around the lines of a map that is ``across`` characters wide."""
    side = Segment("│", look.dim)
    return [
        [Segment(f"┌{'─' * across}┐", look.dim)],
        *([side, *line, side] for line in lines),
        [Segment(f"└{'─' * across}┘", look.dim)],
    ]


def _figures(patch: PatchView, look: Look, width: int) -> Line:
    """How deep, and how far along the skin."""
    if patch.depth_m is None or patch.condition in GONE:
        return pad([], width, look)
    line = [Segment(f" {1e6 * patch.depth_m:.0f}", look.text)]
    if patch.depth_std_m is not None and width >= 18:
        line.append(Segment(f" ± {1e6 * patch.depth_std_m:.1f}", look.dim))
    line.append(Segment(" µm", look.dim))
    shear = _shear(patch.shear_m)
    return spread(line, [Segment(f"{shear} ", look.text)] if width >= 20 else [], width, look)


def _health(patch: PatchView, look: Look, width: int) -> Line:
    """The condition with what is wrong, or else the rate."""
    style = look.of(patch.level)
    if patch.words:
        return pad([Segment(f" {patch.condition}: {patch.words[0]}", style)], width, look)
    if patch.depth_m is not None and not patch.trusted:
        return pad([Segment(" not trusted", look.note)], width, look)
    if width < 14 and patch.level == "good":
        return pad([Segment(f" {patch.rate_hz:.1f}/s", style)], width, look)
    rate = [Segment(f"{patch.rate_hz:.1f}/s", look.dim)] if width >= 18 else []
    return spread([Segment(f" {patch.condition}", style)], rate, width, look)


def _shear(shear_m: tuple[float, float]) -> str:
    """Arrow and size; nothing below a micrometre."""
    size_um = 1e6 * float((shear_m[0] ** 2 + shear_m[1] ** 2) ** 0.5)
    return "" if size_um < 1.0 else f"{maps.arrow(*shear_m)} {size_um:.0f} µm"


def alone(patch: PatchView, ui: Ui, full_m: float, look: Look, width: int, height: int) -> list[Line]:
    """One patch: depth, shear, and everything that is known of it."""
    high = height - 2
    aspect = 1.0 if patch.surface is None else patch.surface.aspect
    wide = max(8, (width - 36) // 2)
    across, down, frame = _fit(wide, high, aspect)
    depth = _map(patch, ui, full_m, look, across + frame, down + frame, arrows=False)
    blocks = [
        (
            [
                _caption("depth", look),
                *depth,
                maps.legend(full_m, max(2, min(12, across - 8)), look.colours, look.text),
            ],
            across + frame + 2,
        )
    ]
    if patch.surface is not None and patch.condition not in GONE:
        shear = maps.paint_shear(patch.surface, across, down, full_m, look.colours)
        if frame:
            shear = outlined(shear, across, look)
        said = f"→ brightest {1e6 * maps.shear_scale_m(full_m):.0f} µm"
        blocks.append(([_caption("shear", look), *shear, [Segment(said, look.dim)]], across + frame + 2))
    else:
        blocks.append(([_caption("shear", look)], across + frame + 2))
    rest = width - sum(wide for _, wide in blocks) - 1
    margin: tuple[list[Line], int] = ([], 1)
    return [
        pad(line, width, look)
        for line in beside([margin, *blocks, (facts(patch, look, rest), rest)], height, look)
    ]


def _caption(text: str, look: Look) -> Line:
    return [Segment(text, look.dim)]


def facts(patch: PatchView, look: Look, width: int) -> list[Line]:
    """All figures of a patch, a name and a value a line."""
    health, stream = patch.health, patch.stream
    counts = stream.assembler
    lines = [
        spread(
            [
                Segment(f" {patch.name} ", look.chosen),
                Segment(f" node {patch.node_id}, {patch.bus}", look.dim),
            ],
            [Segment(f" {patch.condition} ", look.of(patch.level))],
            width,
            look,
        )
    ]

    def fact(name: str, text: str, style: Style = look.text) -> None:
        for part in _wrapped(text, max(8, width - _LABEL - 1)):
            lines.append([Segment(f"{name:<{_LABEL}}", look.dim), Segment(part, style)])
            name = ""

    for word in patch.words:
        fact("wrong", word, look.of("bad" if patch.level == "bad" else "note"))
    if patch.depth_m is not None:
        std = "" if patch.depth_std_m is None else f" ± {1e6 * patch.depth_std_m:.1f}"
        fact("deepest", f"{1e6 * patch.depth_m:.1f}{std} µm")
        fact("shear", _shear(patch.shear_m) or "none")
        trust = "trusted" if patch.trusted else "not trusted"
        fact("field", f"{patch.method}, {trust}", look.text if patch.trusted else look.note)
    fact("scans", f"{patch.rate_hz:.1f}/s, newest {patch.scan}" if patch.scan is not None else "none yet")
    if patch.latency_s is not None and patch.latency_max_s is not None:
        fact("latency", f"{1e3 * patch.latency_s:.1f} ms, worst {1e3 * patch.latency_max_s:.1f}")
    lost = {
        "scans torn": counts.scans_torn,
        "scans corrupt": counts.scans_corrupt,
        "scans missed": counts.scans_missed,
        "scans skipped": stream.skipped,
        "scans withheld": stream.withheld + stream.partial,
        "chunks lost": counts.chunks_lost,
    }
    losses = ", ".join(f"{count} {what}" for what, count in lost.items() if count)
    fact("losses", losses or "none", look.note if losses else look.good)
    state = (
        "unknown" if health.nmt_state is None else STATE_NAMES.get(health.nmt_state, str(health.nmt_state))
    )
    age = "" if health.heartbeat_age_s is None else f", heard {_span(health.heartbeat_age_s)} ago"
    fact("NMT", f"{state}{age}")
    fact("boots", f"{health.boot_ups} heard, {health.rejoins} rejoins")
    last = f", last 0x{health.last_emergency:04X} {health.emergency_text}" if health.last_emergency else ""
    fact("EMCY", f"{health.emergencies}{last}", look.note if health.emergencies else look.text)
    wires = ", ".join(f"{fault.side} {fault.number} {fault.state}" for fault in health.wires)
    fact("wires", wires or "all well", look.bad if wires else look.good)
    return lines


def _wrapped(text: str, width: int) -> list[str]:

    return textwrap.wrap(text, width) or [""]


def _span(seconds: float) -> str:
    """A time for people."""
    if seconds < 1.0:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200.0 else f"{seconds / 3600:.0f} h"
