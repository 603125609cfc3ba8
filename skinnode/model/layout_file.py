"""Reads layout files that contain electrode positions.

TOML layout files that contain preset parameters are read by :mod:`skinnode.config`.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.errors import NOTHING, ConfigError, Shown
from skinnode.files.input_file import read_input
from skinnode.model.layout import MOST_ELECTRODES, MOST_PAIRS, PatchLayout

_ARRAYS = ("upper_m", "lower_m")
_KEYS = (*_ARRAYS, "resistivity_ohm_per_m")
_MOST_NPZ_BYTES: Final = 16 << 20
_MOST_VALUES: Final = {"upper_m": 3 * MOST_ELECTRODES, "lower_m": 3 * MOST_PAIRS, "resistivity_ohm_per_m": 1}
"""Maximum number of elements in each array of a layout file."""
_MOST_ITEM_BYTES: Final = 32
"""Size of NumPy's largest numeric type in bytes."""
_LONGEST_KEY: Final = 40
_MOST_HEADER_BYTES: Final = 10_240
"""Maximum size of an array header in bytes; NumPy accepts headers of up to 10,000 characters."""


def read_npz(path: Path) -> PatchLayout:
    """Read a layout from an NPZ file. Pickled objects are rejected.

    Args:
        path: File containing the arrays ``upper_m`` (U, N, 3) and ``lower_m`` (K, M, 3), in metres, and
            optionally the number ``resistivity_ohm_per_m``.

    Raises:
        ConfigError: If the file is not an NPZ file or does not contain a valid layout.
    """
    try:
        data = io.BytesIO(read_input("layout file", path, _MOST_NPZ_BYTES))
        _require_sizes(data, path)
        data.seek(0)
        with np.load(data, allow_pickle=False) as file:
            table = {key: file[key] for key in file.files}
    except ConfigError:
        raise
    except Exception as error:  # zipfile, its decompressors and NumPy raise many types of exception
        what = " ".join(str(error).split())[:80] or type(error).__name__
        raise ConfigError("layout file", str(path), f"an NPZ file ({what})") from None
    return from_electrodes(table, path)


def _require_sizes(data: io.BytesIO, path: Path) -> None:
    """Check the sizes of the arrays in an NPZ file, because a small file can decompress to gigabytes.

    Raises:
        ConfigError: If an array is unknown, duplicate or too large, or its compression method is not
            supported.
        Exception: If the file is not an NPZ file; zipfile and NumPy raise various exceptions.
    """
    with zipfile.ZipFile(data) as members:
        seen: set[str] = set()
        for member in members.infolist():
            key = member.filename.removesuffix(".npy")
            if key not in _KEYS or key in seen:
                got = Shown("a second array" if key in seen else "an unknown key")
                raise ConfigError(key[:_LONGEST_KEY], got, f"one each of {', '.join(_KEYS)}", where=str(path))
            seen.add(key)
            if member.compress_type not in (
                zipfile.ZIP_STORED,
                zipfile.ZIP_DEFLATED,
            ):  # with other methods, zipfile decompresses an entire member at once
                got = Shown(f"compression method {member.compress_type}")
                raise ConfigError(key, got, "stored or deflated, as written by NumPy", where=str(path))
            most_bytes = _MOST_VALUES[key] * _MOST_ITEM_BYTES
            behind_header = member.file_size - _MOST_HEADER_BYTES
            _require_size(key, f"{member.file_size} bytes", behind_header, most_bytes, path)
            with members.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0
                read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, kind = read(file)
            _require_size(key, f"shape {shape}", math.prod(shape), _MOST_VALUES[key], path)
            _require_size(key, f"shape {shape} of {kind}", math.prod(shape) * kind.itemsize, most_bytes, path)


def _require_size(key: str, got: str, size: int, most: int, path: Path) -> None:
    if size > most:
        raise ConfigError(key, Shown(got), f"at most {_MOST_VALUES[key]} numbers", where=str(path))


def has_electrodes(table: Mapping[str, Any]) -> bool:
    """Return whether a TOML layout file contains electrode positions instead of preset parameters."""
    return any(key in table for key in _ARRAYS)


def from_electrodes(table: Mapping[str, Any], path: Path) -> PatchLayout:
    """Return the layout in ``table``, which has the same keys as an NPZ file (:func:`read_npz`).

    Raises:
        ConfigError: If a key is missing or unknown, or a value is invalid. The message names ``path``.
    """
    for key in _ARRAYS:
        if key not in table:
            raise ConfigError(key, NOTHING, "an array of electrode positions in metres", where=str(path))
    for key in table:
        if key not in _KEYS:
            raise ConfigError(key, Shown("an unknown key"), f"one of {', '.join(_KEYS)}", where=str(path))
    resistivity = np.asarray(table.get("resistivity_ohm_per_m", 1e7))
    if resistivity.size != 1 or resistivity.dtype.kind not in "iuf":
        raise ConfigError("resistivity_ohm_per_m", resistivity.tolist(), "a number", where=str(path))
    try:
        return PatchLayout(table["upper_m"], table["lower_m"], float(resistivity.item()), path.stem)
    except ValueError as error:
        raise impossible(error, where=str(path)) from None


def impossible(error: ValueError, table: str = "", where: str = "") -> ConfigError:
    """Convert an error raised by :class:`PatchLayout` to a ConfigError about a key in ``table``."""
    key, _, what = str(error).partition(": ")
    got, _, allowed = what.partition(", must be ")
    key = f"{table}.{key}" if table else key
    return ConfigError(key, Shown(got.removeprefix("got ")), allowed or "a possible geometry", where=where)
