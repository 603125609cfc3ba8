"""Completes a new file at the end of a block, or deletes it if the block raises an exception."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar


class NewFile(Protocol):
    """File on disk, created by the constructor."""

    def close(self) -> None:
        """Complete and close the file. Raises OSError if writing fails."""

    def discard(self) -> None:
        """Delete the file without completing it."""


_File = TypeVar("_File", bound=NewFile)


@contextmanager
def kept_if_complete(file: _File) -> Iterator[_File]:
    """Yield ``file`` and complete it at the end of the block; delete it if an exception is raised.

    Args:
        file: The file. Its constructor must fail if the file exists, so that another process's file is never
            deleted.

    Raises:
        OSError: The rest of the file cannot be written.
    """
    try:
        yield file
        file.close()
    except BaseException:
        file.discard()
        raise
