"""Writes the output files of commands, and checks in advance that they can be written."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from skinnode.errors import ConfigError
from skinnode.files.whole_file import replace_file


def require_writable(option: str, file: Path) -> None:
    """Check that a file can be written, before computing its content.

    Args:
        option: Option that specifies the file, for error messages.
        file: The file; it need not exist.

    Raises:
        ConfigError: The file is a folder or cannot be written.
    """
    try:
        if file.is_dir():
            raise ConfigError(option, str(file), "the name of a file, not a folder")
        target = file if file.exists() else file.absolute().parent
    except OSError as error:
        raise ConfigError(option, str(file), f"a file that can be written ({error.strerror})") from error
    if not os.access(target, os.W_OK):
        raise ConfigError(option, str(file), "a file in an existing, writable folder")


def write_text(option: str, file: Path, text: str) -> None:
    """Write ``text`` to ``file`` as UTF-8, like :func:`write_bytes`.

    Raises:
        ConfigError: The file cannot be written; a regular file then keeps its old content.
    """
    write_bytes(option, file, text.encode())


def write_bytes(option: str, file: Path, data: bytes) -> None:
    """Write ``data`` to ``file``.

    A regular file is replaced atomically and keeps its permissions. Anything else, such as a pipe, is written
    directly. ``option`` is the option that specifies the file, for error messages.

    Raises:
        ConfigError: The file cannot be written; a regular file then keeps its old content.
    """
    try:
        target = Path(os.path.realpath(file))  # for /dev/stdout, the resolved path may not exist
        if file.exists() and not (file.is_file() and os.access(target.parent, os.W_OK)):
            file.write_bytes(data)
        else:
            if target.exists():
                replace_file(target, data, mode=stat.S_IMODE(target.stat().st_mode), masked=False)
            else:
                replace_file(target, data, mode=0o666)
    except OSError as error:
        raise ConfigError(option, str(file), f"a file that can be written ({error.strerror})") from error
