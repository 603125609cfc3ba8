"""Scenes shipped with the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError

_FOLDER: Final = Path(__file__).with_name("shipped")


def shipped_scenes() -> dict[str, Path]:
    """Return the files of the shipped scenes, by scene name."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"))}


def scene_file(scene: Path, option: str = "--scene") -> Path:
    """Return the path of a scene file.

    Args:
        scene: Path of the file, or name of a shipped scene. An existing file takes precedence.
        option: Name of the option or argument in the error message.

    Raises:
        ConfigError: If ``scene`` has no suffix and is neither a file nor a shipped scene.
    """
    if scene.exists():
        return scene
    shipped = shipped_scenes()
    if str(scene) not in shipped and not scene.suffix:
        raise ConfigError(option, str(scene), f"a scene file, or one of {', '.join(shipped)}")
    return shipped.get(str(scene), scene)
