"""Smooth motion profiles that rise from 0 to 1."""

from __future__ import annotations

from typing import Final

GLIDE_RAMP: Final = 0.2
"""Duration of a glide's acceleration phase, and also of its deceleration phase, as a fraction of the
glide."""


def ease(share: float) -> float:
    """Rise from 0 to 1 with zero speed and acceleration at both ends: minimum jerk (Flash and Hogan 1985).

    Args:
        share: Elapsed fraction of the duration; the result is 0 below 0 and 1 above 1.
    """
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


def glide(share: float) -> float:
    """Rise from 0 to 1 at constant speed, with smooth ramps of length ``GLIDE_RAMP`` at both ends.

    Args:
        share: Elapsed fraction of the duration; the result is 0 below 0 and 1 above 1.
    """
    s = min(max(share, 0.0), 1.0)
    if s > 0.5:
        return 1.0 - glide(1.0 - s)
    ramped = min(s / GLIDE_RAMP, 1.0)
    gained = GLIDE_RAMP * ramped**3 * (1.0 - 0.5 * ramped)  # integral of the speed profile 3 s² − 2 s³
    return (gained + max(s - GLIDE_RAMP, 0.0)) / (1.0 - GLIDE_RAMP)
