"""Prints the output of commands: tables and text on stdout, progress on stderr if stderr is a terminal."""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TextIO

import typer

from skinnode.text.printable import printable_lines

if TYPE_CHECKING:
    from rich.console import Console
    from rich.padding import Padding
    from rich.table import Table

UNBOUNDED: Final = 10_000
"""Console width in columns for output to a pipe or file; large enough that no line is wrapped."""


def print_json(value: Any) -> None:
    """Print ``value`` as one JSON document."""
    from skinnode.text.json_values import plain

    typer.echo(json.dumps(plain(value), indent=2))


def console(*, stderr: bool = False, soft_wrap: bool = False) -> Console:
    """Return the console that all commands use.

    Square brackets and colons are printed literally, because names may contain them; styles are arguments of
    ``print``. The console is as wide as the terminal. Output to a pipe or file is not wrapped unless
    ``COLUMNS`` sets a width, so that programs can read whole lines.

    Args:
        stderr: Print to stderr instead of stdout.
        soft_wrap: Let the terminal wrap lines.
    """
    return _console_type()(
        stderr=stderr,
        soft_wrap=soft_wrap,
        highlight=False,
        markup=False,
        emoji=False,
        width=_width(sys.stderr if stderr else sys.stdout),
    )


def _width(stream: TextIO) -> int | None:
    if stream.isatty() or os.environ.get("COLUMNS", "").isdigit():
        return None  # rich queries the terminal
    return UNBOUNDED


@functools.cache
def _console_type() -> type[Console]:
    """Define the console class on the first call, so that ``--help`` need not import rich."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.text import Text

    class PrintableConsole(Console):
        """Console that escapes control characters; see :mod:`skinnode.text.printable`."""

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(printable_lines(text), **options)

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterator[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable_lines(text), style, control)

    return PrintableConsole


def table(*columns: str, right: tuple[str, ...] = ()) -> Table:
    """Create an empty table with a rule below the header; ``right`` lists the right-aligned columns."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return made


def indented(text: str, columns: int = 10) -> Padding:
    """Return ``text`` with each line indented by ``columns``."""
    from rich.padding import Padding

    return Padding(text, (0, 0, 0, columns), expand=False)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the current step on one line of stderr, which is erased at the end.

    Nothing is shown if ``quiet`` is set or stderr is not a terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda text: None
        return
    with console(stderr=True).status("") as status:
        yield lambda text: status.update(text)
