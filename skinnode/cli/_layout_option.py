"""Implements the ``--layout`` option: the geometry of a patch as a preset, a file or a Python name."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from skinnode.errors import ConfigError

if TYPE_CHECKING:
    from skinnode.model.layout import PatchLayout

OPTION = "--layout"
HELP = "aligned, symmetric or staggered; FILE.toml or .npz, as in a hand's layout.file; or MODULE:NAME."


def import_from_here() -> None:
    """Allow MODULE:NAME to refer to a file in the working directory, as with ``python -m``."""
    sys.path.insert(0, os.getcwd())


def find_layout(text: str) -> PatchLayout:
    """Return the layout that ``text`` names.

    Args:
        text: A preset, a file, or the MODULE:NAME of a PatchLayout or of a function that returns a
            PatchLayout; see HELP.

    Raises:
        ConfigError: The text does not name a layout.
    """
    from skinnode.config import load_layout
    from skinnode.model.layout import PRESETS, PatchLayout
    from skinnode.node.patch.find_source import load

    if text in PRESETS:
        return PatchLayout.preset(text)
    if text.endswith((".toml", ".npz")):
        return load_layout(text)
    if ":" not in text:
        raise ConfigError(OPTION, text, f"{', '.join(PRESETS)}, FILE.toml, FILE.npz or MODULE:NAME")
    found = load(text, OPTION)
    try:
        layout = found if isinstance(found, PatchLayout) else found()
    except Exception as error:
        what = " ".join(str(error).split())
        raise ConfigError(
            OPTION, text, f"a function that returns a layout ({type(error).__name__}: {what})"
        ) from error
    if not isinstance(layout, PatchLayout):
        raise ConfigError(
            OPTION, text, f"a PatchLayout, or a function that returns a PatchLayout, not {layout!r:.80}"
        )
    return layout
