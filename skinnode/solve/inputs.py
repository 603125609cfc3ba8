"""Validates a tracker's arguments. Wrong shapes raise an exception; invalid resistances do not."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.layout import Float, PatchLayout

NOISE_MAX: Final = 1e12
"""Relative noise above which a resistance is unusable. The square of this value does not overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class CodeMap:
    """Mapping from converter codes (0 to ``steps``) to resistances: R = (lo + code · step) · R0 · gain."""

    baseline_ohm: Float
    """(U, K) baselines R0, in ohms; the codes of a crossing are invalid if its R0 is not positive and
    finite."""
    lo: float
    """Ratio R / R0 at code 0."""
    step: float
    """Change in R / R0 per code."""
    steps: int
    """Largest valid code."""
    rounding_ohm: Float
    """(U, K) standard deviation of the quantization error, in ohms."""
    relative_noise: float
    """Relative standard deviation of the resistances before quantization."""
    gain: Float | None = None
    """(U, K) or (U, 1) gain of the front end; None for a gain of 1."""
    unknown: NDArray[np.bool_] | None = field(init=False)
    """(U, K) mask of the crossings without a baseline; None if there are none."""

    def __post_init__(self) -> None:
        unknown = ~((self.baseline_ohm > 0) & (self.baseline_ohm < np.inf))
        object.__setattr__(self, "unknown", unknown if unknown.any() else None)

    def decode(self, codes: NDArray[np.uint32]) -> tuple[Float, NDArray[np.bool_]]:
        """Return the resistances (U, K) in ohms and a mask (U, K) of the valid codes.

        The resistance of an invalid code is NaN.
        """
        valid = codes <= self.steps
        if self.unknown is not None:
            valid &= ~self.unknown
        ohm = (self.lo + codes * self.step) * self.baseline_ohm
        if self.gain is not None:
            ohm *= self.gain
        if not valid.all():
            ohm[~valid] = np.nan
        return ohm, valid


class CodeDecoder:
    """Decoder for the codes of a stream. Codes that have not changed are not decoded again.

    Args:
        meaning: Mapping from the codes to resistances.
    """

    def __init__(self, meaning: CodeMap) -> None:
        self._meaning = meaning
        self._codes: NDArray[np.uint32] | None = None
        self._decoded: tuple[Float, NDArray[np.bool_], int]

    def decode(self, codes: NDArray[np.uint32]) -> tuple[Float, NDArray[np.bool_], int]:
        """Decode the codes of a frame.

        Args:
            codes: (U, K) codes. If a host passes the last frame's read-only array again because the node has
                sent no new codes, the last result is returned again.

        Returns:
            Read-only resistances (U, K) in ohms, NaN where a code is invalid; a read-only mask (U, K) of the
            valid codes; and the number of invalid codes.
        """
        if codes is self._codes:
            return self._decoded
        ohm, valid = self._meaning.decode(codes)
        ohm.flags.writeable = valid.flags.writeable = False
        self._decoded = ohm, valid, valid.size - int(np.count_nonzero(valid))
        constant = codes.flags.owndata and not codes.flags.writeable
        self._codes = codes if constant else None
        return self._decoded


def broadcast_noise(relative_noise: ArrayLike, layout: PatchLayout) -> Float:
    """Return the relative noise as an array (U, K).

    Raises:
        ValueError: If the noise is neither a number nor an array of this shape.
    """
    if isinstance(relative_noise, np.ndarray) and relative_noise.shape == layout.shape:
        return np.asarray(relative_noise, np.float64)  # fast path: hosts pass an array with every frame
    if isinstance(relative_noise, float):
        return _uniform(relative_noise, layout.shape)
    try:
        return np.asarray(np.broadcast_to(np.asarray(relative_noise, np.float64), layout.shape))
    except (TypeError, ValueError) as error:
        got = f"got shape {np.shape(relative_noise)}" if np.ndim(relative_noise) else f"{error}"
        raise ValueError(f"relative_noise: {got}, must be a number or {layout.shape}") from None


@functools.lru_cache(maxsize=64)
def _uniform(value: float, shape: tuple[int, int]) -> Float:
    """Return a read-only array (U, K) with the same value everywhere."""
    return np.broadcast_to(np.float64(value), shape)


def checked_noise(relative_noise: ArrayLike, layout: PatchLayout) -> Float:
    """Return the relative noise as an array (U, K).

    Raises:
        ValueError: If the noise is neither a number nor an array of this shape, or if a value is not positive
            and finite.
    """
    noise = broadcast_noise(relative_noise, layout)
    if not ((noise > 0) & (noise < np.inf)).all():
        worst = noise[~((noise > 0) & (noise < np.inf))][0]
        raise ValueError(f"relative_noise: got {worst}, must be positive and finite")
    return noise


def checked_mask(valid: Any, layout: PatchLayout) -> NDArray[np.bool_]:
    """Return the mask as an array (U, K).

    Raises:
        ValueError: If the mask is not bool or does not have this shape.
    """
    mask = np.asarray(valid)
    if mask.dtype != np.bool_ or mask.shape != layout.shape:
        got = f"{mask.dtype} of shape {mask.shape}"
        raise ValueError(f"valid: got {got}, must be bool of shape {layout.shape}")
    return mask


def checked_codes(codes: Any, layout: PatchLayout) -> NDArray[np.uint32]:
    """Return the codes unchanged.

    Raises:
        ValueError: If the codes are not a uint32 array of shape (U, K).
    """
    if getattr(codes, "dtype", None) != np.uint32 or codes.shape != layout.shape:
        got = f"{codes.dtype} of shape {codes.shape}" if isinstance(codes, np.ndarray) else f"{codes!r:.40}"
        raise ValueError(f"codes: got {got}, must be uint32 of shape {layout.shape}")
    return np.asarray(codes)
