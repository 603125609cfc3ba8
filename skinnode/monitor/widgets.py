"""Provides screen widgets: a canvas that redraws only changed lines, and a dialog."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType
from textual.events import Key
from textual.geometry import Region
from textual.screen import ModalScreen
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import Static

from skinnode.monitor.field_map import Line

Painter = Callable[[int, int], list[Line]]
"""Function that returns the lines to draw, given the width and height of the canvas."""


class Canvas(Widget):
    """Canvas that draws a painter's lines and sends only changed lines to the terminal.

    Textual's own widgets would redraw the whole canvas on each update.
    """

    DEFAULT_CSS = "Canvas { width: 1fr; height: 1fr; }"

    def __init__(self) -> None:
        super().__init__()
        self._painter: Painter = lambda width, height: []
        self._strips: list[Strip] = []

    def show(self, painter: Painter) -> None:
        """Replace the painter and redraw the canvas."""
        self._painter = painter
        self._paint()

    @property
    def text(self) -> str:
        """Text on the canvas, without styles."""
        return "\n".join(strip.text for strip in self._strips)

    def on_resize(self) -> None:
        """Redraw everything at the new size."""
        self._strips = []
        self._paint()

    def render_line(self, y: int) -> Strip:
        """Return line ``y`` for Textual to draw."""
        return self._strips[y] if y < len(self._strips) else Strip.blank(self.size.width)

    def _paint(self) -> None:
        width, height = self.size
        if not width or not height:
            return
        before = self._strips
        self._strips = [Strip(line, width) for line in self._painter(width, height)]
        changed = [
            Region(0, y, width, 1)
            for y, strip in enumerate(self._strips)
            if y >= len(before) or strip != before[y]
        ]
        if changed:
            self.refresh(*changed)


class Dialog(ModalScreen[bool]):
    """Text in a box. ``enter`` or ``y`` answers a question with True; any other key answers it with False."""

    CSS = """
    Dialog { align: center middle; background: $background 40%; }
    Dialog Static {
        width: auto; max-width: 76; height: auto; padding: 1 2; border: round #8cf5e1;
        background: #232838; color: #c9cedb;
    }
    Dialog:ansi Static { border: round ansi_cyan; background: ansi_default; color: ansi_default; }
    """
    AUTO_FOCUS = None
    BINDINGS: ClassVar[list[BindingType]] = []

    def __init__(self, text: str, *, question: bool) -> None:
        super().__init__()
        self._text, self._question = text, question
        self._answered = False

    @property
    def text(self) -> str:
        """Text in the box."""
        return self._text

    def compose(self) -> ComposeResult:
        """Yield the text."""
        yield Static(self._text, markup=False)

    def on_key(self, event: Key) -> None:
        """Close the box and return the answer."""
        event.stop()
        if not self._answered:  # more keys may arrive while the box is closing
            self._answered = True
            self.dismiss(self._question and event.key in ("y", "enter"))
