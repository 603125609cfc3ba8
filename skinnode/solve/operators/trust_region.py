"""Trust region ‖D s‖ ≤ radius for a step s: choice of the radius, and acceptance or rejection of the step.

A step is accepted only if it reduces ‖r‖ (Moré, The Levenberg-Marquardt algorithm, 1978).
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.solve.linalg.vectors import dot
from skinnode.solve.operators.codes import (
    ACCEPTED,
    CONVERGED,
    EPS,
    ILL_CONDITIONED,
    RADIUS_TOO_SMALL,
    REJECTED,
    STALL_LIMIT,
    STATIONARY,
    STEP_TOO_SMALL,
)
from skinnode.solve.operators.gauss_newton import rounding
from skinnode.solve.operators.work import (
    LAM,
    LENGTH,
    LIMIT,
    NEWTON_LENGTH,
    NORM,
    RADIUS,
    SINGULAR,
    STALLED,
    Work,
    weighted_norm,
)

SHRINK_BELOW: Final = 0.25
ENLARGE_ABOVE: Final = 0.75
REJECT_BELOW: Final = 1e-4
"""Thresholds for the ratio of the actual to the predicted decrease in ‖r‖² (Moré 1978): for shrinking the
radius (SHRINK_BELOW), for enlarging it (ENLARGE_ABOVE), and for rejecting the step."""


@njit_part
def slope_of(w: Work) -> float:
    """Write the gradient Jᵀr into the workspace; return the largest |J_j·r| / (D_j ‖r‖)."""
    top = 0.0
    for j in range(w.x.size):
        w.gradient[j] = dot(w.jt[j], w.r)
        top = max(top, abs(w.gradient[j]) / (w.scale[j] * w.s[NORM]))
    return top


@njit_part
def measure_newton(w: Work) -> None:
    """Update D and the length of the Newton step; on the first call, also set the initial radius.

    A negative LIMIT selects D = I and an initial radius of −LIMIT.
    """
    n, s = w.x.size, w.s
    if s[LIMIT] < 0.0:
        for j in range(n):
            w.scale[j] = 1.0
        if s[RADIUS] < 0.0:
            s[RADIUS] = -s[LIMIT]
        s[NEWTON_LENGTH] = weighted_norm(w.scale, w.newton) if w.flag[SINGULAR] == 0 else math.inf
        return
    for j in range(n):
        w.scale[j] = max(w.scale[j], math.sqrt(dot(w.jt[j], w.jt[j])))
        if w.scale[j] == 0.0:
            w.scale[j] = 1.0
    if s[RADIUS] < 0.0:
        size = weighted_norm(w.scale, w.x)
        s[RADIUS] = 100.0 * size if size > 0.0 else 100.0
        if s[LIMIT] > 0.0:
            s[RADIUS] = s[LIMIT] * math.sqrt(dot(w.scale, w.scale))
    s[NEWTON_LENGTH] = weighted_norm(w.scale, w.newton) if w.flag[SINGULAR] == 0 else math.inf


@njit_part
def _gain_noise(w: Work) -> float:
    """Return the rounding error in the relative decrease in ‖r‖²."""
    noise, before = 4.0 * EPS, w.s[NORM]
    rounding(w, w.x)
    for k in range(w.r.size):
        noise += 8.0 * abs(w.r[k]) * w.e[k] / (before * before)
    return noise


@njit_part
def _stalled(w: Work) -> int:
    """Return ACCEPTED or a Status for a step that changes ‖r‖ only by rounding errors."""
    square = w.r.size == w.x.size
    w.flag[STALLED] += 1
    if square or w.flag[STALLED] > STALL_LIMIT:
        if slope_of(w) > STATIONARY:
            return STEP_TOO_SMALL
        return CONVERGED if w.flag[SINGULAR] == 0 and not square else ILL_CONDITIONED
    return ACCEPTED


@njit_part
def _resize(w: Work, norm: float, gain: float, slope: float, ratio: float) -> None:
    """Update the radius and lam from the ratio of actual to predicted decrease (Moré 1978, section 4)."""
    s = w.s
    if ratio < SHRINK_BELOW:
        shrink = 0.1
        if gain >= 0.0:
            shrink = 0.5
        elif norm < 10.0 * s[NORM]:  # minimum of the parabola fitted to ‖r‖²
            shrink = 0.5 * slope / (slope + 0.5 * gain)
            shrink = 0.1 if shrink < 0.1 else (0.5 if shrink > 0.5 else shrink)
        reach = 10.0 * s[LENGTH]
        s[RADIUS] = shrink * (reach if reach < s[RADIUS] else s[RADIUS])
        s[LAM] /= shrink
    elif s[LAM] == 0.0 or ratio >= ENLARGE_ABOVE:
        reach = 2.0 * s[LENGTH]
        if s[LAM] > 0.0 or reach > s[RADIUS]:
            s[RADIUS] = reach
        s[LAM] *= 0.5


@njit_part
def assess_decrease(w: Work, norm: float) -> int:
    """Compare the actual and predicted decreases in ‖r‖² and update the radius.

    ``norm`` is ‖r‖ at the trial point. Returns ACCEPTED, REJECTED or a Status.
    """
    s, before = w.s, w.s[NORM]
    finite = norm < math.inf
    gain, predicted, slope = -1.0, 1.0, 0.0
    if finite:
        slope = dot(w.r, w.js) / (before * before)
        gain = 1.0 - (norm / before) * (norm / before)
        predicted = -2.0 * slope - dot(w.js, w.js) / (before * before)
    noise = _gain_noise(w) if finite and predicted < 1e-6 else 4.0 * EPS
    if finite and predicted <= noise and abs(gain) <= 16.0 * noise:
        return _stalled(w)
    ratio = gain / predicted if predicted > 0.0 else -1.0
    _resize(w, norm, gain, slope, ratio)
    if not ratio >= REJECT_BELOW:
        if s[RADIUS] <= EPS * weighted_norm(w.scale, w.x) or s[RADIUS] < 1e-300:
            return RADIUS_TOO_SMALL
        return REJECTED
    return ACCEPTED
