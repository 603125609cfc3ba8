"""Finds out whether a scan changes any chunk without encoding its resistances.

While the skin is at rest, the readings of the converter change by its noise only. A patch that sends only
changed chunks then sends none. Comparing the resistances with the limits of a band takes a fifth of the time
that encoding them and comparing the codes would take.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.layout import Float
from skinnode.protocol.codes import Codes, CodeScale, as_baseline

MARGIN: Final = 1e-3
"""Distance in codes between the limits of the band and the resistances at which a code would change. It is
much larger than the rounding error of an encoded resistance (:attr:`CodeScale.position_error`)."""


@dataclass(frozen=True, slots=True, eq=False)
class QuietBand:
    """Resistances for which no code differs from the last code sent by more than the threshold."""

    sent: Codes
    """(U, K) codes that were last sent."""
    threshold: int
    """Largest code change that is not sent."""
    low_ohm: Float
    """(U, K) float64, ohm: lowest resistances; all positive."""
    high_ohm: Float
    """(U, K) float64, ohm: highest resistances; all finite."""

    def contains(self, resistance_ohm: Float) -> bool:
        """Return whether all resistances lie in the band. They are then neither open nor shorted.

        Args:
            resistance_ohm: (U, K) float64, ohm; NaN lies outside the band.
        """
        inside = resistance_ohm >= self.low_ohm
        inside &= resistance_ohm <= self.high_ohm
        return bool(np.logical_and.reduce(inside, axis=None))

    @classmethod
    def of(cls, sent: Codes, threshold: int, baseline_ohm: ArrayLike, scale: CodeScale) -> QuietBand | None:
        """Return the band around the codes that were last sent, or None if there is none.

        There is none if a code is reserved, or if a baseline is unknown.

        Args:
            sent: (U, K) codes that were last sent; they are not modified later.
            threshold: Largest code change that is not sent.
            baseline_ohm: (U, K) baseline R0 in ohms.
            scale: Mapping of R/R0 to codes.
        """
        baseline = as_baseline(baseline_ohm)
        if int(sent.max()) > scale.steps or not ((baseline > 0.0) & (baseline < np.inf)).all():
            return None
        codes = sent.astype(np.int64)
        lowest = np.maximum(codes - threshold, 0) - 0.5 + MARGIN
        highest = np.minimum(codes + threshold, scale.steps) + 0.5 - MARGIN
        low = (scale.lo + lowest * scale.step) * baseline
        high = (scale.lo + highest * scale.step) * baseline
        if not ((low > 0.0) & (high < np.inf)).all():
            return None
        return cls(sent, threshold, low, high)
