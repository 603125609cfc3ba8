"""Checks of what a tracker is given: shapes raise, numbers never do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.layout import Float, PatchLayout

NOISE_MAX: Final = 1e12
"""A relative deviation above is no knowledge, and its square must not overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class CodeMap:
    """What the codes of a converter mean: R = (lo + code · step) · R0 · gain, for codes up to ``steps``."""

    baseline_ohm: Float
    """(U, K) R0; a code whose R0 is not positive and finite is no measurement."""
    lo: float
    step: float
    steps: int
    rounding_ohm: Float
    """(U, K) standard deviation of a code, as a resistance."""
    relative_noise: float
    """Of what comes before the converter."""
    gain: Float | None = None
    """(U, K), or (U, 1)."""


def broadcast_noise(relative_noise: ArrayLike, layout: PatchLayout) -> Float:
    """(U, K) deviations. ValueError for another shape than that or a number."""
    if isinstance(relative_noise, np.ndarray) and relative_noise.shape == layout.shape:
        return np.asarray(relative_noise, np.float64)  # as from every frame of a host
    try:
        return np.asarray(np.broadcast_to(np.asarray(relative_noise, np.float64), layout.shape))
    except (TypeError, ValueError) as error:
        got = f"got shape {np.shape(relative_noise)}" if np.ndim(relative_noise) else f"{error}"
        raise ValueError(f"relative_noise: {got}, must be a number or {layout.shape}") from None


def checked_noise(relative_noise: ArrayLike, layout: PatchLayout) -> Float:
    """(U, K) deviations. ValueError unless they are positive and finite and of that shape or a number."""
    noise = broadcast_noise(relative_noise, layout)
    if not ((noise > 0) & (noise < np.inf)).all():
        worst = noise[~((noise > 0) & (noise < np.inf))][0]
        raise ValueError(f"relative_noise: got {worst}, must be positive and finite everywhere")
    return noise


def checked_mask(valid: Any, layout: PatchLayout) -> NDArray[np.bool_]:
    """``valid`` as an array. ValueError unless it is bool and has the shape of a frame."""
    mask = np.asarray(valid)
    if mask.dtype != np.bool_ or mask.shape != layout.shape:
        got = f"{mask.dtype} of shape {mask.shape}"
        raise ValueError(f"valid: got {got}, must be bool of shape {layout.shape}")
    return mask


def checked_codes(codes: Any, layout: PatchLayout) -> NDArray[np.uint32]:
    """``codes`` as they are. ValueError unless they are uint32 and have the shape of a frame."""
    if getattr(codes, "dtype", None) != np.uint32 or codes.shape != layout.shape:
        got = f"{codes.dtype} of shape {codes.shape}" if isinstance(codes, np.ndarray) else f"{codes!r:.40}"
        raise ValueError(f"codes: got {got}, must be uint32 of shape {layout.shape}")
    return np.asarray(codes)
