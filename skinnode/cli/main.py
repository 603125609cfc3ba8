"""Entry point of ``skinnode``.

This module imports only modules that load fast, so that signal handlers are installed first. The subcommands
are in :mod:`skinnode.cli._app`, the exit statuses in :mod:`skinnode.cli._exit_status`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from skinnode.cli._exit_status import main_of


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run ``skinnode`` with ``argv``, or with the arguments of the process."""
    main_of("skinnode.cli._app", argv)


def __getattr__(name: str) -> Any:
    """Import ``app``, the typer application, on first access."""
    if name == "app":
        from skinnode.cli._app import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
