"""Compiled test for holding a wire whose resistances changed no more than their noise.

The residual ρ_k = a_k F_k(x) − 1 at the last position is known from the last solve, without evaluating F
again. The residual is within noise if the sum Σ (ρ_k/σ_k)² is below its 99 % quantile. Two errors contribute
to ρ. The first is the noise of the new frame, with variance σ². The second is the error of x, which results
from the noise of the frame used to solve for x; its variance is s² in the n directions of the range of J.
With t = s²/σ², the mean of the sum is K + n t, and half its variance is K + 2 n t + n t². (At rest, t = 0 and
the sum is χ²_K; in a square system with t = 1, the sum is 2 χ²_K.) The quantile is that of the scaled
distribution c χ²_ν with the same mean and variance (Satterthwaite 1946).

A slow movement may leave Σ (ρ_k/σ_k)² below the quantile, especially a movement along the worst-determined of
a wire's K directions. The variance of a held coordinate allows for such a movement. The coordinate's
correction c = Σ_k (∂x_j/∂r_k) ρ_k contains the movement and the noise of both frames, so c² minus the noise
variance is used as a lower bound on the coordinate's variance. The coverage of the 95 % intervals was
measured on the staggered layout, h = 0.5, with noise 1e-5. For motionless wires, which are held in 99 % of
the frames, the coverage is 98 %. For a press that grows by 5 % of h in 100 to 1600 frames, the coverage is 97
%. For a movement of 40 standard deviations along the worst-determined direction within 200 or 800 frames, the
coverage is 96 %; without the allowance, it would be only 86 %.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, total
from skinnode.model.layout import Float

Z_HOLD: Final = 2.326
"""Normal quantile for 99 %, at which a motionless wire is solved unnecessarily in one frame of a hundred."""
FRESHER: Final = 2.0
"""Maximum ratio of noise variances for holding a wire: the frame used to solve for x, relative to the
current frame."""


def chi2_quantile(dof: float, z: float) -> float:
    """Return the χ² quantile that corresponds to the normal quantile ``z`` (Wilson & Hilferty 1931).

    At the 99 % quantile, the error is below 1 % for 3 or more degrees of freedom; the result is never too
    small in the far tail.
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
    """Return the RMS of w ρ if the wire can be held, else −1; if held, write ``std`` (n,) of its unknowns.

    ``noise`` (K,) is the noise variance of the frame used to solve for x; ``rho``, ``variance`` and
    ``before`` (K,) are scratch. The variance of a held coordinate is the largest of three values: the
    variance due to ``noise``, the variance due to the noise of the current frame, and the squared correction
    minus these two variances.
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
