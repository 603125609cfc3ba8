"""Packs and unpacks a patch's electrode coordinates (object 0x2300).

Each coordinate is a little-endian signed 32-bit integer in nanometres. The object contains x, y and z for
each upper electrode, wire by wire, and then for each lower electrode. The layout hash is also computed from
whole nanometres, so packing and unpacking a layout preserves its hash.
"""

from __future__ import annotations

import numpy as np

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.protocol.profile import PatchProfile
from skinnode.text.words import counted

_NANOMETRE_M = 1e-9
_BYTES = 12  # per electrode


def pack_coordinates(layout: PatchLayout) -> bytes:
    """Return the contents of 0x2300 for a layout. Raises ConfigError if a coordinate exceeds 2.1 m."""
    nanometres = np.rint(np.concatenate([a.ravel() for a in (layout.upper_m, layout.lower_m)]) / _NANOMETRE_M)
    farthest = float(np.abs(nanometres).max())
    if farthest >= 2**31:
        raise ConfigError("layout", f"a coordinate of {farthest * _NANOMETRE_M:.3g} m", "at most 2.1 m")
    return nanometres.astype("<i4").tobytes()


def unpack_coordinates(
    data: bytes, profile: PatchProfile, resistivity_ohm_per_m: float, name: str = "custom"
) -> PatchLayout:
    """Return the layout given by the contents of 0x2300.

    Raises ConfigError if the length does not match the dimensions in ``profile``, and ValueError if the
    coordinates do not form a valid layout.
    """
    upper, lower = profile.rows * profile.upper_electrodes, profile.columns * profile.lower_electrodes
    if len(data) != (upper + lower) * _BYTES:
        raise ConfigError(
            "electrode coordinates (0x2300)", counted(len(data), "byte"), f"{(upper + lower) * _BYTES} bytes"
        )
    metres = np.frombuffer(data, dtype="<i4").reshape(-1, 3) * _NANOMETRE_M
    return PatchLayout(
        metres[:upper].reshape(profile.rows, profile.upper_electrodes, 3),
        metres[upper:].reshape(profile.columns, profile.lower_electrodes, 3),
        resistivity_ohm_per_m,
        name,
    )
