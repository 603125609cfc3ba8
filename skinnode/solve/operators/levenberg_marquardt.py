"""Levenberg-Marquardt step (Moré, The Levenberg-Marquardt algorithm, 1978, section 5)."""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.bidiagonal import (
    bidiagonal_solve,
    bidiagonal_solve_transposed,
    bidiagonalise,
    damped_solve,
    reflect,
)
from skinnode.solve.linalg.vectors import dot
from skinnode.solve.operators.work import LAM, NEWTON_LENGTH, RADIUS, REDUCED, SINGULAR, Work


@njit_part
def marquardt_step(w: Work) -> None:  # noqa: C901 - Moré's iteration in one piece
    """Set a damped step s for which ‖D s‖ is within 10 % of the radius.

    The damping parameter lam is found by Newton's method (Moré, section 5). The bidiagonal form of J D⁻¹ is
    computed once per Jacobian. Since s = D⁻¹ P t and ‖D s‖ = ‖t‖, each value of lam then takes O(n)
    operations.
    """
    (n, m), s, t = w.jt.shape, w.s, w.step
    radius = s[RADIUS]
    if w.flag[REDUCED] == 0:
        w.flag[REDUCED] = 1
        for j in range(n + 3):
            target = w.right[j]
            for k in range(target.size):
                target[k] = 0.0
            if j < n:
                source, share = w.jt[j], 1.0 / w.scale[j]
                for k in range(m):
                    target[k] = source[k] * share
        bidiagonalise(w.right, w.left, w.bd, w.bu, w.across, w.down, w.wide)
    for k in range(m):
        w.e[k] = -w.r[k]
    for k in range(n):
        reflect(w.right, w.across, k, w.e)
    square = 0.0
    for j in range(n):
        square += (w.gradient[j] / w.scale[j]) ** 2
        t[j] = w.e[j]
        w.inverse[j] = 1.0 / w.bd[j]
    gradient = math.sqrt(square)
    low, high = 0.0, gradient / radius
    if w.flag[SINGULAR] == 0:
        bidiagonal_solve(w.inverse, w.bu, t)
        bound = (s[NEWTON_LENGTH] - radius) / (radius * _decrease(w.inverse, w.bu, t, s[NEWTON_LENGTH], w.v))
        if bound < math.inf:
            low = bound
    lam = min(max(s[LAM], low), high)
    before = 0.0
    for _ in range(10):
        if lam == 0.0:
            lam = 1e-3 * high
        damped_solve(w.bd, w.bu, w.e, lam, w.inverse, w.ru, t)
        length = math.sqrt(dot(t, t))
        excess = length - radius
        if abs(excess) <= 0.1 * radius or (low == 0.0 and excess <= before < 0.0):
            break
        before = excess
        if excess > 0.0:
            low = max(low, lam)
        else:
            high = min(high, lam)
        lam = max(low, lam + excess / (radius * _decrease(w.inverse, w.ru, t, length, w.v)))
    s[LAM] = lam
    for k in range(n - 2, -1, -1):
        reflect(w.left, w.down, k, t)
    for j in range(n):
        t[j] /= w.scale[j]


@njit_part
def _decrease(inverse: Float, upper: Float, t: Float, length: float, v: Float) -> float:
    """Return ‖R⁻ᵀ t / ‖t‖‖², the relative decrease in ‖t‖ per unit of lam; ``v`` (n,) is a work array."""
    share = 1.0 / length
    for j in range(t.size):
        v[j] = t[j] * share
    bidiagonal_solve_transposed(inverse, upper, v)
    return dot(v, v)
