"""Formats Markdown for the documentation generators."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table. Vertical bars in cells are escaped, except in inline code."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(text: str) -> str:
    parts = text.split("`")
    return "`".join(part if i % 2 else part.replace("|", r"\|") for i, part in enumerate(parts))


def code(text: object) -> str:
    """Format ``text`` as inline code; an empty string remains empty."""
    shown = str(text)
    return f"`{shown}`" if shown else ""


def prose(docstring: str) -> str:
    """Convert a docstring to one line of Markdown. Roles and double backticks become inline code."""
    text = re.sub(r":[a-z]+:`~?(?:[\w.]+\.)?([\w.]+)`", r"`\1`", docstring)
    return " ".join(text.replace("``", "`").split())


def c_hex(value: int, digits: int = 4) -> str:
    """Format a number in hexadecimal with the prefix 0x and upper-case digits."""
    return f"0x{value:0{digits}X}"


def member_docs(kind: type) -> dict[str, str]:
    """Return the docstrings that follow a class's members in the source, keyed by member name."""
    (body,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(body, ast.ClassDef)
    docs: dict[str, str] = {}
    name = ""
    for line in body.body:
        target = line.targets[0] if isinstance(line, ast.Assign) else getattr(line, "target", None)
        if isinstance(target, ast.Name):
            name = target.id
        elif name and isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant):
            docs[name], name = prose(str(line.value.value)), ""
    return docs
