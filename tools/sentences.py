"""Select random sentences for review: ``python -m tools.sentences --seed 1``.

The sentences come from docstrings, comments, messages and documentation pages. A message is any other string
of at least five words. Tests, the changelog, code blocks and tables are left out.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
_LEAST_WORDS = 5


class Sentence(NamedTuple):
    """A sentence with its location and kind."""

    place: str
    kind: str
    text: str


def sentences() -> list[Sentence]:
    """Return all sentences in the project, file by file."""
    found: list[Sentence] = []
    for folder in ("skinnode", "vcan_sim", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            found += _of_code(path)
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]):
        if path.name != "CHANGELOG.md":
            found += _of_page(path)
    return found


def _of_code(path: Path) -> Iterator[Sentence]:
    source, name = path.read_text("utf-8"), str(path.relative_to(ROOT))
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docstrings.add(id(node.value))
            if isinstance(node.value.value, str):
                for text in _split(node.value.value):
                    yield Sentence(f"{name}:{node.lineno}", "docstring", text)
        elif isinstance(node, ast.JoinedStr):
            docstrings |= {id(part) for part in node.values}
            shown = "".join(
                str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values
            )
            if len(shown.split()) >= _LEAST_WORDS:
                yield Sentence(f"{name}:{node.lineno}", "message", " ".join(shown.split()))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            styled = "{ " in node.value or "<" in node.value  # style sheets and HTML
            if len(node.value.split()) >= _LEAST_WORDS and not styled:
                yield Sentence(f"{name}:{node.lineno}", "message", " ".join(node.value.split()))
    lines: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(noqa|type:|!)", token.string):
            if lines and lines[-1][0] == token.start[0] - 1:
                lines[-1] = (token.start[0], lines[-1][1] + " " + token.string.lstrip("# "))
            else:
                lines.append((token.start[0], token.string.lstrip("# ")))
    for line, text in lines:
        if len(text.split()) >= _LEAST_WORDS:
            yield Sentence(f"{name}:{line}", "comment", text)


def _of_page(path: Path) -> Iterator[Sentence]:
    text = re.sub(r"^(```|~~~).*?^\1", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    kept = [line for line in text.split("\n") if not re.match(r"\s*(\||#|!\[|---)", line)]
    for each in _split("\n".join(kept)):
        yield Sentence(str(path.relative_to(ROOT)), "page", each)


def _split(text: str) -> Iterator[str]:
    """Split paragraphs and list items into sentences."""
    for paragraph in re.split(r"\n\s*\n|\n\s*[-*] |\n\s*\d+\. ", text):
        plain = " ".join(paragraph.split())
        if re.search(r"={4,}|-{4,}|::", plain):  # tables and drawings
            continue
        for each in re.split(r"(?<=[.!?])\s+(?=[A-Z`*(])", plain):
            if len(each.split()) >= _LEAST_WORDS:
                yield each


def main() -> None:
    """Print the selected sentences and their locations, one per line."""
    parser = argparse.ArgumentParser(description="Select random sentences from the project.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=50)
    options = parser.parse_args()
    found = sentences()
    for number, each in enumerate(random.Random(options.seed).sample(found, options.count), 1):
        print(f"{number:3}. [{each.kind}, {each.place}] {each.text}")


if __name__ == "__main__":
    main()
