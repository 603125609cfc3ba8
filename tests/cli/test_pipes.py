"""In a pipe a line is a line, however long; in a terminal, and with ``COLUMNS``, it is as wide as that."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import skinnode.cli

PROGRAM = """
from skinnode.cli._console import console, indented, table

shown = table("object", "value")
shown.add_row("x" * 300, " ".join(["word"] * 100))
console().print(shown)
console().print(" ".join(["text"] * 100))
console().print(indented(" ".join(["advice"] * 100)))
"""


def printed(columns: str | None) -> list[str]:
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    environment |= {} if columns is None else {"COLUMNS": columns}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_tables_and_texts_are_not_wrapped() -> None:
    _, _, row, text, advice = printed(None)
    assert row.split() == ["x" * 300, *["word"] * 100]
    assert text == " ".join(["text"] * 100)
    assert advice.rstrip() == " " * 10 + " ".join(["advice"] * 100)


def test_columns_says_how_wide() -> None:
    lines = printed("60")
    assert len(lines) > 10
    assert max(map(len, lines)) <= 60


def test_commands_have_one_console() -> None:
    """Each other would have a width, and a notion of foreign text, of its own."""
    folder = Path(skinnode.cli.__file__).parent
    makers = {
        file.name
        for file in folder.glob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", getattr(node.func, "attr", "")) == "Console"
    }
    assert makers == set()
