"""Colours of a surface's points, from the same colour scale as ``skinnode monitor``."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.monitor.field_map import MAGMA, UNKNOWN_RGB

_SHADES: Final = 257
_STOPS: Final = np.linspace(0.0, 1.0, len(MAGMA))
_TABLE: Final = np.full((_SHADES, 4), 255, np.uint8)
"""RGBA of each shade."""
_TABLE[:, :3] = np.rint(
    np.stack([np.interp(np.linspace(0.0, 1.0, _SHADES), _STOPS, channel) for channel in MAGMA.T], axis=-1)
)


def depth_rgba(depth_m: Float, unknown: NDArray[np.bool_], full_m: float) -> NDArray[np.uint8]:
    """Return the (U N, 4) RGBA colours, 0 to 255, of a surface's points in row-major order.

    Args:
        depth_m: (U, N) depths, in m.
        unknown: (U, N) mask of unknown depths.
        full_m: Depth shown in the brightest colour, in m.
    """
    known_m = np.where(unknown, 0.0, depth_m).ravel()
    shades = np.rint(np.clip(known_m * ((_SHADES - 1) / full_m), 0.0, _SHADES - 1)).astype(np.intp)
    made = _TABLE[shades]
    made[unknown.ravel(), :3] = UNKNOWN_RGB
    return made


def grey_rgba(points: int) -> NDArray[np.uint8]:
    """Return the (``points``, 4) colours of a surface whose displacement is unknown or out of date."""
    made = np.full((points, 4), 255, np.uint8)
    made[:, :3] = UNKNOWN_RGB
    return made
