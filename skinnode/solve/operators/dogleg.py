"""Dogleg step (Powell, A hybrid method for nonlinear equations, 1970)."""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit_part
from skinnode.solve.linalg.vectors import dot
from skinnode.solve.operators.work import RADIUS, SINGULAR, Work, times_jacobian


@njit_part
def dogleg_step(w: Work) -> None:
    """Set the dogleg step: along −D⁻²g to the Cauchy point, then to the Newton point; stop at the radius."""
    n, radius = w.x.size, w.s[RADIUS]
    square = 0.0
    for j in range(n):
        w.v[j] = -w.gradient[j] / w.scale[j] ** 2
        square += w.gradient[j] * -w.v[j]
    times_jacobian(w.jt, w.v, w.js)
    curvature = dot(w.js, w.js)
    length = math.sqrt(square)
    cauchy = square / curvature if curvature > 0.0 else math.inf
    if cauchy * length >= radius:
        for j in range(n):
            w.step[j] = w.v[j] * (radius / length)
        return
    for j in range(n):
        w.step[j] = w.v[j] * cauchy
    if w.flag[SINGULAR] == 1:
        return
    a, b, c = 0.0, 0.0, (cauchy * length) ** 2 - radius * radius
    for j in range(n):
        leg = w.newton[j] - w.step[j]
        weight = w.scale[j] ** 2
        a += weight * leg * leg
        b += weight * leg * w.step[j]
    if a == 0.0:  # the Cauchy and Newton points coincide, as they always do with one unknown
        return
    root = math.sqrt(b * b - a * c)
    share = min(-c / (b + root) if b > 0.0 else (root - b) / a, 1.0)
    for j in range(n):
        w.step[j] += share * (w.newton[j] - w.step[j])
