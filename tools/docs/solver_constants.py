"""Generate a table of the solver's tuning constants from the modules of ``skinnode.solve``."""

from __future__ import annotations

import ast
import importlib
import itertools
import pkgutil
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Final

import markdown_text as md

import skinnode.solve
from skinnode.solve.paths.corrector import Accuracy

_NOT_TUNED: Final = {
    *("DECODE", "TAKE", "CHOOSE", "SOLVE", "REACH", "FINISH", "ALL_GOOD", "INCOMPLETE"),
    *("PREDICT", "HOLD", "COVARIANCE", "SKIP", "REUSE", "TASKS"),
    *("ROWS", "TILE", "REST", "TINY", "SQUARE_FLOOR", "A_MIN", "A_MAX", "NOISE_MAX"),
}
"""Constants left out of the table because they do not affect results: task flags, tile sizes and overflow
limits."""


def constants() -> str:
    """Return a table of all documented constants whose value is a number or an ``Accuracy``."""
    rows = [
        (md.code(f"{module.__name__.removeprefix('skinnode.solve.')}.{name}"), value, text)
        for module in _modules()
        for name, value, text in _documented(module)
    ]
    return md.table(("constant", "value", "meaning and origin"), rows)


def _modules() -> Iterator[ModuleType]:
    for found in pkgutil.walk_packages(skinnode.solve.__path__, "skinnode.solve."):
        if not found.ispkg:
            yield importlib.import_module(found.name)


def _documented(module: ModuleType) -> Iterator[tuple[str, str, str]]:
    assert module.__file__ is not None
    with open(module.__file__, encoding="utf-8") as source:
        body = ast.parse(source.read()).body
    for line, below in itertools.pairwise(body):
        if (
            isinstance(line, ast.AnnAssign)
            and isinstance(line.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        ):
            name, value = line.target.id, getattr(module, line.target.id)
            tuned = name.isupper() and not name.startswith("_") and name not in _NOT_TUNED
            if tuned and type(value) in (int, float, Accuracy):
                text = md.prose(str(below.value.value))
                if isinstance(value, Accuracy):
                    yield f"{name}.tolerance", f"{value.tolerance:g}", text
                    yield f"{name}.max_steps", f"{value.max_steps}", text
                else:
                    yield name, f"{value:g}", text


TABLES: Final[dict[str, Callable[[], str]]] = {"solver-constants": constants}
