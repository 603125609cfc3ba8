"""Entry point of ``vcan-sim``.

:mod:`vcan_sim.commands` defines the commands, and :mod:`skinnode.cli._exit_status` the exit statuses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from skinnode.cli._exit_status import main_of


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run ``vcan-sim`` with ``argv``; default: the arguments of the process."""
    main_of("vcan_sim.commands._app", argv)


def __getattr__(name: str) -> Any:
    """Import the typer application ``app`` on first access."""
    if name == "app":
        from vcan_sim.commands._app import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
