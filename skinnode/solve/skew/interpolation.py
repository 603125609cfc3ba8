"""Uncertainty of a value that is interpolated between two scans."""

from __future__ import annotations

import numpy as np

from skinnode.model.layout import Float


def timing_variance(f: Float | float) -> Float:
    """Return the variance of an interpolated value, relative to the square of its deviation Δ from a line.

    Δ is the difference between the last value and the line through the two values before it. Its cause
    occurred at a random time between the last two scans:

    - A jump by Δ. With a probability of 1 − f, the value has already jumped. The interpolated value is the
      mean, and its variance is f (1 − f) Δ².
    - A change of speed at a time s (in intervals) before the last scan. The error is (1 − f) Δ if s < f,
      otherwise f (1/s − 1) Δ. The mean square over s is 2 f (1 − f + f ln f) Δ².

    The function returns the larger of the two. A constant acceleration causes a smaller error,
    f (1 − f) Δ / 2.

    Args:
        f: Share of the earlier scan in the interpolation, 0 to 1; any shape.
    """
    share = np.asarray(f, np.float64)
    speed = 2.0 * (1.0 - share + share * np.log(np.maximum(share, 1e-300)))
    return np.asarray(share * np.maximum(1.0 - share, speed))
