"""Compiled solver for a wire that moved only a little; uses the inverse from an earlier position.

Simplified Newton steps with the old inverse require only F, not J, and use the same convergence test as
Newton's method (Deuflhard, Newton methods for nonlinear problems, 2004, 2.1). The contraction ratio of the
steps shows how much the inverse has changed along the path. While the change is small, the old inverse is
also used for the standard deviations.
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
"""Maximum number of simplified steps; each step takes a fifth of the time of a new inverse."""
CONTRACTION: Final = 0.1
"""Maximum size of a step, relative to the previous step. If a step is larger, a new Jacobian is required."""
FRESH: Final = 0.01
"""Maximum size of the first step, relative to the predicted step, for keeping the inverse."""


@njit_part
def newton_step(inverse: Float, rho: Float, step: Float) -> float:
    """Write −Σ_k (∂x_j/∂r_k) ρ_k into ``step`` (n,); return its largest absolute value."""
    for j in range(step.size):
        row, along = inverse[j], splat(0.0)
        for k in range(0, rho.size, LANES):
            along = fma(load(row, k, rho.size - k), load(rho, k, rho.size - k), along)
        step[j] = -total(along)
    return largest(step)


@njit_part
def standard_deviations(inverse: Float, variance: Float, std: Float) -> None:
    """Write √Σ_k (∂x_j/∂r_k)² σ_k² into ``std`` (n,)."""
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
    """Take simplified Newton steps for a square system in which all coordinates ``x`` (3N,) are unknowns.

    ``moved`` is the size of the predicted step that led to ``x``. Returns the number of evaluations of F
    (negative if no root was found), the number of steps added to ``x``, and the size of the first step
    relative to the prediction. If a root was found, the root is ``x`` + ``step``, and ``rho`` (K,) is the
    residual at ``x``. Otherwise, ``x`` is the best iterate.
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
