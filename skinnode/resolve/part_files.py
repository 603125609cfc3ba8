"""Reads and writes the results of units: one file each, named after the unit's key.

A part file is written under a temporary name and renamed when it is complete and on disk. A file with the
name of a part is therefore always complete, even after a power failure, and the files in a work folder show
which units are finished. The files are pickles, written and read by the same version of skinnode.
"""

from __future__ import annotations

import os
import pickle
import secrets
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

from skinnode.errors import SkinError
from skinnode.files.whole_file import SUFFIX, discard, flush_file, flush_folder

_OFFSET: Final = struct.Struct("<q")
"""Offset of the summary, stored at the end of a part."""
_PICKLE_ERRORS: Final = (
    pickle.UnpicklingError,
    EOFError,
    AttributeError,
    ImportError,
    IndexError,
    ValueError,
)


class PartFiles:
    """Part files in a work folder.

    Args:
        folder: The work folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __contains__(self, key: str) -> bool:
        return self._path(key).exists()

    @contextmanager
    def new(self, key: str) -> Iterator[PartWriter]:
        """Yield a writer for a part, whose file appears when the block ends without an error.

        Args:
            key: Key of the part.

        Raises:
            OSError: The file cannot be written.
        """
        path = self._path(key)
        temporary = self.temporary(path.name)
        try:
            with temporary.open("xb") as file:
                writer = PartWriter(file)
                yield writer
                writer.end()
            put_in_place(temporary, path)
        except BaseException:
            discard(temporary)
            raise

    def items(self, key: str) -> Iterator[Any]:
        """Yield the items of a part. Raises SkinError if the part is missing or damaged."""
        with self._opened(key) as file:
            while True:
                more, item = pickle.load(file)
                if not more:
                    return
                yield item

    def summary(self, key: str) -> Any:
        """Return the summary of a part. Raises SkinError if the part is missing or damaged."""
        with self._opened(key) as file:
            file.seek(-_OFFSET.size, os.SEEK_END)
            file.seek(*_OFFSET.unpack(file.read(_OFFSET.size)))
            return pickle.load(file)[1]

    def remove(self, key: str) -> None:
        """Delete a part if it exists."""
        discard(self._path(key))

    def temporary(self, name: str) -> Path:
        """Return an unused name in the work folder, which is on the same disk as the results.

        A file that a killed process leaves there is deleted with the work folder.

        Args:
            name: Name that the file will have when it is complete.
        """
        return self._folder / f".{name[:200]}.{secrets.token_hex(8)}{SUFFIX}"

    @contextmanager
    def _opened(self, key: str) -> Iterator[IO[bytes]]:
        path = self._path(key)
        try:
            with path.open("rb") as file:
                yield file
        except (OSError, struct.error, *_PICKLE_ERRORS) as error:
            raise SkinError(
                f"{path}: cannot be read ({type(error).__name__}: {error}); "
                "delete this folder and run the command again"
            ) from None

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.part"


class PartWriter:
    """Writes a part.

    Args:
        file: The file.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.summary: Any = None
        """Summary, written after the last item."""

    def add(self, item: Any) -> None:
        """Write an item."""
        pickle.dump((True, item), self._file, protocol=pickle.HIGHEST_PROTOCOL)

    def end(self) -> None:
        """Write the summary."""
        at = self._file.tell()
        pickle.dump((False, self.summary), self._file, protocol=pickle.HIGHEST_PROTOCOL)
        self._file.write(_OFFSET.pack(at))


def put_in_place(temporary: Path, path: Path) -> None:
    """Flush a complete file to disk, rename it to its final name and flush its folder to disk.

    Raises:
        OSError: The file cannot be written.
    """
    flush_file(temporary)
    os.replace(temporary, path)
    flush_folder(path.parent)
