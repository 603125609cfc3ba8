"""Writes and reads field tables as Parquet, using pyarrow, an optional dependency."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.errors import ConfigError, Shown
from skinnode.files.whole_file import discard
from skinnode.record.field_rows import CROSSINGS, FORMAT, NUMBERS, POINTS, PREFIX, TEXTS, WIRES, FieldRow
from skinnode.transport.frame_log import create_binary

ROWS_PER_GROUP: Final = 512
"""Number of rows per row group. A row group is held in memory: about 10 MB for patches of 10 × 30 wires."""
_KEY: Final = b"skinnode"


def require_pyarrow(path: Path) -> None:
    """Raise ConfigError if pyarrow is not installed."""
    if find_spec("pyarrow") is None:
        allowed = "the package of the parquet extra (install: sh install.sh parquet)"
        raise ConfigError(str(path), Shown("no package pyarrow"), allowed)


class ParquetFile:
    """New Parquet field table.

    Arrays are stored as lists in row-major order. The columns ``upper_wires``, ``upper_electrodes`` and
    ``lower_wires`` contain their dimensions U, N and K.

    Args:
        path: Path of the new file.
        hand: First line of the journal, which contains the hand; empty if unknown.

    Raises:
        ConfigError: The file already exists or cannot be created, or the package pyarrow is missing.
    """

    def __init__(self, path: Path, hand: str) -> None:
        require_pyarrow(path)
        import pyarrow.parquet as pq

        schema = _schema().with_metadata({_KEY: FORMAT.encode(), b"skinnode.hand": hand.encode()})
        self._schema = schema
        # dictionary-encoding measured numbers saves no space and takes four times as long as everything else
        texts = ["patch", *TEXTS]
        create_binary(path).close()
        self._path = path
        self._writer = pq.ParquetWriter(path, schema, compression="zstd", use_dictionary=texts)
        self._rows: list[dict[str, Any]] = []

    def write(self, row: FieldRow) -> None:
        """Write a row."""
        columns = row.columns
        upper_wires, electrodes, _ = columns["displacement_m"].shape
        flat = {
            name: value.reshape(-1) if isinstance(value, np.ndarray) else value
            for name, value in columns.items()
        }
        shape = {
            "upper_wires": upper_wires,
            "upper_electrodes": electrodes,
            "lower_wires": columns["resistance_ohm"].shape[1],
        }
        self._rows.append(
            {"patch": row.patch, **shape, **flat, "contacts": row.contacts, "faults": row.faults}
        )
        if len(self._rows) >= ROWS_PER_GROUP:
            self._write_group()

    def close(self) -> None:
        """Write the remaining rows and close the file."""
        if self._rows:
            self._write_group()
        self._writer.close()

    def discard(self) -> None:
        """Close and delete the file."""
        with suppress(Exception):  # the file may already be closed
            self._writer.close()
        discard(self._path)

    def _write_group(self) -> None:
        import pyarrow as pa

        rows, self._rows = self._rows, []
        columns = {name: [row[name] for row in rows] for name in self._schema.names}
        arrays = [pa.array(columns[name], type=self._schema.field(name).type) for name in self._schema.names]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))


def read_parquet(path: Path) -> tuple[str, Iterator[FieldRow]]:
    """Open a Parquet field table.

    Returns:
        The journal's first line, which contains the hand, and the rows.

    Raises:
        ConfigError: The file is not a Parquet field table, or has a different version.
    """
    require_pyarrow(path)
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise ConfigError("fields", str(path), f"a Parquet file ({_short(error)})") from None
    metadata = file.schema_arrow.metadata or {}
    check_format(metadata.get(_KEY, b"").decode("utf-8", "replace"), path)
    hand = metadata.get(b"skinnode.hand", b"").decode("utf-8", "replace")
    return hand, _rows(file, path)


def check_format(found: str, path: Path) -> None:
    """Raise ConfigError unless ``found`` is the field-table format of this version."""
    if found == FORMAT:
        return
    if found.startswith(PREFIX):
        allowed = f"{FORMAT!r}; another version of skinnode can read this file"
        raise ConfigError("format", found[:40], allowed, where=str(path))
    raise ConfigError("fields", str(path), "a file of fields written by skinnode convert")


def _rows(file: Any, path: Path) -> Iterator[FieldRow]:
    import pyarrow as pa

    try:
        for batch in file.iter_batches(batch_size=ROWS_PER_GROUP):
            for row in batch.to_pylist():
                yield _row(row)
    except (OSError, KeyError, ValueError, TypeError, pa.ArrowException) as error:
        raise ConfigError("fields", str(path), f"an undamaged Parquet file ({_short(error)})") from None


def _row(row: dict[str, Any]) -> FieldRow:
    upper, electrodes, lower = row["upper_wires"], row["upper_electrodes"], row["lower_wires"]
    columns = {name: row[name] for name in (*NUMBERS, *TEXTS)}
    columns |= {name: np.array(row[name], dtype=kind) for name, kind in WIRES.items()}
    columns |= {name: np.array(row[name]).reshape(upper, electrodes, 3) for name in POINTS}
    columns |= {name: np.array(row[name]).reshape(upper, lower) for name in CROSSINGS}
    return FieldRow(row["patch"], columns, row["contacts"], row["faults"])


def _schema() -> Any:
    import pyarrow as pa

    def kind(dtype: str) -> Any:
        return pa.from_numpy_dtype(np.dtype(dtype))

    numbers, vector, texts = pa.float64(), pa.list_(pa.float64()), pa.string()
    contact = [
        ("centroid_m", vector),
        ("centroid_std_m", vector),
        ("axes", vector),
        ("area_m2", numbers),
        ("area_std_m2", numbers),
        ("normal_force_n", numbers),
        ("normal_force_std_n", numbers),
        ("shear_force_n", vector),
        ("shear_force_std_n", vector),
        ("force_calibrated", pa.bool_()),
    ]
    fault = [
        ("part", texts),
        ("kind", texts),
        ("upper", pa.int32()),
        ("lower", pa.int32()),
        ("since", pa.int64()),
        ("deviations", numbers),
    ]
    return pa.schema(
        [
            ("patch", texts),
            *((name, pa.int32()) for name in ("upper_wires", "upper_electrodes", "lower_wires")),
            *((name, kind(dtype)) for name, dtype in NUMBERS.items()),
            *((name, texts) for name in TEXTS),
            *((name, pa.list_(kind(dtype))) for name, dtype in WIRES.items()),
            *((name, vector) for name in (*POINTS, *CROSSINGS)),
            ("contacts", pa.list_(pa.struct(contact))),
            ("faults", pa.list_(pa.struct(fault))),
        ]
    )


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:100]
