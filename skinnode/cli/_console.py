"""How the technician's commands talk: tables and text on stdout, progress on stderr if a person looks on."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def print_json(value: Any) -> None:
    """One JSON document."""
    from skinnode.cli._files import plain

    typer.echo(json.dumps(plain(value), indent=2))


def console() -> Console:
    """For tables. Not in a terminal: as wide as a terminal of 80 columns would have them."""
    from rich.console import Console

    return Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=80)


def table(*columns: str, right: tuple[str, ...] = ()) -> Table:
    """An empty table without much ink; ``right``: columns of numbers."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return made


@contextmanager
def progress(quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Tell what is being done, on one line of stderr that is gone in the end; nothing where nobody looks."""
    if quiet or not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console

    with Console(stderr=True).status("") as status:
        yield lambda text: status.update(text)
