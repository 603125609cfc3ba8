"""Entry point of ``vcan-sim``.

The commands are defined in :mod:`vcan_sim.commands`, the exit statuses in :mod:`skinnode.cli._exit_status`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from skinnode.cli._exit_status import main_of


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run ``vcan-sim`` with ``argv``, or with the process's arguments if ``argv`` is None."""
    main_of("vcan_sim.commands._app", argv)


def __getattr__(name: str) -> Any:
    """Import the typer application ``app`` on first access."""
    if name == "app":
        from vcan_sim.commands._app import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
