"""Writes and reads field tables as NPZ: one array per patch and column, with the fields along the first axis.

An array is named ``PATCH/COLUMN``: for example, ``palm/displacement_m`` with shape (T, U, N, 3).
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.errors import ConfigError
from skinnode.files.whole_file import discard
from skinnode.record.field_rows import CROSSINGS, FORMAT, NUMBERS, POINTS, TEXTS, WIRES, FieldRow
from skinnode.record.parquet_file import check_format
from skinnode.transport.frame_log import create_binary

_ROWS_AT_ONCE: Final = 4096
_COLUMNS: Final = (*NUMBERS, *TEXTS, *WIRES, *POINTS, *CROSSINGS)
_FORMAT_NAME: Final = "format"
_HAND_NAME: Final = "hand"


class NpzFile:
    """New NPZ field table. Rows are kept in temporary files, not in memory, until :meth:`close` is called.

    Args:
        path: Path of the new file.
        hand: First line of the journal, which contains the hand; empty if unknown.

    Raises:
        ConfigError: The file already exists or cannot be created.
    """

    def __init__(self, path: Path, hand: str) -> None:
        self._path, self._hand = path, hand
        self._file = create_binary(path)
        self._folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-")
        self._patches: dict[str, _Rows] = {}

    def write(self, row: FieldRow) -> None:
        """Write a row."""
        rows = self._patches.get(row.patch)
        if rows is None:
            name = Path(self._folder.name) / str(len(self._patches))
            rows = self._patches[row.patch] = _Rows(name, row)
        rows.add(row)

    def close(self) -> None:
        """Write the file and delete the temporary files."""
        with (
            self._folder,
            self._file,
            zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as members,
        ):
            for name, text in ((_FORMAT_NAME, FORMAT), (_HAND_NAME, self._hand)):
                _write(members, name, np.array(text))
            for patch, rows in self._patches.items():
                rows.write(members, patch)

    def discard(self) -> None:
        """Delete the file and the temporary files."""
        with suppress(OSError):
            self._file.close()
        discard(self._path)
        self._folder.cleanup()


class _Rows:
    """Rows of one patch in a temporary file of records; each string is stored as an index into a list."""

    def __init__(self, path: Path, first: FieldRow) -> None:
        self._path = path
        self._file: IO[bytes] = path.open("wb")
        columns = first.columns
        wires, points, crossings = (
            columns[name].shape for name in ("status", "displacement_m", "resistance_ohm")
        )
        self._record = np.dtype(
            [
                *((name, kind) for name, kind in NUMBERS.items()),
                *((name, "<i4") for name in TEXTS),
                *((name, kind, wires) for name, kind in WIRES.items()),
                *((name, "<f8", points) for name in POINTS),
                *((name, "<f8", crossings) for name in CROSSINGS),
            ]
        )
        self._texts: dict[str, int] = {}
        self._count = 0

    def add(self, row: FieldRow) -> None:
        record = np.zeros((), dtype=self._record)
        for name, value in row.columns.items():
            record[name] = self._texts.setdefault(value, len(self._texts)) if name in TEXTS else value
        self._file.write(record.tobytes())
        self._count += 1

    def write(self, members: zipfile.ZipFile, patch: str) -> None:
        self._file.close()
        records = np.memmap(self._path, dtype=self._record, mode="r", shape=(self._count,))
        texts = np.array(list(self._texts))
        for name in _COLUMNS:
            if name in TEXTS:
                _write(members, f"{patch}/{name}", texts[records[name]])
            else:
                _write_rows(members, f"{patch}/{name}", records[name])
        del records


def _write(members: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    array = io.BytesIO()
    np.lib.format.write_array(array, values, allow_pickle=False)
    members.writestr(f"{name}.npy", array.getvalue())


def _write_rows(members: zipfile.ZipFile, name: str, column: NDArray[Any]) -> None:
    """Write an array in groups of rows, because a column may not fit in memory."""
    with members.open(f"{name}.npy", "w", force_zip64=True) as member:
        head = {
            "descr": np.lib.format.dtype_to_descr(column.dtype),
            "fortran_order": False,
            "shape": column.shape,
        }
        np.lib.format.write_array_header_1_0(member, head)
        for begin in range(0, len(column), _ROWS_AT_ONCE):
            member.write(np.ascontiguousarray(column[begin : begin + _ROWS_AT_ONCE]).tobytes())


def read_npz(path: Path) -> tuple[str, Iterator[FieldRow]]:
    """Open an NPZ field table.

    Returns:
        First line of the journal, which contains the hand, and the rows, one patch after another.

    Raises:
        ConfigError: The file is not an NPZ field table or has a different version.
    """
    allowed = "an NPZ file of fields written by skinnode convert"
    try:
        with path.open("rb") as opened:
            file = np.load(opened, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile) or _FORMAT_NAME not in file.files:
                raise ConfigError("fields", str(path), allowed)
            check_format(str(file[_FORMAT_NAME]), path)
            return str(file[_HAND_NAME]), _rows(path)
    except ConfigError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise ConfigError("fields", str(path), allowed) from None


def _rows(path: Path) -> Iterator[FieldRow]:
    try:
        with np.load(path, allow_pickle=False) as file:
            for patch in [name.removesuffix("/scan") for name in file.files if name.endswith("/scan")]:
                columns = {name: file[f"{patch}/{name}"] for name in _COLUMNS}
                for i in range(len(columns["scan"])):
                    values = {name: column[i] for name, column in columns.items()}
                    yield FieldRow(patch, values | {name: str(values[name]) for name in TEXTS})
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())[:100]
        raise ConfigError("fields", str(path), f"an undamaged NPZ file ({reason})") from None
