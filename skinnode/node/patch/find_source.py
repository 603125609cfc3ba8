"""Sources by name: what a user plugs into a node without touching this project."""

from __future__ import annotations

import importlib
import importlib.metadata
import time
from typing import Any, Final

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.node.patch.source import ResistanceSource, SourceFailed, read_source

GROUP: Final = "skinnode.sources"
"""Entry points of this group in the metadata of any installed package are sources with a name."""


def registered() -> dict[str, importlib.metadata.EntryPoint]:
    """Sources that installed packages have registered, by name."""
    return {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}


def load(reference: str, option: str) -> Any:
    """What ``MODULE:NAME`` refers to. Raises ConfigError naming ``option``: no such module or name, or a
    module that cannot be imported."""
    module, _, name = reference.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (Exception, SystemExit) as error:  # whatever the module does when it is imported
        raise ConfigError(option, reference, f"MODULE:NAME that can be imported ({_line(error)})") from error
    return found


def make_source(name: str, layout: PatchLayout, option: str = "source") -> ResistanceSource:
    """The source ``name``, of an entry point or ``MODULE:NAME``, for a patch of ``layout``.

    The name stands for a class or a function that takes the layout and returns a
    :class:`~skinnode.node.patch.source.ResistanceSource`. It is read once, so that one that does not work is
    found before a node is on the bus. Raises ConfigError naming ``option`` for all that can be wrong with it.
    """
    points = registered()
    if ":" in name:
        factory = load(name, option)
    elif name in points:
        factory = load(points[name].value, f"{option} {name}")
    else:
        known = ", ".join(sorted(points)) or "none is installed"
        raise ConfigError(option, name, f"MODULE:NAME, or a registered source ({known})")
    if not callable(factory):
        raise ConfigError(option, name, "a class or a function that takes the layout")
    try:
        source: ResistanceSource = factory(layout)
    except (Exception, SystemExit) as error:
        raise ConfigError(option, name, f"one that takes the layout ({_line(error)})") from error
    if not callable(getattr(source, "read", None)):
        raise ConfigError(option, name, f"one that gives an object with read(t_ns), not {source!r:.80}")
    try:
        read_source(source, layout.shape, time.monotonic_ns())
    except SourceFailed as failure:
        raise ConfigError(option, name, f"one that reads ({failure})") from failure
    return source


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
