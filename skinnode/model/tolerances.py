"""Manufacturing tolerances of a patch: how far it can differ from its layout."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Standard deviations of the differences between a real patch and its layout.

    Raises:
        ValueError: If a tolerance is negative, not finite, or 0.5 or greater.
    """

    placement: float = 0.0
    """Position of each upper and lower wire along each axis, in pitches."""
    thickness: float = 0.0
    """Rubber thickness between upper and lower electrodes, relative to the smallest distance between them."""
    electrode_radius: float = 0.0
    """Radius of the electrodes, in pitches; the forward model assumes point electrodes."""
    gain: float = 0.0
    """Front-end gain for changes in resistance, relative to the nominal gain."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (math.isfinite(value) and 0.0 <= value < 0.5):
                raise ValueError(f"{entry.name}: got {value}, must be at least 0 and below 0.5")

    @property
    def exact(self) -> bool:
        """Whether every tolerance is 0."""
        return self == EXACT


EXACT: Final = Tolerances()
"""Tolerances of a patch that matches its layout exactly, such as a simulated patch."""
ORDINARY: Final = Tolerances(placement=0.02, thickness=0.05, electrode_radius=0.05, gain=0.02)
"""Typical tolerances of carefully manufactured patches."""
