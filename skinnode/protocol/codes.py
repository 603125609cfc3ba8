"""Conversion between resistances and the codes sent on the bus.

A resistance R is encoded as the n-bit code round((R/R0 − lo) / (hi − lo) · (2ⁿ − 4)), rounded from the exact
value with ties to the even code, so that every implementation can compute the same code. Codes from 0 to 2ⁿ −
4 are measurements. The three codes above that range are reserved for over-range, short and open, in that
order. The host decodes live streams with the compiled function ``skinnode.solve.wires.decode``.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.errors import ConfigError
from skinnode.model.layout import Float
from skinnode.protocol.objects import DEFAULT_CODE_HI, DEFAULT_CODE_LO

Codes = NDArray[np.uint32]

MISSING: Final = 0xFFFF_FFFF
"""Placeholder for a code that was not received. It is greater than every code."""

CODE_BITS: Final = (16, 24)
"""Allowed code widths in bits."""


@dataclass(frozen=True)
class CodeScale:
    """Mapping of R/R0 to codes. ``lo`` and ``hi`` are rounded to REAL32, as in the object dictionary.

    Raises:
        ConfigError: If the code width is neither 16 nor 24 bits, or 0 ≤ lo < hi < ∞ does not hold.
    """

    bits: int = 16
    """Width of a code in bits."""
    lo: float = DEFAULT_CODE_LO
    """R/R0 of code 0."""
    hi: float = DEFAULT_CODE_HI
    """R/R0 of the highest measurement code."""

    def __post_init__(self) -> None:
        if self.bits not in CODE_BITS:
            raise ConfigError("code_bits", self.bits, "16 or 24")
        lo, hi = float(np.float32(self.lo)), float(np.float32(self.hi))
        if not 0.0 <= lo < hi < math.inf:
            raise ConfigError("code range", (self.lo, self.hi), "0 <= lo < hi, both finite")
        object.__setattr__(self, "lo", lo)
        object.__setattr__(self, "hi", hi)

    @functools.cached_property
    def steps(self) -> int:
        """Highest measurement code, 2ⁿ − 4, which represents R/R0 = ``hi``."""
        return (1 << self.bits) - 4

    @property
    def over_range(self) -> int:
        """Reserved code for an R/R0 value outside the code range and for a crossing without a baseline."""
        return self.steps + 1

    @property
    def short(self) -> int:
        """Reserved code for a short circuit between the upper and the lower wire."""
        return self.steps + 2

    @property
    def open(self) -> int:
        """Reserved code for an open circuit between the upper and the lower wire."""
        return self.steps + 3

    @functools.cached_property
    def step(self) -> float:
        """Difference in R/R0 between adjacent codes."""
        return (self.hi - self.lo) / self.steps

    @functools.cached_property
    def position_error(self) -> float:
        """Bound, in codes, on the rounding error of (R/R0 − lo) / step in double precision.

        The errors of R/R0 and of its difference from ``lo`` are relative to ``hi``. The errors of the step
        and of the division are relative to the code. The bound is twice the sum of these four errors.
        """
        return self.steps * (2.0 * self.hi / (self.hi - self.lo) + 2.0) * 2.0**-52

    @property
    def relative_std(self) -> float:
        """Standard deviation of the quantization error of R/R0: step / √12."""
        return self.step / math.sqrt(12.0)


def as_baseline(baseline_ohm: ArrayLike) -> Float:
    """Round R0 to REAL32, its precision in the object dictionary.

    Args:
        baseline_ohm: R0 in ohms; any shape.

    Returns:
        Rounded R0 in ohms, float64 of the same shape.
    """
    return np.asarray(baseline_ohm, dtype=np.float32).astype(np.float64)


def encode(resistance_ohm: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> Codes:
    """Encode resistances.

    Resistances of +∞ and NaN are encoded as open, and zero and negative resistances as short. All others are
    encoded as over-range if R/R0 is more than half a step outside the code range, or if R0 is not positive
    and finite.

    Args:
        resistance_ohm: Resistances in ohms; any shape.
        baseline_ohm: R0 in ohms; broadcastable to the shape of the resistances.
        scale: Mapping of R/R0 to codes.

    Returns:
        Codes with the same shape as ``resistance_ohm``.
    """
    resistance = np.asarray(resistance_ohm, dtype=np.float64)
    baseline = as_baseline(baseline_ohm)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        position = (resistance / baseline - scale.lo) / scale.step
        code = np.rint(position)
        distance = np.abs(position - code)
        if _all_measured(code, distance, scale):
            return code.astype(np.uint32)
        near_tie = distance > 0.5 - scale.position_error
        if near_tie.any():
            code = _round_exactly(code, near_tie, resistance, baseline, scale)
        measured = (code >= 0) & (code <= scale.steps) & (baseline > 0) & (baseline < np.inf)
        codes = np.where(measured, code, scale.over_range)
        codes = np.where(resistance <= 0, scale.short, codes)
        codes = np.where(resistance < np.inf, codes, scale.open)  # false for NaN too
    return codes.astype(np.uint32)


def _all_measured(code: Float, distance: Float, scale: CodeScale) -> bool:
    """Return whether all codes are definitely measurements and none is near a tie (the usual case).

    If the code range begins at least one step above 0, a ratio R/R0 inside the range implies that R and R0
    are positive and finite.

    Args:
        code: Rounded positions in the code range; any shape.
        distance: Distance of each position from its code, in codes.
        scale: Mapping of R/R0 to codes.
    """
    if not code.size or scale.lo < scale.step:
        return False
    middle, largest = 0.5 * scale.steps, np.maximum.reduce
    return bool(  # NaN makes both comparisons false
        largest(distance, axis=None) <= 0.5 - scale.position_error
        and largest(np.abs(code - middle), axis=None) <= middle
    )


def _round_exactly(
    code: Float, near_tie: NDArray[np.bool_], resistance: Float, baseline: Float, scale: CodeScale
) -> Float:
    """Return the codes, rounded in exact arithmetic where they are near a tie.

    Args:
        code: Rounded positions in the code range; any shape.
        near_tie: Mask of the positions that cannot be rounded reliably in double precision.
        resistance: Resistances in ohms; broadcastable to the shape of ``code``.
        baseline: R0 in ohms; broadcastable to the shape of ``code``.
        scale: Mapping of R/R0 to codes.
    """
    exact = np.array(code)
    lo, steps_per_ratio = Fraction(scale.lo), scale.steps / (Fraction(scale.hi) - Fraction(scale.lo))
    above, below = np.broadcast_to(resistance, exact.shape), np.broadcast_to(baseline, exact.shape)
    for place in map(tuple, np.argwhere(near_tie)):
        ratio = Fraction(float(above[place])) / Fraction(float(below[place]))
        exact[place] = round((ratio - lo) * steps_per_ratio)
    return exact


def decode(codes: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> tuple[Float, NDArray[np.bool_]]:
    """Decode codes into resistances.

    Args:
        codes: Codes of any shape, which may include :data:`MISSING`.
        baseline_ohm: R0 in ohms; broadcastable to the shape of the codes.
        scale: Mapping of R/R0 to codes.

    Returns:
        Resistances in ohms, and a mask of the valid resistances, both with the shape of ``codes``. Where the
        code is reserved or :data:`MISSING`, or R0 is not positive and finite, the resistance is NaN and the
        mask is False.
    """
    return Decoder(baseline_ohm, scale).decode(codes)


class Decoder:
    """Decodes many scans with the same baseline; equivalent to :func:`decode`.

    Args:
        baseline_ohm: R0 in ohms; broadcastable to the shape of the codes.
        scale: Mapping of R/R0 to codes.
    """

    def __init__(self, baseline_ohm: ArrayLike, scale: CodeScale) -> None:
        self._baseline, self._scale = as_baseline(baseline_ohm), scale
        known = (self._baseline > 0) & (self._baseline < np.inf)
        self._known: NDArray[np.bool_] | None = None if known.all() else known

    def decode(self, codes: ArrayLike) -> tuple[Float, NDArray[np.bool_]]:
        """Decode codes into resistances.

        Args:
            codes: Codes, which may include :data:`MISSING`.

        Returns:
            Resistances in ohms, and a mask of the valid resistances.
        """
        code, scale = np.asarray(codes), self._scale
        valid: NDArray[np.bool_] = code <= scale.steps
        if self._known is not None:
            valid = valid & self._known
        resistance = (scale.lo + code * scale.step) * self._baseline
        if not valid.all():
            resistance = np.where(valid, resistance, np.nan)
        return resistance, valid
