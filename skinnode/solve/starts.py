"""Starting points for solves that have no earlier solution nearby.

``guided_start`` computes the maximum a posteriori estimate of a displacement, with a smoothness prior and
with noise that decreases from one Gauss-Newton step to the next (Tarantola 2005, section 3.4).

``near_twin`` estimates the twin of a root, which is the root on the other side of the nearest fold. Let σ be
the smallest singular value of J at the root x, with left singular vector w and right singular vector v. To
second order, x + α v is a root if σ α + ½ α² wᵀF″[v, v] = 0. The twin is therefore at α = −2σ / wᵀF″[v, v]
(Golubitsky & Schaeffer 1985, chapter I.3).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.kernels import potential_jacobian, relative_residual_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.lu import lu_factor, lu_solve_transposed
from skinnode.solve.linalg.vectors import Index, dot, largest, padded
from skinnode.solve.wires.problem import PatchProblem

NOISE_LEVELS: Final[Float] = np.power(10.0, -0.5 * np.arange(2.0, 16.0))
"""Standard deviations of r in the successive steps of the guided start: two per decade, from 0.1 to 3e-8.

With one per decade, the guided start fails on an additional 1 % of simulated wires.
"""
POWER_STEPS: Final = 8
"""Number of inverse iterations used to find the smallest singular value of J. The next singular value is
about three times as large, so the iteration converges quickly."""
DIFFERENCE: Final = 1e-4
"""Step in either direction for the central difference of two Jacobians, in pitches. It is much larger than
eps^(1/3) = 6e-6, which makes rounding errors negligible."""


def guided_start(problem: PatchProblem, wire: int, a: Float, covariance: Float) -> tuple[Float, int]:
    """Compute a starting point near the likeliest root of a F = 1.

    Args:
        problem: The patch.
        wire: Index of the upper wire.
        a: (K,) scaled resistances R · gain of the wire.
        covariance: (n, n) prior covariance of the displacement of the wire, in pitch².

    Returns:
        The position (n,) in pitches (the rest position if the iteration fails), and the number of evaluations
        of F and J.
    """
    n, equations = problem.rest.shape[1], a.size
    x = problem.rest[wire].copy()
    y, (jt, spread) = np.empty(equations), np.empty((2, n, equations))
    inner, pivot = padded(equations + 3, equations), np.empty(equations, np.int64)
    evaluations = _follow_noise(
        x, problem.rest[wire], problem.lower, a, covariance, NOISE_LEVELS, y, jt, spread, inner, pivot
    )
    return x, evaluations


@njit
def _follow_noise(  # noqa: PLR0913, C901 - a kernel: arrays and scratch by name, sums as loops
    x: Float,
    rest: Float,
    lower: Float,
    a: Float,
    covariance: Float,
    noises: Float,
    y: Float,
    jt: Float,
    spread: Float,
    inner: Float,
    pivot: Index,
) -> int:
    """Update ``x`` by one Gauss-Newton step per noise level σ: x ← rest + C Jᵀ (J C Jᵀ + σ²)⁻¹ y.

    Here, y = J (x − rest) − r. The arguments after ``noises`` are work arrays. Returns the number of
    evaluations of F and J.
    """
    n, equations = jt.shape
    for level in range(noises.size):
        potential_jacobian(x, lower, y, jt)
        for k in range(equations):
            y[k] = -relative_residual_part(a[k], y[k])
        for i in range(n):
            row, moved = jt[i], x[i] - rest[i]
            for k in range(equations):
                row[k] *= a[k]
                y[k] += moved * row[k]
        inner[:equations, :equations] = 0.0
        for i in range(n):
            target, source = spread[i], jt[i]
            target[:] = 0.0
            for j in range(n):
                share = covariance[i, j]
                if share != 0.0:
                    row = jt[j]
                    for k in range(equations):
                        target[k] += share * row[k]
            for k in range(equations):
                row = inner[k]
                for m in range(equations):
                    row[m] += source[k] * target[m]
        for k in range(equations):
            inner[k, k] += noises[level] * noises[level]
        found = lu_factor(inner, pivot) != 0
        if found:
            lu_solve_transposed(inner, pivot, y)
            for i in range(n):
                x[i] = rest[i] + dot(spread[i], y)
        if not (found and largest(x) < math.inf):
            for i in range(n):
                x[i] = rest[i]
            return level + 1
    return noises.size


def near_twin(problem: PatchProblem, x: Float, a: Float, inverse: Float) -> Float:
    """Estimate the twin of a root: the root on the other side of the nearest fold.

    Args:
        problem: The patch.
        x: (n,) root of a wire, in pitches.
        a: (K,) scaled resistances R · gain of the wire.
        inverse: (n, K) ∂x/∂r at ``x``.

    Returns:
        (n,) position of the twin, in pitches; not finite if no twin exists to second order.
    """
    w = np.ones(a.size)
    for _ in range(POWER_STEPS):
        w = (inverse @ w) @ inverse
        w /= math.sqrt(w @ w)
    v = inverse @ w
    least = 1.0 / math.sqrt(v @ v)
    v *= least
    f, jt = np.empty(a.size), np.empty((x.size, a.size))
    slopes = []
    for side in (DIFFERENCE, -DIFFERENCE):
        potential_jacobian(x + side * v, problem.lower, f, jt)
        slopes.append(v @ (jt * a))
    curvature = w @ (slopes[0] - slopes[1]) / (2.0 * DIFFERENCE)
    return np.asarray(x - 2.0 * least / curvature * v)
