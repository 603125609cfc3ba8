"""Names a new recording, and creates its folder."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Final, Literal

from skinnode.config import HandConfig
from skinnode.errors import ConfigError

RecordingFormat = Literal["log", "blf", "mcap"]

ALLOWED: Final = "a folder (created if needed), or a file ending in .log, .blf or .mcap"


def name_in(folder: Path, hand: HandConfig, kind: RecordingFormat, now: datetime.datetime) -> Path:
    """Return a path in ``folder`` for a recording, named after the hand, the date and the time."""
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in hand.name)
    return folder / f"{name}-{now:%Y%m%d-%H%M%S}.{kind}"


def make_folder(path: Path) -> Path | None:
    """Create the folder ``path`` and its parents; return ``path``, or None if the folder already existed.

    Raises ConfigError if the folder cannot be created, or if its name has a suffix and is thus probably a
    misspelt file name.
    """
    if path.is_dir():
        return None
    if path.suffix or path.exists():
        raise ConfigError("recording", str(path), ALLOWED)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            "recording", str(path), f"a folder that can be created ({error.strerror})"
        ) from error
    return path


def is_folder(path: Path) -> bool:
    """Return whether ``path`` is a folder. Raises ConfigError if the path is not valid."""
    try:
        return path.is_dir()
    except OSError as error:
        raise ConfigError("recording", str(path), f"{ALLOWED} ({error.strerror})") from error
