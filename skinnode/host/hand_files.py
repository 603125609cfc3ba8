"""Check the EDS and baseline files named in a hand file against its patches."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.eds_encoding import MOST_EDS_BYTES, read_eds_text
from skinnode.canopen.eds_form import check_form, no_eds
from skinnode.config import HandConfig
from skinnode.errors import ConfigError, ProfileError, Shown
from skinnode.files.input_file import read_input
from skinnode.model.layout import Float
from skinnode.protocol.profile import PatchProfile

_LONGEST_SHOWN = 40


def check_files(hand: HandConfig) -> None:
    """Check the EDS and baseline files of every patch.

    Raises:
        ConfigError: if a file is invalid or does not match its patch.
    """
    for patch in hand.patches:
        profile = PatchProfile.from_config(patch, hand.bus(patch.bus))
        if patch.eds is not None:
            check_eds(patch.eds, profile)
        if patch.baseline is not None:
            load_baseline(patch.baseline, profile)


def load_baseline(path: Path, profile: PatchProfile) -> Float:
    """Read a patch's baseline from a text file.

    Returns:
        (U, K) resistances at rest in ohms, rounded to REAL32.

    Raises:
        ConfigError: if the file is not a table of U × K positive numbers.
    """
    allowed = f"{profile.rows} lines of {profile.columns} positive resistances in ohms"
    text = read_input("baseline", path).decode("utf-8", "replace")
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        row = [_ohm(word, f"baseline, line {number}", allowed, str(path)) for word in line.split()]
        if row and len(row) != profile.columns:
            got = Shown(f"{len(row)} numbers")
            raise ConfigError(f"baseline, line {number}", got, allowed, where=str(path))
        rows += [row] if row else []
    if len(rows) != profile.rows:
        raise ConfigError("baseline", Shown(f"{len(rows)} lines"), allowed, where=str(path))
    return np.array(rows, dtype=np.float32).astype(np.float64)


def _ohm(word: str, key: str, allowed: str, where: str) -> float:
    try:
        value = np.float32(float(word))
    except (ValueError, OverflowError):
        value = np.float32("nan")
    if not (np.isfinite(value) and value > 0):
        raise ConfigError(key, word[:_LONGEST_SHOWN], allowed, where=where)
    return float(value)


def check_eds(path: Path, profile: PatchProfile) -> None:
    """Check an EDS file against a patch's PDO format.

    The file may describe the summary with or without the check value for the codes.

    Raises:
        ConfigError: if the file cannot be read.
        ProfileError: if the file is not an EDS file, or an object is missing or differs from the PDO format.
    """
    from canopen.objectdictionary.eds import import_eds  # this function accepts any file name

    data = read_input("EDS", path, MOST_EDS_BYTES)
    try:
        text = read_eds_text(data).readable
    except UnicodeDecodeError:
        allowed = "a file in CiA 306 format"
        raise ProfileError("EDS", Shown("malformed UTF-16"), allowed, where=str(path)) from None
    check_form(text, str(path))
    try:
        described = import_eds(io.StringIO(text), None)  # type: ignore[no-untyped-call]
    except Exception as error:  # canopen's parser may raise any exception
        raise no_eds(error, str(path), text) from None
    checked = described.get_variable(od.SUMMARY, od.SUMMARY_CHECK) is not None
    for item in replace(profile, checked=checked).objects():
        for entry in item.entries:
            where = f"0x{entry.index:04X}:{entry.subindex}"
            found = described.get_variable(entry.index, entry.subindex)
            if found is None:
                raise ProfileError(
                    where, "no such object", f"{entry.name} of {_format(profile)}", where=str(path)
                )
            if found.data_type != entry.data_type:
                allowed = f"0x{int(entry.data_type):X} ({entry.data_type.name})"
                raise ProfileError(f"{where} data type", found.data_type, allowed, where=str(path))
            constant = entry.access == "const" and isinstance(entry.default, int)
            if constant and found.default is not None and found.default != entry.default:
                raise ProfileError(
                    f"{where} {entry.name}",
                    found.default,
                    f"{entry.default} in {_format(profile)}",
                    where=str(path),
                )


def _format(profile: PatchProfile) -> str:
    return f"a patch of {profile.rows}x{profile.columns} wires at {profile.code_bits} bits"
