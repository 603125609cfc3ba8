"""Iteration loop for all operators, with reverse communication: the caller evaluates r and J.

- ``begin`` starts at x, with r and J in the workspace.
- ``propose`` factors J and, unless x is a root or a minimum, makes the Newton step the next ``trial``.
- ``shorten`` replaces a trial point outside the trust region with one inside it.
- ``assess`` accepts or rejects the step, given r at ``trial`` in ``r_trial``, and updates the radius.

The compiled solver for the wires of a skin and ``solve_system``, which calls Python functions, thus share the
same compiled steps. Gauss-Newton accepts every step. Levenberg-Marquardt and dogleg accept only steps that
reduce ‖r‖.

For a square system, CONVERGED means a root, which meets two conditions: max|r| ≤ tol_f, and the simplified
Newton correction with the current factors satisfies ‖J⁻¹ r₊‖∞ ≤ tol_x · max(1, ‖x‖∞). If rounding errors keep
r above tol_f, an r within the rounding error of J·x counts as zero.

For a tall system, CONVERGED means a root or a minimum. At a minimum, ‖P r‖ ≤ tol_f ‖r‖, where P projects onto
the range of J, and the correction meets the second condition above. The ``minimum`` module distinguishes
minima from saddle points.

A stationary point of a square system with r ≠ 0 is ILL_CONDITIONED, because J is singular there.
"""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import dot, largest
from skinnode.solve.operators.codes import (
    ACCEPTED,
    CONVERGED,
    EPS,
    GAUSS_NEWTON,
    ILL_CONDITIONED,
    INVALID_START,
    LEVENBERG_MARQUARDT,
    NON_FINITE,
    OUTSIDE,
    REJECTED,
    TRY,
)
from skinnode.solve.operators.dogleg import dogleg_step
from skinnode.solve.operators.gauss_newton import (
    correction,
    estimate_error,
    factor,
    finite_jacobian,
    rounding,
    settled,
)
from skinnode.solve.operators.levenberg_marquardt import marquardt_step
from skinnode.solve.operators.trust_region import assess_decrease, measure_newton, slope_of
from skinnode.solve.operators.work import (
    ANGLE,
    ERROR,
    FACTORED,
    LAM,
    LENGTH,
    NEWTON_LENGTH,
    NORM,
    RADIUS,
    SINGULAR,
    Work,
    times_jacobian,
    weighted_norm,
)


@njit_part
def begin(w: Work) -> int:
    """Start at x, with r and J in the workspace; return TRY, or INVALID_START if r is not finite or m < n."""
    s, flag = w.s, w.flag
    for k in range(flag.size):
        flag[k] = 0
    s[RADIUS] = -1.0  # negative, so that the first call to propose sets the radius
    s[LAM] = 0.0
    s[ERROR] = math.inf
    s[ANGLE] = 1.0
    s[NORM] = math.sqrt(dot(w.r, w.r))
    for j in range(w.scale.size):
        w.scale[j] = 0.0
    if w.r.size < w.x.size or not s[NORM] < math.inf:
        return INVALID_START
    return TRY


@njit_part
def set_trial(operator: int, w: Work) -> None:
    """Set ``trial`` to x + step; for an operator with a trust region, also set LENGTH and ``js``."""
    for j in range(w.x.size):
        w.trial[j] = w.x[j] + w.step[j]
    if operator != GAUSS_NEWTON:
        w.s[LENGTH] = weighted_norm(w.scale, w.step)
        times_jacobian(w.jt, w.step, w.js)


@njit_part
def propose(operator: int, w: Work, tol_f: float, tol_x: float) -> int:
    """Make the Newton step the next trial step.

    Returns TRY after setting ``trial`` and ``step``; OUTSIDE if the Newton step does not exist or is longer
    than the radius (then call :func:`shorten`); or a Status.
    """
    s, flag = w.s, w.flag
    if flag[FACTORED] == 0:
        if not factor(w):
            if not finite_jacobian(w):
                return NON_FINITE
        elif settled(w, tol_f, tol_x):
            return CONVERGED
        if operator != GAUSS_NEWTON:
            measure_newton(w)
    regular = flag[SINGULAR] == 0
    if operator == GAUSS_NEWTON:
        if not regular:
            return ILL_CONDITIONED
    elif not (regular and s[NEWTON_LENGTH] <= (1.1 if operator == LEVENBERG_MARQUARDT else 1.0) * s[RADIUS]):
        return OUTSIDE
    s[LAM] = 0.0
    for j in range(w.x.size):
        w.step[j] = w.newton[j]
    set_trial(operator, w)
    return TRY


@njit_part
def shorten(operator: int, w: Work) -> int:
    """Set a trial step within the trust region; return TRY, or a Status if x is a stationary point."""
    if slope_of(w) <= EPS:
        return CONVERGED if w.flag[SINGULAR] == 0 and w.r.size > w.x.size else ILL_CONDITIONED
    if operator == LEVENBERG_MARQUARDT:
        marquardt_step(w)
    else:
        dogleg_step(w)
    set_trial(operator, w)
    return TRY


@njit_part
def _within_rounding(w: Work, norm: float) -> bool:
    """Return whether ``r_trial``, with the Euclidean norm ``norm``, consists only of rounding errors."""
    if not (norm < math.inf and norm > 0.25 * w.s[NORM] and w.flag[SINGULAR] == 0):
        return False
    rounding(w, w.trial)
    hidden = True
    for k in range(w.r.size):
        if not abs(w.r_trial[k]) <= 4.0 * w.e[k]:
            hidden = False
    return hidden


@njit_part
def assess(operator: int, w: Work, tol_f: float, tol_x: float) -> int:
    """Accept or reject the trial point; return ACCEPTED (then evaluate J at x), REJECTED or a Status."""
    s = w.s
    norm = math.sqrt(dot(w.r_trial, w.r_trial))
    exhausted = _within_rounding(w, norm)
    if operator == GAUSS_NEWTON:
        if not norm < math.inf:
            return NON_FINITE
    elif not exhausted:
        verdict = assess_decrease(w, norm)
        if verdict != ACCEPTED:
            return verdict
    for j in range(w.x.size):
        w.x[j] = w.trial[j]
    for k in range(w.r.size):
        w.r[k] = w.r_trial[k]
    s[NORM] = norm
    w.flag[FACTORED] = 0
    if w.flag[SINGULAR] == 0:
        s[ERROR] = correction(w, w.r, w.newton)
        if exhausted or (largest(w.r) <= tol_f and s[ERROR] <= tol_x * max(1.0, largest(w.x))):
            return CONVERGED
    return ACCEPTED


@njit
def start(w: Work) -> int:
    """Run :func:`begin`; called from Python."""
    return begin(w)


@njit
def advance(operator: int, w: Work, went: int, tol_f: float, tol_x: float) -> int:
    """Assess the last trial point; if it was rejected, propose the next one. Called from Python.

    ``went`` is the return value of the previous call, or REJECTED for the first call. Returns TRY (then write
    r at ``trial`` to ``r_trial``), ACCEPTED (then write Jᵀ at ``x`` to ``jt``) or a Status.
    """
    if went == TRY:
        went = assess(operator, w, tol_f, tol_x)
        if went != REJECTED:
            return went
    went = propose(operator, w, tol_f, tol_x)
    return shorten(operator, w) if went == OUTSIDE else went


@njit
def final_error(w: Work, inverse: Float) -> float:
    """Run :func:`estimate_error`; called from Python."""
    return estimate_error(w, inverse)
