"""Defines screen styles and the state of the user interface, and lays out styled text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style

from skinnode.monitor.field_map import Colours, Line, MapStyle
from skinnode.monitor.source import Recording
from skinnode.monitor.view_model import Level
from skinnode.text.printable import printable


@dataclass(frozen=True, slots=True)
class Theme:
    """Text styles for a terminal with the given colours."""

    colours: Colours
    text: Style
    dim: Style
    strong: Style
    bar: Style
    """Style of the header and the key bar."""
    key: Style
    good: Style
    note: Style
    bad: Style
    chosen: Style
    alarm: Style
    """Style of the labels that mark a recording, a pause or a lost patch."""
    gauge: Style

    def of(self, level: Level) -> Style:
        """Return the style for a severity."""
        return {"good": self.good, "note": self.note, "bad": self.bad}[level]


def theme_for(colours: Colours) -> Theme:
    """Return the theme for a terminal with the given colours."""
    if colours == "none":
        plain, bold = Style(), Style(bold=True)
        back = Style(reverse=True)
        return Theme(
            colours, plain, Style(dim=True), bold, back, back, plain, bold, back, back, back, Style()
        )
    if colours == "ansi":
        return Theme(
            colours,
            text=Style(),
            dim=Style(color="bright_black"),
            strong=Style(bold=True),
            bar=Style(color="black", bgcolor="cyan"),
            key=Style(color="black", bgcolor="cyan", bold=True),
            good=Style(color="green"),
            note=Style(color="yellow"),
            bad=Style(color="bright_red", bold=True),
            chosen=Style(reverse=True, bold=True),
            alarm=Style(color="bright_white", bgcolor="red", bold=True),
            gauge=Style(color="cyan"),
        )
    paper, ink = "#11131a", "#c9cedb"
    return Theme(
        colours,
        text=Style.parse(f"{ink} on {paper}"),
        dim=Style.parse(f"#7a8296 on {paper}"),
        strong=Style.parse(f"bold #ffffff on {paper}"),
        bar=Style.parse("#c9cedb on #232838"),
        key=Style.parse("bold #8cf5e1 on #232838"),
        good=Style.parse(f"#6fd08c on {paper}"),
        note=Style.parse(f"#ffc857 on {paper}"),
        bad=Style.parse(f"bold #ff6b6b on {paper}"),
        chosen=Style.parse("bold #11131a on #8cf5e1"),
        alarm=Style.parse("bold #ffffff on #c0392b"),
        gauge=Style.parse("#8cf5e1 on #2d3346"),
    )


@dataclass(frozen=True, slots=True)
class UiState:
    """State of the user interface: the user's selections and the message in the key bar."""

    title: str
    selected: str
    elapsed_s: float = 0.0
    zoomed: bool = False
    paused: bool = False
    arrows: bool = True
    over: bool = False
    """Whether the recording has ended."""
    commands: bool = True
    """Whether patches can be tared and reset."""
    recordable: bool = True
    recording: Recording | None = None
    message: str = ""
    message_level: Level = "good"


@dataclass(frozen=True, slots=True)
class Paint:
    """Parameters used to draw every part of the screen."""

    theme: Theme
    ui: UiState
    full_m: float
    """Depth drawn at full brightness, in metres."""

    @property
    def map_style(self) -> MapStyle:
        """Style of the maps."""
        return MapStyle(self.full_m, self.theme.colours)


def pad(line: Line, width: int, theme: Theme, style: Style | None = None) -> Line:
    """Return ``line`` truncated or padded to ``width`` characters."""
    made, left = [], width
    for segment in line:
        if left <= 0:
            break
        whole = segment.text if segment.text.isprintable() else printable(segment.text)
        length = cell_len(whole)
        text = whole if length <= left else set_cell_size(whole[: left - 1] + "…", left)
        made.append(Segment(text, segment.style))
        left -= min(length, left)
    if left > 0:
        made.append(Segment(" " * left, style or theme.text))
    return made


def width_of(line: Line) -> int:
    """Return the width of a line in characters."""
    return sum(cell_len(segment.text) for segment in line)


def spread(left: Line, right: Line, width: int, theme: Theme, style: Style | None = None) -> Line:
    """Join ``left`` and the right-aligned ``right`` into one line, truncating ``left`` if they do not fit."""
    room = max(0, width - width_of(right))
    return pad([*pad(left, room, theme, style), *right], width, theme, style)


def beside(blocks: Sequence[tuple[list[Line], int]], height: int, theme: Theme) -> list[Line]:
    """Place blocks of lines side by side. Each block is paired with its width."""
    return [
        [
            segment
            for lines, width in blocks
            for segment in pad(lines[row] if row < len(lines) else [], width, theme)
        ]
        for row in range(height)
    ]


def centred(line: Line, width: int, theme: Theme) -> Line:
    """Centre ``line`` within ``width`` characters."""
    left = max(0, width - width_of(line)) // 2
    return pad([Segment(" " * left, theme.text), *line], width, theme)
