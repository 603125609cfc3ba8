"""What the inverse of an earlier position still tells of a wire, compiled: whether its resistances changed
beyond their noise, and where it went if it did not go far.

A wire can be held: ρ_k = a_k F_k(x) − 1 at its last position is known without evaluating F, which the last
solve did, and within noise when Σ (ρ_k/σ_k)² is below its 99 % quantile. In ρ the noise of the new frame,
variance σ², meets the error of x, which is s² = the noise solved into it and lies in the n directions of the
range of J. With t = s²/σ² the sum has mean K + n t and half its variance is K + 2 n t + n t² (2 χ²_K for a
square system, χ²_K at rest, t = 0), and the quantile is that of the c χ²_ν with the same two (Satterthwaite
1946).

A slow move can hide in that sum, most of all in the direction a wire knows least, one of K. So a held
coordinate owns up to it: its correction c = Σ_k (∂x_j/∂r_k) ρ_k is the move and twice its deviation, and
where c² is more than noise, the rest is added. Coverage of the 95 % intervals, staggered h = 0.5, noise
1e-5: 98 % unmoved (99 % of the frames held), 97 % on a press growing by 5 % of h in 100 to 1600 frames,
96 % on a move along the direction known least by 40 deviations in 200 or 800 frames; there 86 % without.

A wire that moved a little is followed: simplified Newton steps with the old inverse need F alone, and end by
the same test as Newton's (Deuflhard, Newton methods for nonlinear problems, 2004, 2.1). How fast they
contract is how much the inverse has changed since, along the way gone; while that is little, the inverse is
kept for the deviations too.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, total
from skinnode.model.kernels import potential
from skinnode.model.layout import Float
from skinnode.solve.linalg.factorisations import largest

# Normal deviates of the quantiles used
Z_HOLD: Final = 2.326
"""99 %: an unmoved wire is solved for nothing once in a hundred frames."""
FRESHER: Final = 2.0
"""A frame whose noise has less than 1/2 of the variance solved into x is worth a solve."""
FOLLOW_STEPS: Final = 4
"""Most simplified steps; each costs a fifth of a new inverse."""
CONTRACTION: Final = 0.1
"""A step above this share of the one before is not taken: a new Jacobian is then due."""
FRESH: Final = 0.01
"""The inverse is kept while the first step is below this share of the prediction."""


def chi2_quantile(dof: float, z: float) -> float:
    """Quantile of χ² at normal deviate ``z`` (Wilson & Hilferty 1931); within 1 % at 99 % from 3 degrees on,
    never too small far out."""
    spread = 2.0 / (9.0 * dof)
    root = 1.0 - spread + z * math.sqrt(spread)
    return dof * root * root * root


chi2_quantile_part = njit_part(chi2_quantile)


@njit_part
def within_noise(
    a: Float, weight: Float, sigma: float, tol: float, a_solved: Float, noise: Float, inverse: Float,
    unknowns: int, rho: Float, variance: Float, before: Float, std: Float,
) -> float:  # fmt: skip
    """RMS of w ρ where the wire can be held, −1 where not; ``std`` (n,) of the unknowns of a held wire.

    ``noise`` (K,) is the variance solved into x; ``rho``, ``variance`` and ``before`` (K,) are room to work
    in. What a held coordinate may be off by is the largest of the noise solved into it, that of the frame
    which saw it unmoved, and what its correction has beyond both.
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


@njit_part
def step_back(inverse: Float, rho: Float, step: Float) -> float:
    """−Σ_k (∂x_j/∂r_k) ρ_k into ``step`` (n,); its largest element."""
    for j in range(step.size):
        row, along = inverse[j], splat(0.0)
        for k in range(0, rho.size, LANES):
            along = fma(load(row, k, rho.size - k), load(rho, k, rho.size - k), along)
        step[j] = -total(along)
    return largest(step)


@njit_part
def deviations(inverse: Float, variance: Float, std: Float) -> None:
    """√Σ_k (∂x_j/∂r_k)² σ_k² into ``std`` (n,)."""
    for j in range(std.size):
        row, square = inverse[j], splat(0.0)
        for k in range(0, variance.size, LANES):
            slope = load(row, k, variance.size - k)
            square = fma(slope * slope, load(variance, k, variance.size - k), square)
        std[j] = math.sqrt(total(square))


@njit_part
def follow(
    x: Float, lower: Float, a: Float, inverse: Float, moved: float, tol_f: float, tol_x: float,
    rho: Float, step: Float,
) -> tuple[int, int, float]:  # fmt: skip
    """Simplified Newton steps of a square system whose unknowns are all coordinates ``x`` (3N,), which the
    prediction has ``moved`` so far.

    Returns the number of evaluations of F, negative if they led to no root, the number of steps that ``x``
    took, and the first step as a share of the prediction. A root is ``x`` + ``step``, and ``rho`` (K,) that
    of ``x``; else ``x`` is the best there is.
    """
    before, first = moved, math.inf
    for evaluations in range(1, FOLLOW_STEPS + 1):
        potential(x, lower, rho)
        for k in range(rho.size):
            rho[k] = a[k] * rho[k] - 1.0
        size = step_back(inverse, rho, step)
        if not size <= CONTRACTION * before:
            return -evaluations, evaluations - 1, first
        if evaluations == 1:
            first = size / before
        if size <= tol_x * max(1.0, largest(x)) and largest(rho) <= tol_f:
            return evaluations, evaluations - 1, first
        for j in range(x.size):
            x[j] += step[j]
        before = size
    return -FOLLOW_STEPS, FOLLOW_STEPS, first
