"""Smooth motion profiles from 0 to 1."""

from __future__ import annotations

from typing import Final

GLIDE_RAMP: Final = 0.2
"""Duration of each ramp in :func:`glide`, as a fraction of the total duration."""


def ease(share: float) -> float:
    """Return the value of a minimum-jerk profile that rises from 0 to 1 (Flash and Hogan 1985).

    Speed and acceleration are zero at both ends.

    Args:
        share: Elapsed fraction of the duration, clipped to the range 0 to 1.
    """
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


def glide(share: float) -> float:
    """Return the value of a profile that rises from 0 to 1, with constant speed between two smooth ramps.

    Args:
        share: Elapsed fraction of the duration, clipped to the range 0 to 1.
    """
    s = min(max(share, 0.0), 1.0)
    if s > 0.5:
        return 1.0 - glide(1.0 - s)
    ramped = min(s / GLIDE_RAMP, 1.0)
    gained = GLIDE_RAMP * ramped**3 * (1.0 - 0.5 * ramped)  # integral of the speed profile 3 s² − 2 s³
    return (gained + max(s - GLIDE_RAMP, 0.0)) / (1.0 - GLIDE_RAMP)
