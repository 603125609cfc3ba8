"""Atomic writing of files.

The new content is written to a file with a random name beside the old one, created exclusively and never
through a symbolic link, and renamed once complete. A reader always finds either the old content or the new;
an error leaves the old content.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import Final

SUFFIX: Final = ".new"
"""Suffix of incomplete files."""


def replace_file(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> None:
    """Replace the content of ``path`` by ``data``, with permissions ``mode`` less the umask. A symbolic link
    is replaced, not followed. ``durable``: return once file and name are on the medium. Raises OSError if the
    file cannot be written."""
    beside = create_beside(path, data, mode=mode, durable=durable)
    try:
        os.replace(beside, path)
    except BaseException:
        discard(beside)
        raise
    if durable:
        flush_folder(path.parent)


def create_beside(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> Path:
    """Write ``data`` to a new file in the folder of ``path``, to be renamed or discarded. Raises OSError if
    it cannot be written, and then leaves no file behind."""
    beside = path.with_name(f".{path.name[:200]}.{secrets.token_hex(8)}{SUFFIX}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(beside, flags, mode)
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(descriptor)
    except BaseException:
        discard(beside)
        raise
    return beside


def discard(path: Path) -> None:
    """Remove ``path`` if possible."""
    with contextlib.suppress(OSError):
        os.unlink(path)


def discard_leftovers(path: Path) -> None:
    """Remove the files left by processes that were killed while writing ``path``. Call only as its sole
    writer."""
    start = f".{path.name[:200]}."
    with contextlib.suppress(OSError), os.scandir(path.parent) as entries:
        for entry in entries:
            token = entry.name.removeprefix(start).removesuffix(SUFFIX)
            if entry.name == f"{start}{token}{SUFFIX}" and len(token) == 16:
                discard(Path(entry.path))


def flush_folder(folder: Path) -> None:
    """Flush the names in ``folder`` to the medium; a rename is durable once its folder is flushed."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
