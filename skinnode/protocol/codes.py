"""Conversion of resistances to the codes sent on the wire, and back.

code = round((R/R0 − lo) / (hi − lo) · (2ⁿ − 4)). The codes 0 … 2ⁿ − 4 are measurements. The three codes above
them are reserved; in ascending order they are over-range, short and open. Live streams decode by a compiled
copy of this formula, ``skinnode.solve.wires.decode``.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.errors import ConfigError
from skinnode.model.layout import Float
from skinnode.protocol.objects import DEFAULT_CODE_HI, DEFAULT_CODE_LO

Codes = NDArray[np.uint32]

MISSING: Final = 0xFFFF_FFFF
"""Marker for a code that was not received; it is wider than any code, so it is never sent or decoded."""

CODE_BITS: Final = (16, 24)
"""Allowed code widths, bits."""


@dataclass(frozen=True)
class CodeScale:
    """Mapping of R/R0 to codes. ``lo`` and ``hi`` are rounded to REAL32, as in the object dictionary.

    Raises:
        ConfigError: if the width is not 16 or 24 bits, or the range is not 0 ≤ lo < hi < ∞.
    """

    bits: int = 16
    """Width of a code, bits."""
    lo: float = DEFAULT_CODE_LO
    """R/R0 at code 0."""
    hi: float = DEFAULT_CODE_HI
    """R/R0 at the highest measurement code."""

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
        """Highest measurement code, at ``hi``."""
        return (1 << self.bits) - 4

    @property
    def over_range(self) -> int:
        """Reserved code for R/R0 outside lo … hi, or for a crossing without a baseline."""
        return self.steps + 1

    @property
    def short(self) -> int:
        """Reserved code for zero resistance between the wires."""
        return self.steps + 2

    @property
    def open(self) -> int:
        """Reserved code for no connection between the wires."""
        return self.steps + 3

    @functools.cached_property
    def step(self) -> float:
        """Step from one code to the next, relative to R0."""
        return (self.hi - self.lo) / self.steps

    @property
    def relative_std(self) -> float:
        """RMS rounding error relative to R0: step / √12, for an error uniformly distributed over one step."""
        return self.step / math.sqrt(12.0)


def as_baseline(baseline_ohm: ArrayLike) -> Float:
    """Round R0 to REAL32, the precision that both node and host use.

    Args:
        baseline_ohm: any shape, ohm.

    Returns:
        float64 of the same shape, ohm.
    """
    return np.asarray(baseline_ohm, dtype=np.float32).astype(np.float64)


def encode(resistance_ohm: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> Codes:
    """Encode resistances.

    +inf and NaN become the code for open; zero and negative values become the code for short. R/R0 outside lo
    … hi becomes the over-range code, as does a measurement without a baseline (R0 not positive and finite). A
    value up to half a step outside the range counts as inside.

    Args:
        resistance_ohm: any shape, ohm.
        baseline_ohm: R0 in ohm, with the same shape or broadcastable to it.
        scale: the mapping of R/R0 to codes.

    Returns:
        Codes with the same shape as ``resistance_ohm``.
    """
    resistance = np.asarray(resistance_ohm, dtype=np.float64)
    baseline = as_baseline(baseline_ohm)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        code = np.rint((resistance / baseline - scale.lo) / scale.step)
        measured = (code >= 0) & (code <= scale.steps) & (baseline > 0) & (baseline < np.inf)
        codes = np.where(measured, code, scale.over_range)
        codes = np.where(resistance <= 0, scale.short, codes)
        codes = np.where(resistance < np.inf, codes, scale.open)  # NaN also fails this comparison
    return codes.astype(np.uint32)


def decode(codes: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> tuple[Float, NDArray[np.bool_]]:
    """Decode codes into resistances.

    Args:
        codes: any shape.
        baseline_ohm: R0 in ohm, with the same shape or broadcastable to it.
        scale: the mapping of R/R0 to codes.

    Returns:
        Resistances in ohm and a mask of the measurements, both with the same shape as ``codes``. A reserved
        code, :data:`MISSING` or a baseline that is not positive and finite gives NaN and False.
    """
    return Decoder(baseline_ohm, scale).decode(codes)


class Decoder:
    """Decoder equivalent to :func:`decode`, for many scans with the same baseline.

    Args:
        baseline_ohm: R0 in ohm, with the shape of the codes or broadcastable to it.
        scale: the mapping of R/R0 to codes.
    """

    def __init__(self, baseline_ohm: ArrayLike, scale: CodeScale) -> None:
        self._baseline, self._scale = as_baseline(baseline_ohm), scale
        known = (self._baseline > 0) & (self._baseline < np.inf)
        self._known: NDArray[np.bool_] | None = None if known.all() else known

    def decode(self, codes: ArrayLike) -> tuple[Float, NDArray[np.bool_]]:
        """Decode codes as :func:`decode` does.

        Args:
            codes: any shape.

        Returns:
            Resistances in ohm and the mask of measurements.
        """
        code, scale = np.asarray(codes), self._scale
        valid: NDArray[np.bool_] = code <= scale.steps
        if self._known is not None:
            valid = valid & self._known
        resistance = (scale.lo + code * scale.step) * self._baseline
        if not valid.all():
            resistance = np.where(valid, resistance, np.nan)
        return resistance, valid
