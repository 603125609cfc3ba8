"""Renders the whole screen at any size: header, buses, patches, touches, event log, keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rich.segment import Segment

from skinnode.monitor import field_map
from skinnode.monitor.field_map import Line
from skinnode.monitor.patch_panel import GONE, alone, facts, tiles
from skinnode.monitor.theme import Paint, Theme, UiState, beside, pad, spread, width_of
from skinnode.monitor.touches import Touch
from skinnode.monitor.view_model import BusView, LogLine, PatchView, View
from skinnode.text.words import counted

LEAST_WIDTH: Final = 50
LEAST_HEIGHT: Final = 16
"""Minimum size of the terminal, in characters; a smaller terminal shows only the required size."""


def screen(view: View, paint: Paint, log: Sequence[LogLine], width: int, height: int) -> list[Line]:
    """Render the screen as ``height`` lines of ``width`` characters; ``log`` ends with the newest event."""
    theme, ui = paint.theme, paint.ui
    if width < LEAST_WIDTH or height < LEAST_HEIGHT:
        text = f"{width} × {height} is too small: at least {LEAST_WIDTH} × {LEAST_HEIGHT}"
        return [pad([Segment(text[:width], theme.text)], width, theme)] + [
            pad([], width, theme) for _ in range(height - 1)
        ]
    worst_first = sorted(view.buses, key=lambda bus: ("bad", "note", "good").index(bus.level))
    shown = view.buses if len(view.buses) <= height // 6 else worst_first[: height // 6]
    buses = [_bus_line(bus, _losses(view, bus), theme, width) for bus in shown]
    upper = height - 2 - len(buses) - (8 if height < 28 else 12)
    if ui.zoomed:
        patch = view.patch(ui.selected)
        middle = alone(patch, paint, width, upper)
        log = [line for line in log if line.subject in (patch.name, patch.bus, "")]
    else:
        middle = tiles(view.patches, paint, width, upper)
    lower = height - 2 - len(buses) - len(middle)
    return [
        _header(view, ui, theme, width),
        *buses,
        *middle,
        *_lower(view, paint, log, width, lower),
        _keys(ui, theme, width),
    ]


def _header(view: View, ui: UiState, theme: Theme, width: int) -> Line:
    bar = theme.bar
    seconds = int(ui.elapsed_s)
    left = [
        Segment(" ", bar),
        Segment(ui.title if len(ui.title) < 25 else f"{ui.title[:23]}…", theme.key),
        Segment(f"  {seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}", bar),
    ]
    wrong = sum(patch.level == "bad" for patch in view.patches) + sum(
        bus.level == "bad" for bus in view.buses
    )
    if wrong:
        left += [Segment("  ", bar), Segment(f" {wrong} {'fault' if wrong == 1 else 'faults'} ", theme.alarm)]
    if ui.paused:
        left += [Segment("  ", bar), Segment(" PAUSED ", theme.alarm)]
    if view.away is not None:
        left += [Segment("  ", bar), Segment(" DAEMON AWAY ", theme.alarm)]
    if ui.over:
        left += [Segment("  ", bar), Segment(" END OF RECORDING ", theme.alarm)]
    if ui.recording is not None:
        frames = f" ● REC {ui.recording.frames} frames "
        left += [Segment("  ", bar), Segment(frames, theme.alarm)]
    rates = f"{view.scans_hz:.1f} scans/s  "
    if width >= 100:
        rates += f"{view.fields_hz:.0f} fields/s  "
    if view.latency_s is not None and view.latency_max_s is not None:
        rates += f"latency {1e3 * view.latency_s:.1f} ms, worst {1e3 * view.latency_max_s:.1f} "
    return spread(left, [Segment(rates, bar)], width, theme, bar)


def _losses(view: View, bus: BusView) -> str:
    """Describe the chunks, summaries and scans lost on a bus; return an empty string if none were lost."""
    streams = [patch.stream for patch in view.patches if patch.bus == bus.name]
    counts = [stream.assembler for stream in streams if stream is not None]
    for name, one, several in (
        ("chunks_lost", "chunk lost", "chunks lost"),
        ("summaries_lost", "summary lost", "summaries lost"),
        ("scans_torn", "scan torn", "scans torn"),
        ("scans_missed", "scan missed", "scans missed"),
        ("scans_mixed", "scan mixed", "scans mixed"),
    ):
        if total := sum(getattr(count, name) for count in counts):
            return counted(total, one, several)
    return ""


def _bus_line(bus: BusView, losses: str, theme: Theme, width: int) -> Line:
    words = [*bus.words, losses] if losses else list(bus.words)
    style = theme.note if losses and bus.level == "good" else theme.of(bus.level)
    well = "no fault reported" if bus.frames_hz is None else "nothing lost"
    line = [
        Segment(f" {bus.name:<6.12}", theme.strong),
        *_load_and_rate(bus, theme, 12 if width < 110 else 24),
        Segment("; ".join(words) or well, style),
    ]
    where = [Segment(f"  {bus.where} ({bus.role}) ", theme.dim)]
    if width_of(line) + width_of(where) > width:
        return pad(line, width, theme)
    return spread(line, where, width, theme)


def _load_and_rate(bus: BusView, theme: Theme, cells: int) -> Line:
    if bus.load is None:
        return [Segment("load and frames/s not available  ", theme.dim)]
    full = min(cells, round(bus.load * cells))
    style = theme.bad if bus.load > 0.9 else theme.note if bus.load > 0.7 else theme.gauge
    line = [
        Segment("load ", theme.dim),
        Segment("█" * full, style),
        Segment("·" * (cells - full), theme.dim),
        Segment(f"{100 * bus.load:4.0f} %  ", theme.text),
    ]
    if bus.frames_hz is None:
        return [*line, Segment("frames/s not available  ", theme.dim)]
    return [*line, Segment(f"{bus.frames_hz:5.0f}", theme.text), Segment(" frames/s  ", theme.dim)]


def _keys(ui: UiState, theme: Theme, width: int) -> Line:
    if ui.message:
        style = theme.alarm if ui.message_level == "bad" else theme.key
        return pad([Segment(f" {ui.message} ", style)], width, theme, theme.bar)
    keys = [("1-9", "patch"), ("z", "back" if ui.zoomed else "zoom")]
    if ui.commands:
        keys += [("t", "tare"), *([("n", "reset")] if width >= 100 else [])]
    if ui.recordable:
        keys += [("r", "stop recording" if ui.recording else "record")]
    keys += [("space", "continue" if ui.paused else "pause"), ("a", "arrows"), ("?", "help"), ("q", "quit")]
    line = [Segment(" ", theme.bar)]
    for key, what in keys:
        line += [Segment(key, theme.key), Segment(f" {what}  ", theme.bar)]
    return pad(line, width, theme, theme.bar)


# --- touches and log


def _lower(view: View, paint: Paint, log: Sequence[LogLine], width: int, height: int) -> list[Line]:
    """Draw touches above events or, on a wide screen, touches and the selected patch beside events."""
    theme, ui = paint.theme, paint.ui
    chosen = view.patch(ui.selected)
    patches = (chosen,) if ui.zoomed else view.patches
    scale = [] if ui.zoomed else field_map.legend(paint.map_style, 10, theme.text)
    if width >= 130:
        left = min(80, width // 2)
        figures = [] if ui.zoomed else [[], *facts(chosen, theme, left - 2)]
        share = height - len(figures) if height - len(figures) >= 7 else height
        below = [[Segment(" ", theme.text), *line] for line in figures[: height - share]]
        lines = [*_touches(patches, scale, theme, left - 2, share), *below]
        blocks = [(lines, left), (_log(log, _quiet(view), theme, width - left, height), width - left)]
        return beside(blocks, height, theme)
    share = min(4, max(2, height // 2))
    lines = [
        *_touches(patches, scale, theme, width, share),
        *_log(log, _quiet(view), theme, width, height - share),
    ]
    return [pad(line, width, theme) for line in lines]


def _rule(title: str, tail: Line, theme: Theme, width: int) -> Line:
    left = [Segment("─ ", theme.dim), Segment(title, theme.dim), Segment(" ", theme.dim)]
    dashes = max(0, width - width_of(left) - width_of(tail) - 1)
    return pad(
        [*left, Segment("─" * dashes, theme.dim), Segment(" " if tail else "", theme.text), *tail],
        width,
        theme,
    )


def _touches(patches: Sequence[PatchView], scale: Line, theme: Theme, width: int, height: int) -> list[Line]:
    rows = [(patch, touch) for patch in patches if patch.condition not in GONE for touch in patch.touches]
    rows.sort(key=lambda row: -(row[1].force_n or 1e3 * row[1].depth_m))
    hidden = len(rows) - (height - 1)
    title = "touches" + (f" ({hidden} more)" if hidden > 0 else "")
    lines = [_rule(title, scale, theme, width)]
    name = min(14, max((len(patch.name) for patch in patches), default=0))
    lines += [
        pad(_touch_line(patch, touch, theme, name), width, theme) for patch, touch in rows[: height - 1]
    ]
    if not rows:
        known = any(patch.depth_m is not None and patch.condition not in GONE for patch in patches)
        lines.append([Segment(" nothing touches" if known else " nothing known", theme.dim)])
    return [*lines, *([[]] * (height - len(lines)))]


def _touch_line(patch: PatchView, touch: Touch, theme: Theme, name: int) -> Line:
    if touch.force_n is None:
        force = [Segment("force not known ", theme.dim)]
    else:
        std = "" if touch.force_std_n is None else f" ± {touch.force_std_n:.2f}"
        force = [Segment(f"{touch.force_n:6.2f}{std} N  ", theme.strong)]
    line = [Segment(f" {patch.name:<{name}.{name}} ", theme.text), *force]
    if touch.shear_n is not None:
        size = float((touch.shear_n[0] ** 2 + touch.shear_n[1] ** 2) ** 0.5)
        sign = field_map.arrow(*touch.shear_n) if size >= 0.005 else "·"
        line.append(Segment(f"{sign} {size:4.2f} N  ", theme.text))
    return [
        *line,
        Segment(f"x {1e3 * touch.x_m:5.1f}  y {1e3 * touch.y_m:5.1f} mm  ", theme.text),
        Segment(f"{1e6 * touch.area_m2:4.0f} mm²  {1e6 * touch.depth_m:4.0f} µm", theme.dim),
    ]


def _quiet(view: View) -> str:
    """Return the text for an empty event log, including any faults that occurred before the log began."""
    wrong = [f"{patch.name} {patch.condition}" for patch in view.patches if patch.level == "bad"]
    wrong += [bus.name for bus in view.buses if bus.level == "bad"]
    if wrong:
        return f" no events yet; earlier faults: {', '.join(wrong)}"
    known = all(patch.stream is not None for patch in view.patches)
    lost = any(_losses(view, bus) for bus in view.buses)
    return " nothing happened" if known and not lost else " no event"


def _log(log: Sequence[LogLine], quiet: str, theme: Theme, width: int, height: int) -> list[Line]:
    lines = [_rule("events", [], theme, width)]
    shown = log[-(height - 1) :] if height > 1 else []
    for line in shown:
        subject = f"{line.subject} " if line.subject else ""
        lines.append(
            [
                Segment(f" {line.time} ", theme.dim),
                Segment(subject, theme.strong),
                Segment(line.text, theme.of(line.level) if line.level != "good" else theme.text),
            ]
        )
    if not shown:
        lines.append([Segment(quiet, theme.dim)])
    return [*lines, *([[]] * (height - len(lines)))]
