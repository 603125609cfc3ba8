"""Named scenes that are shipped with the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Final

_FOLDER: Final = Path(__file__).with_name("shipped")


def shipped_scenes() -> dict[str, Path]:
    """Return a mapping from the names of the shipped scenes to their files."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"))}


def scene_file(scene: Path) -> Path:
    """Return the path of a scene file, given the path or the name of a shipped scene.

    Args:
        scene: Path of a scene file, or name of a scene shipped with the simulator.
    """
    return scene if scene.exists() else shipped_scenes().get(str(scene), scene)
