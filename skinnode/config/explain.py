"""Explains pydantic validation errors in one line: key, value found, values allowed, position.

Pydantic reports the key but not its line in the file, and its messages name Python types ("Input should be a
valid integer") instead of the range of values allowed in the file.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from typing import Any, Final, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from skinnode.config.table import Allowed
from skinnode.config.toml_text import KeyPath
from skinnode.errors import NOTHING, ConfigError, Shown

_LONGEST_SHOWN: Final = 60


def first_error(
    error: ValidationError, table: type[BaseModel], where: Callable[[KeyPath], str]
) -> ConfigError:
    """Return the error to report, selected from pydantic's errors about a table.

    Args:
        error: All validation errors of the table.
        table: Model of the table.
        where: Function that returns the position of a key in its file.
    """
    found = error.errors()
    # Pydantic also reports a misspelt required key as missing; the error about the misspelling is clearer.
    first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
    location, kind = first["loc"], first["type"]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):  # raised by a model's validator, with a key relative to the model
        path = (*location, *key_path(cause.key))
        return ConfigError(dotted(path), cause.got, cause.allowed, where=where(path))
    keys, allowed = _place(location, table)
    if kind == "extra_forbidden":
        unknown = str(location[-1])
        close = difflib.get_close_matches(unknown, keys, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        listed = f"a key of this table{hint}: {', '.join(keys)}"
        return ConfigError(dotted(location), Shown("an unknown key"), listed, where=where(location))
    if kind == "value_error" and cause is not None:
        allowed = str(cause)
    got = NOTHING if kind == "missing" else short(first["input"])
    if allowed is None:
        allowed = re.sub(r"^Input should be ", "", first["msg"])
    return ConfigError(dotted(location), got, allowed, where=where(location))


def short(value: object) -> object:
    """Return ``value``; if its text exceeds 60 characters, return the shortened text."""
    text = repr(value)
    return value if len(text) <= _LONGEST_SHOWN else Shown(text[: _LONGEST_SHOWN - 1] + "…")


def dotted(path: KeyPath) -> str:
    """Return a path as text: ``("patches", 1, "node_id")`` becomes ``patches[1].node_id``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")


def key_path(key: str) -> KeyPath:
    """Return the path of a dotted key; the inverse of :func:`dotted`."""
    parts = re.findall(r"\[(\d+)\]|([^.\[\]]+)", key)
    return tuple(int(index) if index else name for index, name in parts)


def _place(location: KeyPath, table: type[BaseModel]) -> tuple[list[str], str | None]:
    """Return the keys of the table that contains ``location``, and the values allowed at ``location``."""
    allowed: str | None = None
    for depth, part in enumerate(location):
        if isinstance(part, int):
            allowed = allowed if allowed and "number" in allowed else "a table"
            continue
        field = table.model_fields.get(part)
        if field is None:
            break
        inner = tables_in(field.annotation)
        allowed = allowed_in(field) or ("a table" if inner else None)
        if inner and depth < len(location) - 1:
            table = inner[0]
    return list(table.model_fields), allowed


def allowed_in(field: FieldInfo) -> str | None:
    """Describe the values allowed for a key; return None if the key's type describes them sufficiently."""
    marks = [mark.text for mark in field.metadata if isinstance(mark, Allowed)]
    return next(iter([*marks, *_marks_in(field.annotation)]), None)


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models of the tables that the value of a key may contain, directly or in a list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in tables_in(part)]


def _marks_in(annotation: Any) -> list[str]:
    """Return the texts of all :class:`Allowed` annotations, even in a union such as ``Stiffness | None``."""
    own = [mark.text for mark in getattr(annotation, "__metadata__", ()) if isinstance(mark, Allowed)]
    return own + [text for part in get_args(annotation) for text in _marks_in(part)]
