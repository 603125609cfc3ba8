"""Formats command help: reflows docstrings, and omits the type next to options that take no value.

Typer keeps a docstring's line breaks, which then fall in the middle of terminal lines. Typer also prints
``<bool>`` next to each option that takes no value.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

_F = TypeVar("_F", bound=Callable[..., Any])


def running_text(help_text: str | None) -> str | None:
    """Return a help text with each paragraph on a single line; each list item remains on its own line."""
    if help_text is None:
        return None
    return re.sub(r"(?<!\n)\n(?!\n|\s*[-*] )", " ", inspect.cleandoc(help_text))


def _without_types_of_flags(parameters: list[Any]) -> list[Any]:
    for parameter in parameters:
        if getattr(parameter, "is_bool_flag", False) or "--help" in parameter.opts:
            parameter.metavar = ""
    return parameters


class Command(TyperCommand):
    """Command whose help is formatted as described in the module docstring."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **{**options, "help": running_text(options.get("help"))})

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters and the help option."""
        return _without_types_of_flags(super().get_params(ctx))


class Group(TyperGroup):
    """Command group whose help is formatted as described in the module docstring."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters and the help option."""
        return _without_types_of_flags(super().get_params(ctx))


class App(typer.Typer):
    """Typer application whose help is formatted as described in the module docstring."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"cls": Group, **options})

    def command(self, name: str | None = None, **options: Any) -> Callable[[_F], _F]:
        """Register a function as a command, like :meth:`typer.Typer.command`."""
        return super().command(name, **{"cls": Command, **options})
