"""Print all messages in the programs, one per line, for review::

    python tools/messages.py [FOLDER...]

A message is any string that contains a space and is not a docstring. In an f-string, braces enclose the
expressions whose values are inserted.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

FOLDERS = ("skinnode", "vcan_sim")


class Message(NamedTuple):
    """String literal that may be shown to the user, with its location."""

    place: str
    """File and line number."""
    text: str


def messages(folder: Path) -> Iterator[Message]:
    """Yield the messages of all modules under ``folder``, file by file."""
    for file in sorted(folder.rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        silent = {id(node) for node in _docstrings(tree)}
        inside: set[int] = set()
        for node in ast.walk(tree):
            if id(node) in silent or id(node) in inside:
                continue
            text = _text(node)
            if text is not None:
                inside |= {id(part) for part in ast.walk(node)}
                if " " in text.strip():
                    yield Message(f"{file}:{node.lineno}", text)  # type: ignore[attr-defined]


def _docstrings(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield string literals that are statements, such as docstrings."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield node.value


def _text(node: ast.AST) -> str | None:
    """Return the text of a string literal or an f-string; None for any other node."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            part.value if isinstance(part, ast.Constant) else f"{{{ast.unparse(part.value)}}}"
            for part in node.values
            if isinstance(part, ast.Constant | ast.FormattedValue)
        )
    return None


def main() -> None:
    for folder in sys.argv[1:] or FOLDERS:
        for place, text in messages(Path(folder)):
            print(f"{place}: {' '.join(text.split())}")


if __name__ == "__main__":
    main()
