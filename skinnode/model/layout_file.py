"""Layouts in files of their own: NPZ or TOML with the electrodes, or TOML with the keys of a preset."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skinnode.errors import NOTHING, ConfigError, Shown
from skinnode.model.layout import PatchLayout

_ARRAYS = ("upper_m", "lower_m")
_KEYS = (*_ARRAYS, "resistivity_ohm_per_m")


def read_npz(path: Path) -> PatchLayout:
    """A layout of the arrays ``upper_m`` (U, N, 3), ``lower_m`` (K, M, 3), metres, and, if it is there,
    ``resistivity_ohm_per_m``, a number. Nothing in the file is executed.

    Raises ConfigError for a file that is none of this.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            table = {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        # np.load takes other files for pickles or a single array
        what = " ".join(str(error).split())[:80] or type(error).__name__
        raise ConfigError("layout file", str(path), f"an NPZ file ({what})") from None
    return from_electrodes(table, path)


def has_electrodes(table: Mapping[str, Any]) -> bool:
    """Whether a TOML layout file says where each electrode is, rather than name a preset."""
    return any(key in table for key in _ARRAYS)


def from_electrodes(table: Mapping[str, Any], path: Path) -> PatchLayout:
    """A layout of the same keys as in :func:`read_npz`. Raises ConfigError."""
    for key in _ARRAYS:
        if key not in table:
            raise ConfigError(key, NOTHING, "an array of electrodes, metres", where=str(path))
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
    """What :class:`PatchLayout` says of a key, as an error of the ``table`` in which that is."""
    key, _, what = str(error).partition(": ")
    got, _, allowed = what.partition(", must be ")
    key = f"{table}.{key}" if table else key
    return ConfigError(key, Shown(got.removeprefix("got ")), allowed or "a possible geometry", where=where)
