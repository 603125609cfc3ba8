"""Generates the reference pages for hand.toml and scene files from the configuration models.

A page lists each key with its purpose, type, unit, default and allowed values.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import markdown_text as md
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from skinnode.config import HandConfig
from skinnode.config.descriptions import descriptions_of
from skinnode.config.explain import allowed_in, tables_in
from skinnode.config.table import Table
from vcan_sim.scenes import SceneConfig

_TYPES: Final = {
    str: "text",
    int: "integer",
    float: "number",
    bool: "boolean",
    Path: "path",
    dict: "table",
    Any: "text or table",
}
_UNITS: Final = {
    "n_per_m": "N/m",
    "ohm_per_m": "Ω/m",
    "m_per_s": "m/s",
    "bps": "bit/s",
    "fields": "fields",
    "rad": "rad",
    "n": "N",
    "ms": "ms",
    "us": "µs",
    "pa": "Pa",
    "m": "m",
    "s": "s",
}


def keys_of_a_hand() -> str:
    """Return a Markdown section for each table of hand.toml, in the order of the models."""
    return "\n\n".join(_sections("", HandConfig, listed=False))


def keys_of_a_scene() -> str:
    """Return a Markdown section for each table of a scene file."""
    return "\n\n".join(_sections("", SceneConfig, listed=False))


def _sections(path: str, model: type[Table], *, listed: bool) -> list[str]:
    title = "Top level" if not path else f"`[[{path}]]`" if listed else f"`[{path}]`"
    rows, below, descriptions = [], [], descriptions_of(model)
    for name, field in model.model_fields.items():
        inner = tables_in(field.annotation)
        rows.append(_row(name, field, descriptions.get(name)))
        if inner:
            key = f"{path}.{name}".strip(".")
            below += _sections(key, inner[0], listed=get_origin(field.annotation) is tuple)
    text = "" if not path else md.prose(inspect.cleandoc(model.__doc__ or "")) + "\n\n"
    head = ("key", "what it is for", "type", "unit", "default", "allowed")
    return [f"## {title}\n\n{text}{md.table(head, rows)}", *below]


def _row(name: str, field: FieldInfo, description: str | None) -> tuple[str, ...]:
    inner = tables_in(field.annotation)
    about = md.prose(description or (inner[0].__doc__ if inner else "") or "")
    kind = _kind(field.annotation)
    allowed = allowed_in(field) or {"boolean": "true or false"}.get(kind, "")
    if inner:
        kind, allowed = ("tables" if kind.startswith("list") else kind), allowed or "see below"
    elif kind == "table":
        allowed = "names and values"
    return md.code(name), about, kind, _unit(name), _default(field), allowed


def _kind(annotation: Any) -> str:
    """Return the name of the TOML type for a Python type."""
    origin, inside = get_origin(annotation), [part for part in get_args(annotation) if part is not type(None)]
    if origin in (Union, types.UnionType, Annotated):
        return _kind(inside[0])
    if origin is Literal:
        return _TYPES[type(inside[0])]
    if origin is tuple:
        kind = _kind(inside[0])
        return f"list of {kind.replace('list', 'lists', 1) if kind.startswith('list') else f'{kind}s'}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    return _TYPES[origin or annotation]


def _unit(name: str) -> str:
    return next((unit for suffix, unit in _UNITS.items() if re.search(f"_{suffix}$", name)), "")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "**required**"
    value = field.default
    if value is None or isinstance(value, BaseModel) or value in ((), {}):
        return ""
    if isinstance(value, bool):
        return md.code(str(value).lower())
    if isinstance(value, float):
        return md.code(f"{value:g}".replace("e-0", "e-"))
    if isinstance(value, int):
        return md.code(f"{value:_}")
    return md.code(list(value) if isinstance(value, tuple) else value)


TABLES: Final[dict[str, Callable[[], str]]] = {"hand-keys": keys_of_a_hand, "scene-keys": keys_of_a_scene}
