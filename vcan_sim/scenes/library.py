"""Scenes that are shipped with the simulator, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Final

_FOLDER: Final = Path(__file__).with_name("shipped")


def shipped_scenes() -> dict[str, Path]:
    """Return the files of the scenes that are shipped with the simulator, by name of the scene."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"))}


def scene_file(scene: Path) -> Path:
    """Return the scene file that a user has named by its path or by the name of a shipped scene.

    Args:
        scene: A file, or the name of a scene that comes with the simulator.
    """
    return scene if scene.exists() else shipped_scenes().get(str(scene), scene)
