"""Writes files atomically.

The new content is first written to a temporary file with a random name in the same folder. The temporary file
is created exclusively, never through a symbolic link, and is renamed when it is complete. Readers therefore
always see either the complete old content or the complete new content. If writing fails, the file keeps its
old content.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import Final

SUFFIX: Final = ".new"
"""Suffix of temporary files."""


def replace_file(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> None:
    """Atomically replace the content of ``path`` with ``data``; a symbolic link is replaced, not followed.

    Args:
        path: The file to write; it need not exist.
        data: New content.
        mode: Permissions, reduced by the umask.
        durable: Whether to return only after the file and its name are on the storage medium.

    Raises:
        OSError: The file cannot be written; it keeps its old content.
    """
    beside = create_beside(path, data, mode=mode, durable=durable)
    try:
        os.replace(beside, path)
    except BaseException:
        discard(beside)
        raise
    if durable:
        flush_folder(path.parent)


def create_beside(path: Path, data: bytes, *, mode: int = 0o600, durable: bool = False) -> Path:
    """Write ``data`` to a temporary file in the folder of ``path``; the caller must rename or discard it.

    Args:
        path: File that the temporary file will replace.
        data: Content of the temporary file.
        mode: Permissions, reduced by the umask.
        durable: Whether to return only after the data is on the storage medium.

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
    """Remove the file ``path``; ignore errors."""
    with contextlib.suppress(OSError):
        os.unlink(path)


def discard_leftovers(path: Path) -> None:
    """Remove temporary files left behind by processes that were killed while writing ``path``.

    Call this function only if no other process writes ``path``.
    """
    start = f".{path.name[:200]}."
    with contextlib.suppress(OSError), os.scandir(path.parent) as entries:
        for entry in entries:
            token = entry.name.removeprefix(start).removesuffix(SUFFIX)
            if entry.name == f"{start}{token}{SUFFIX}" and len(token) == 16:
                discard(Path(entry.path))


def flush_folder(folder: Path) -> None:
    """Flush the directory entries of ``folder`` to the storage medium, so that renames are durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
