"""Creates resistance sources by name. Installed packages can register sources as entry points."""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any, Final

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.node.patch.source import ResistanceSource, SourceFailed, read_source
from skinnode.process import clock

GROUP: Final = "skinnode.sources"
"""Entry-point group in which installed packages register sources by name."""


def registered() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points of the registered sources, by name."""
    return {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}


def load(reference: str, option: str) -> Any:
    """Import the object that ``MODULE:NAME`` refers to.

    Args:
        reference: ``MODULE:NAME``.
        option: Name of the option for the error message.

    Raises:
        ConfigError: If the module cannot be imported or does not contain the name.
    """
    module, _, name = reference.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (Exception, SystemExit) as error:  # user code can raise any exception
        raise ConfigError(option, reference, f"MODULE:NAME that can be imported ({_line(error)})") from error
    return found


def make_source(name: str, layout: PatchLayout, option: str = "source") -> ResistanceSource:
    """Create the source of a patch and read it once to detect faults before the node starts.

    Args:
        name: Entry point or ``MODULE:NAME`` of a class or function that takes the layout and returns a
            :class:`~skinnode.node.patch.source.ResistanceSource`.
        layout: Electrodes of the patch.
        option: Name of the option for the error message.

    Raises:
        ConfigError: If the source is not found, cannot be created or returns no valid reading.
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
        raise ConfigError(option, name, f"a source that can be created ({_line(error)})") from error
    if not callable(getattr(source, "read", None)):
        raise ConfigError(option, name, f"a source with a method read(t_ns), not {source!r:.80}")
    try:
        read_source(source, layout.shape, clock.monotonic_ns())
    except SourceFailed as failure:
        raise ConfigError(option, name, f"a source that returns readings ({failure})") from failure
    return source


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
