"""Files that commands write: known to be writable before any work is done."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from skinnode.errors import ConfigError


def require_writable(option: str, file: Path) -> None:
    """Raises ConfigError where ``file``, the value of ``option``, could not be written."""
    if file.is_dir():
        raise ConfigError(option, str(file), "the name of a file, not a folder")
    target = file if file.exists() else file.absolute().parent
    if not os.access(target, os.W_OK):
        raise ConfigError(option, str(file), "a file in an existing folder that can be written")


def write_text(option: str, file: Path, text: str) -> None:
    """Raises ConfigError where ``file``, the value of ``option``, does not take all of ``text``."""
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(option, str(file), f"a file that can be written ({error.strerror})") from error


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: a figure that could not be had becomes null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
