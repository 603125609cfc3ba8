"""Compiled solver that reuses the J⁻¹ of an earlier solve, for wires that moved only slightly.

The solver takes simplified Newton steps, which do not evaluate J (Deuflhard, Newton methods for nonlinear
problems, 2004, section 2.1). If successive steps shrink quickly, the inverse is still accurate, and the
standard deviations are also computed from it.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, total
from skinnode.model.kernels import potential, relative_residual_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import largest

FOLLOW_STEPS: Final = 4
"""Maximum number of simplified Newton steps. One step takes a fifth of the time of a new inverse."""
CONTRACTION: Final = 0.1
"""Ratio of successive simplified Newton steps above which the wire is solved with a new Jacobian instead."""
FRESH: Final = 0.01
"""Ratio of the first simplified Newton step to the predicted step above which the old inverse is replaced."""


@njit_part
def newton_step(inverse: Float, rho: Float, step: Float) -> float:
    """Compute ``step`` (n,) = −Σ_k (∂x_j/∂r_k) ρ_k; return its maximum norm."""
    for j in range(step.size):
        row, along = inverse[j], splat(0.0)
        for k in range(0, rho.size, LANES):
            along = fma(load(row, k, rho.size - k), load(rho, k, rho.size - k), along)
        step[j] = -total(along)
    return largest(step)


@njit_part
def standard_deviations(inverse: Float, variance: Float, std: Float) -> None:
    """Compute the standard deviations ``std`` (n,) = √Σ_k (∂x_j/∂r_k)² σ_k²."""
    for j in range(std.size):
        row, square = inverse[j], splat(0.0)
        for k in range(0, variance.size, LANES):
            slope = load(row, k, variance.size - k)
            square = fma(slope * slope, load(variance, k, variance.size - k), square)
        std[j] = math.sqrt(total(square))


@njit_part
def follow(  # noqa: PLR0913 - arrays of one wire
    x: Float, lower: Float, a: Float, inverse: Float, moved: float, tol_f: float, tol_x: float,
    rho: Float, step: Float,
) -> tuple[int, int, float]:  # fmt: skip
    """Solve a square system for all coordinates ``x`` (3N,) of a wire by simplified Newton steps.

    ``moved`` is the size of the predicted step, which ``x`` already includes. Returns the number of
    evaluations of F (negative if no root was found), the number of steps added to ``x``, and the ratio of the
    first step to the predicted step. If a root was found, it is ``x`` + ``step``, and ``rho`` (K,) is the
    residual at ``x``; otherwise, ``x`` is the last iterate.
    """
    before, first = moved, math.inf
    for evaluations in range(1, FOLLOW_STEPS + 1):
        potential(x, lower, rho)
        for k in range(rho.size):
            rho[k] = relative_residual_part(a[k], rho[k])
        size = newton_step(inverse, rho, step)
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
