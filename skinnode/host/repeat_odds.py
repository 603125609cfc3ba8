"""Compute the probability that a running converter with a given noise repeats its codes.

A reading repeats the previous code with a probability of at most 2Φ(1/2σ) − 1, where σ is the standard
deviation of the noise in codes. This maximum is reached if the true value lies in the middle of a
quantization step, as it does at rest after a tare.

During a press, the crossings have different values, whose positions within their quantization steps are
practically random. For a random position, n + 1 readings of one crossing all yield the same code with
probability E max(0, 1 − σ R), where R is the range of n + 1 standard normal variables. This is much less than
the maximum, even for a converter with little noise.
"""

from __future__ import annotations

import functools
import math
from typing import Final

_EDGES: Final = 0.1
"""Upper limit for σ; larger values are clipped. Up to this limit, σ R < 1 for all relevant runs and E max(0,
1 − σ R) = 1 − σ E R.
"""


def log_stay(sigma: float) -> float:
    """Return the logarithm of the maximum probability that a reading repeats the previous code.

    Args:
        sigma: Standard deviation (codes) of the noise.
    """
    if sigma <= 0.0:
        return 0.0
    leaves = math.erfc(0.5 / (sigma * math.sqrt(2.0)))
    return math.log1p(-leaves) if leaves < 1.0 else -math.inf


def log_stay_anywhere(sigma: float, run: int) -> float:
    """Return the logarithm of the probability that a code is repeated ``run`` times.

    The position of the true value within its quantization step is assumed to be random.

    Args:
        sigma: Standard deviation (codes) of the noise.
        run: Number of repetitions.
    """
    return math.log1p(-min(sigma, _EDGES) * _mean_range(run + 1))


@functools.lru_cache(maxsize=256)
def _mean_range(count: int) -> float:
    """Return the mean range of ``count`` standard normal variables: ∫ 1 − Φⁿ − (1 − Φ)ⁿ."""
    step = 0.02
    total = 0.0
    for i in range(-450, 451):
        below = 0.5 * math.erfc(-i * step / math.sqrt(2.0))
        total += 1.0 - below**count - (1.0 - below) ** count
    return min(total * step, 0.999 / _EDGES)


def deviations_of(log_p: float) -> float:
    """Return the value that a standard normal variable exceeds with probability exp(``log_p``)."""
    if log_p > -1.0:
        return 0.0
    z = math.sqrt(-2.0 * log_p)
    for _ in range(4):  # z² = -2 ln p - ln 2π - 2 ln z, for the tail φ(z)/z
        z = math.sqrt(max(-2.0 * log_p - math.log(2.0 * math.pi) - 2.0 * math.log(max(z, 1.0)), 0.0))
    return z
