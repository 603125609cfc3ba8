"""Files that commands write: known to be writable before any work is done."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
from collections.abc import Iterator
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


@contextlib.contextmanager
def sole_user(option: str, file: Path) -> Iterator[None]:
    """Raises ConfigError where another process is in here with ``file``, the value of ``option``. What is
    locked is a file beside it, since the file itself is replaced when it is saved."""
    path = file.resolve()
    try:
        lock = os.open(path.with_name(f".{path.name}.lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise ConfigError(option, str(file), f"a file in a folder to write to ({error.strerror})") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(option, str(file), "a file that no other process uses now") from None
        yield
    finally:
        os.close(lock)


def read_text(option: str, file: Path) -> str:
    """All of ``file``, the value of ``option``, a character a byte. Raises ConfigError where it cannot be."""
    try:
        return file.read_text(encoding="latin-1")
    except OSError as error:
        raise ConfigError(option, str(file), f"a file that can be read ({error.strerror})") from error


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
