"""Compiled test for whether the resistances of a wire have changed by more than their noise.

A wire whose resistances have not changed significantly is held: its last position x is kept, and the wire is
not solved again. The test uses the residual ρ_k = a_k F_k(x) − 1, where F_k(x) is known from the last solve.
A wire is held if the sum Σ (ρ_k/σ_k)² is below its 99 % quantile. Two errors contribute to ρ. The noise of
the new frame has variance σ². The noise of the frame for which x was solved causes an error with variance s²
in the n directions of the range of J. With t = s²/σ², the mean of the sum is K + n t, and half of its
variance is K + 2 n t + n t². The quantile is taken from a scaled distribution c χ²_ν with the same mean and
variance (Satterthwaite 1946).

The test may miss a slow movement, so the variance of a held coordinate includes an estimate of the movement.
The correction c = Σ_k (∂x_j/∂r_k) ρ_k of a coordinate is caused by the movement and by the noise of both
frames. The variance of the coordinate is therefore set to at least c² minus the variance due to noise. In
simulations of the staggered layout (h = 0.5, noise 1e-5), the 95 % intervals of held coordinates contained
the true position in 98 % of the frames without movement, and in 96 to 97 % of the frames with slow movements.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, total
from skinnode.model.layout import Float

Z_HOLD: Final = 2.326
"""99 % quantile of the standard normal distribution. A wire at rest fails the test in 1 % of the frames."""
FRESHER: Final = 2.0
"""Maximum ratio of the noise variance of the frame for which x was solved to that of the current frame. Above
this ratio, a wire is not held."""


def chi2_quantile(dof: float, z: float) -> float:
    """Return the χ² quantile that has the same probability as the normal quantile ``z``.

    The quantile is approximated by the formula of Wilson & Hilferty (1931). At 99 %, the error of this
    approximation is below 1 % for 3 or more degrees of freedom. At very high probabilities, the quantile is
    never underestimated.
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
    """Return the RMS of w ρ and compute ``std`` (n,) if the wire can be held; otherwise return −1.

    ``noise`` (K,) is the noise variance of the frame for which x was solved. ``rho``, ``variance`` and
    ``before`` (K,) are workspace. The variance of a held coordinate is the maximum of three values: the
    variance due to ``noise``, the variance due to the noise of the current frame, and the squared correction
    minus both of these variances.
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
