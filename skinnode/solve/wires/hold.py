"""Whether a wire can be left where it is: whether its resistances changed beyond their noise, compiled.

ρ_k = a_k F_k(x) − 1 at the last position is known without evaluating F, which the last solve did, and is
within noise when Σ (ρ_k/σ_k)² is below its 99 % quantile. In ρ the noise of the new frame, variance σ², meets
the error of x, which is s² = the noise solved into it and lies in the n directions of the range of J. With t
= s²/σ² the sum has mean K + n t and half its variance is K + 2 n t + n t² (2 χ²_K for a square system, χ²_K
at rest, t = 0), and the quantile is that of the c χ²_ν with the same mean and variance (Satterthwaite 1946).

A slow move can hide in that sum, most of all in the direction a wire knows least, one of K. So a held
coordinate admits it: its correction c = Σ_k (∂x_j/∂r_k) ρ_k is the move and twice its standard deviation, and
where c² is more than noise, the rest is added. Coverage of the 95 % intervals, staggered h = 0.5, noise 1e-5:
98 % unmoved (99 % of the frames held), 97 % on a press growing by 5 % of h in 100 to 1600 frames, 96 % on a
move along the direction known least by 40 standard deviations in 200 or 800 frames; there 86 % without.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, total
from skinnode.model.layout import Float

Z_HOLD: Final = 2.326
"""Normal deviate of the 99 % quantile: an unmoved wire is solved for nothing once in a hundred frames."""
FRESHER: Final = 2.0
"""Maximum ratio of the variance solved into x to that of the frame, for a wire to be held."""


def chi2_quantile(dof: float, z: float) -> float:
    """Return the quantile of χ² at normal deviate ``z`` (Wilson & Hilferty 1931).

    Within 1 % at 99 % from 3 degrees of freedom on, never too small far out.
    """
    spread = 2.0 / (9.0 * dof)
    root = 1.0 - spread + z * math.sqrt(spread)
    return dof * root * root * root


chi2_quantile_part = njit_part(chi2_quantile)


@njit_part
def within_noise(  # noqa: PLR0913 - arrays of one wire
    a: Float, weight: Float, sigma: float, tol: float, a_solved: Float, noise: Float, inverse: Float,
    unknowns: int, rho: Float, variance: Float, before: Float, std: Float,
) -> float:  # fmt: skip
    """Return the RMS of w ρ if the wire can be held, else −1; write ``std`` (n,) of a held wire's unknowns.

    ``noise`` (K,) is the variance solved into x; ``rho``, ``variance`` and ``before`` (K,) are scratch. The
    variance of a held coordinate is the largest of three: the noise solved into it, that of the frame which
    saw it unmoved, and what its correction has beyond both.
    """
    count, square, weighted, ratios, squares = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(a.size):
        rho[k] = variance[k] = before[k] = 0.0
        if weight[k] > 0.0:
            count += 1
            rho[k] = a[k] / a_solved[k] - 1.0
            deviation = sigma / weight[k]
            variance[k] = deviation * deviation + tol * tol
            before[k] = noise[k]
            ratio = noise[k] / variance[k]
            ratios += ratio
            squares += ratio * ratio
            square += rho[k] * rho[k] / variance[k]
            weighted += weight[k] * weight[k] * rho[k] * rho[k]
    if not ratios <= FRESHER * count:
        return -1.0
    share = unknowns / count
    mean = count + share * ratios
    half = count + share * (2.0 * ratios + squares)
    if not square <= half / mean * chi2_quantile_part(mean * mean / half, Z_HOLD):
        return -1.0
    for j in range(unknowns):
        row = inverse[j]
        along, then, now = splat(0.0), splat(0.0), splat(0.0)
        for k in range(0, a.size, LANES):
            left = a.size - k
            slope = load(row, k, left)
            along = fma(slope, load(rho, k, left), along)
            slope = slope * slope
            then = fma(slope, load(before, k, left), then)
            now = fma(slope, load(variance, k, left), now)
        solved, seen = total(then), total(now)
        std[j] = math.sqrt(max(solved, max(seen, total(along) ** 2 - solved - seen)))
    return math.sqrt(weighted / count)
