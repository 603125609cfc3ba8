"""Writes files atomically.

The new content is written to a temporary file with a random name in the same folder, and the temporary file
is then renamed. Readers therefore see either the complete old content or the complete new content. If writing
fails, the file keeps its old content. The temporary file is always newly created, never opened through a
symbolic link.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import Final

SUFFIX: Final = ".new"
"""Suffix of temporary files."""


def replace_file(
    path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False, masked: bool = True
) -> None:
    """Replace the content of a file atomically. A symbolic link is replaced, not followed.

    Args:
        path: The file; it need not exist.
        data: New content.
        mode: Permissions of the file.
        masked: Whether the umask reduces ``mode``, as for a new file.
        durable: Whether to flush the file and its folder to the storage medium before returning.

    Raises:
        OSError: The file cannot be written and keeps its old content.
    """
    beside = create_beside(path, data, mode=mode, durable=durable)
    try:
        if not masked:
            os.chmod(beside, mode)
        os.replace(beside, path)
    except BaseException:
        discard(beside)
        raise
    if durable:
        flush_folder(path.parent)


def create_beside(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> Path:
    """Write ``data`` to a temporary file next to ``path``; the caller must rename or discard it.

    Args:
        path: File that the temporary file will replace.
        data: Content of the temporary file.
        mode: Permissions of the temporary file, reduced by the umask.
        durable: Whether to flush the data to the storage medium before returning.

    Returns:
        The path of the temporary file.

    Raises:
        OSError: The temporary file cannot be written and has been removed.
    """
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
    """Remove a file; errors are ignored."""
    with contextlib.suppress(OSError):
        os.unlink(path)


def discard_leftovers(path: Path) -> None:
    """Remove temporary files left behind by processes that were killed while writing ``path``.

    No other process may be writing ``path`` at the same time.
    """
    start = f".{path.name[:200]}."
    with contextlib.suppress(OSError), os.scandir(path.parent) as entries:
        for entry in entries:
            token = entry.name.removeprefix(start).removesuffix(SUFFIX)
            if entry.name == f"{start}{token}{SUFFIX}" and len(token) == 16:
                discard(Path(entry.path))


def flush_file(path: Path) -> None:
    """Flush the content of a file to the storage medium, even if other code wrote the file.

    Raises:
        OSError: The content cannot be written.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_folder(folder: Path) -> None:
    """Flush the entries of ``folder`` to the storage medium, so that renames survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
