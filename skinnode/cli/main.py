"""Entry point of ``skinnode``, kept small so that signal handlers are installed before anything slow is
imported. The subcommands are in :mod:`skinnode.cli._app`, exit statuses in :mod:`skinnode.cli._ending`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from skinnode.cli._ending import main_of


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run ``skinnode`` with these arguments, or those of the process."""
    main_of("skinnode.cli._app", argv)


def __getattr__(name: str) -> Any:
    """Provide ``app``, the typer application."""
    if name == "app":
        from skinnode.cli._app import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
