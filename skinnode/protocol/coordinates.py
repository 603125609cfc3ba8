"""Object 0x2300: where the electrodes are, as bytes.

Signed 32-bit nanometres, little-endian, x y z of every upper electrode wire by wire, then of every lower one.
Nanometres because the layout hash is taken over nanometres: what arrives has the hash of what was sent.
"""

from __future__ import annotations

import numpy as np

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.protocol.profile import PatchProfile
from skinnode.text.words import counted

_NANOMETRE_M = 1e-9
_BYTES = 12  # of an electrode


def pack_coordinates(layout: PatchLayout) -> bytes:
    """The bytes of 0x2300. Raises ConfigError for an electrode more than 2.1 m from the origin."""
    nanometres = np.rint(np.concatenate([a.ravel() for a in (layout.upper_m, layout.lower_m)]) / _NANOMETRE_M)
    farthest = float(np.abs(nanometres).max())
    if farthest >= 2**31:
        raise ConfigError("layout", f"a coordinate of {farthest * _NANOMETRE_M:.3g} m", "at most 2.1 m")
    return nanometres.astype("<i4").tobytes()


def unpack_coordinates(
    data: bytes, profile: PatchProfile, resistivity_ohm_per_m: float, name: str = "custom"
) -> PatchLayout:
    """The layout in the bytes of 0x2300 of a patch with these sizes.

    Raises ConfigError for another number of bytes, ValueError for coordinates that are no layout.
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
