"""Old import paths of public names: they go on working for one version, with a warning."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any


def moved(old: str, new: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` (PEP 562) of a module whose names are in another module now.

    Args:
        old: Dotted path of the module that stays for one version.
        new: Dotted path of the module that holds the names.
    """

    def attribute(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        found = getattr(import_module(new), name)
        warnings.warn(
            f"{old}.{name} is {new}.{name} now; the old path goes in version 0.2",
            DeprecationWarning,
            stacklevel=2,
        )
        return found

    return attribute
