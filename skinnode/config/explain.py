"""Converts pydantic validation errors to one-line errors with key, value found, values allowed and position.

Pydantic does not know the position of a key in the file. Its messages name Python types ("Input should be a
valid integer") instead of the allowed range of values.
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
    """Return the most helpful of pydantic's validation errors as a ConfigError.

    Args:
        error: The validation errors of a table.
        table: Model of the table.
        where: Function that returns the position of a key in its file.
    """
    found = error.errors()
    # A misspelt required key is reported as both unknown and missing; the first error is more helpful.
    first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
    location, kind = first["loc"], first["type"]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):  # from a validator; its key is relative to the model
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
    """Return ``value``, or its text truncated to 60 characters if the text is longer."""
    text = repr(value)
    return value if len(text) <= _LONGEST_SHOWN else Shown(text[: _LONGEST_SHOWN - 1] + "…")


def dotted(path: KeyPath) -> str:
    """Return a path as text: ``("patches", 1, "node_id")`` becomes ``patches[1].node_id``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")


def key_path(key: str) -> KeyPath:
    """Split a dotted key into its parts; the inverse of :func:`dotted`."""
    parts = re.findall(r"\[(\d+)\]|([^.\[\]]+)", key)
    return tuple(int(index) if index else name for index, name in parts)


def _place(location: KeyPath, table: type[BaseModel]) -> tuple[list[str], str | None]:
    """Return the keys of the table that contains ``location``, and the description of the allowed values."""
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
    """Return the description of the values allowed for a key; None if the key has no description."""
    marks = [mark.text for mark in field.metadata if isinstance(mark, Allowed)]
    return next(iter([*marks, *_marks_in(field.annotation)]), None)


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models of all tables in the type of a key, such as a table or a list of tables."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in tables_in(part)]


def _marks_in(annotation: Any) -> list[str]:
    """Return the texts of all :class:`Allowed` annotations in a type, including the members of a union."""
    own = [mark.text for mark in getattr(annotation, "__metadata__", ()) if isinstance(mark, Allowed)]
    return own + [text for part in get_args(annotation) for text in _marks_in(part)]
