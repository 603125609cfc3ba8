"""Compute the probability that a running converter with a given noise repeats its codes.

The probability that a reading has the same code as the previous reading is at most 2Φ(1/2σ) − 1, where σ is
the standard deviation of the noise in codes. This bound is reached if the true value is in the middle of a
quantization step, as for skin at rest after a tare. Under a press, each crossing has a different value, so
the position of the value within its quantization step is practically random. For a random position, the
probability that n + 1 readings of one crossing all fall into the same code is E max(0, 1 − σ R), where R is
the range of n + 1 standard normal variables. For random positions, the probability of repeated codes is much
lower than the bound, even for a converter with little noise.
"""

from __future__ import annotations

import functools
import math
from typing import Final

_EDGES: Final = 0.1
"""Upper limit of σ; larger values are replaced by the limit. Up to the limit, σ R is less than 1 for all
relevant runs, so that E max(0, 1 − σ R) = 1 − σ E R.
"""


def log_stay(sigma: float) -> float:
    """Return the natural logarithm of the maximum probability that a reading repeats the previous code.

    Args:
        sigma: Standard deviation of the noise, codes.
    """
    if sigma <= 0.0:
        return 0.0
    leaves = math.erfc(0.5 / (sigma * math.sqrt(2.0)))
    return math.log1p(-leaves) if leaves < 1.0 else -math.inf


def log_stay_anywhere(sigma: float, run: int) -> float:
    """Return the log probability that a code repeats ``run`` times.

    The true value is assumed to be at a random position within the quantization step.

    Args:
        sigma: Standard deviation of the noise, codes.
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
    """Return the z-score that a standard normal variable exceeds with probability exp(log_p)."""
    if log_p > -1.0:
        return 0.0
    z = math.sqrt(-2.0 * log_p)
    for _ in range(4):  # z² = -2 ln p - ln 2π - 2 ln z, for the tail φ(z)/z
        z = math.sqrt(max(-2.0 * log_p - math.log(2.0 * math.pi) - 2.0 * math.log(max(z, 1.0)), 0.0))
    return z
