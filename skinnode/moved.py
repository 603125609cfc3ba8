"""Keeps the old import paths of moved names working for one version, with a deprecation warning."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any


def moved(old: str, new: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` (PEP 562) for a module whose names have moved to another module.

    Args:
        old: Dotted path of the old module, which is kept for one version.
        new: Dotted path of the module that now contains the names.
    """

    def attribute(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        found = getattr(import_module(new), name)
        warnings.warn(
            f"{old}.{name} has moved to {new}.{name}; the old path will be removed in version 0.2",
            DeprecationWarning,
            stacklevel=2,
        )
        return found

    return attribute
