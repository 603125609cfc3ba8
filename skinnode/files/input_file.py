"""Reads input files specified by the user, with a size limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError

MOST_BYTES: Final = 1 << 20
"""Maximum size of a text file, in bytes. This is ten times the size of the largest known file; parsers need
about a hundred times as much memory as the text.
"""


def read_input(key: str, path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Read a file, or a pipe written by another process, as in ``<(command)``.

    Reading a named pipe that has no writer does not block; the pipe counts as an empty file.

    Args:
        key: Option or key that specifies the file, for error messages.
        path: The file.
        most_bytes: Maximum size in bytes.

    Raises:
        ConfigError: The file cannot be read, or is larger than ``most_bytes``.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
        with open(descriptor, "rb") as file:
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                raise ConfigError(key, str(path), "a file that can be read (Is a directory)")
            os.set_blocking(descriptor, True)  # only open() must be non-blocking
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise ConfigError(key, str(path), f"a file that can be read ({error.strerror})") from None
    except ValueError as error:  # open() raises ValueError if the path contains a NUL character
        raise ConfigError(key, str(path), f"a file that can be read ({error})") from None
    if len(data) > most_bytes:
        raise ConfigError(key, str(path), f"a file of at most {most_bytes >> 20} MiB")
    return data
