"""Generates the command reference from the Typer applications."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import markdown_text as md
from typer.main import get_command

from skinnode.cli.main import app as skinnode
from vcan_sim.cli import app as vcan_sim


def commands() -> str:
    """Return a Markdown section for each command."""
    programs = {"skinnode": get_command(skinnode), "vcan-sim": get_command(vcan_sim)}
    return "\n\n".join(text for name, command in programs.items() for text in _sections(name, command))


def _sections(name: str, command: Any) -> Iterator[str]:
    if hasattr(command, "commands"):
        for word, inner in command.commands.items():
            yield from _sections(f"{name} {word}", inner)
        return
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and not p.hidden]
    words = " ".join([name, *map(_metavar, arguments), *(["[OPTIONS]"] if options else [])])
    rows = [(md.code(_metavar(p)), md.prose(p.help or "")) for p in arguments]
    rows += [(_spelling(p), md.prose(p.help or "") + _default(p)) for p in options]
    text = "\n\n".join(md.prose(part) for part in (command.help or "").split("\n\n"))
    listed = md.table(("argument or option", "what it does"), rows)
    yield f"## {name}\n\n```text\n{words}\n```\n\n{text}\n\n{listed}"


def _metavar(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _spelling(option: Any) -> str:
    names = ", ".join(md.code(name) for name in [*option.opts, *option.secondary_opts])
    return names if option.is_flag else f"{names} {md.code(_metavar(option))}"


def _default(option: Any) -> str:
    shown = not option.is_flag and option.default not in (None, "") and "efault" not in (option.help or "")
    return f" Default: {md.code(option.default)}." if shown else ""


TABLES: Final[dict[str, Callable[[], str]]] = {"commands": commands}
