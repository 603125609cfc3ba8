"""Gauss-Newton, Levenberg-Marquardt and trust-region dogleg, written once as reverse communication.

    begin      r and J at x are in the workspace
    propose    factor J; x is a root, or Newton's step is the next ``trial``
    shorten    the trial of the trust region where Newton's step leaves it
    judge      r at ``trial`` is in ``r_trial``: take it or not, update the radius, return what is next

The caller evaluates the functions, so the same compiled steps serve the compiled driver of a skin wire and
any pair of Python callables. Symbols are the paper's: r residual (m,), J its Jacobian (m, n), stored
transposed, lam the Levenberg-Marquardt parameter, radius that of the trust region ‖D s‖ ≤ radius, D the
running maximum of the column norms of J (Moré 1978), so that the unit of an unknown does not matter.

Gauss-Newton takes every step in full, as the paper's does; the other two take a step only when r gets
smaller.

What CONVERGED means. Square systems: a root, that is max|r| ≤ tol_f *and* a simplified Newton correction
‖J⁻¹ r₊‖∞ ≤ tol_x · max(1, ‖x‖∞), by the factors at hand. Where rounding keeps r above tol_f, r within the
rounding of J·x counts as zero. Tall systems: a minimum, ‖P r‖ ≤ tol_f ‖r‖ with P the projection on the
range of J, and the same correction. A stationary point of a square system with r ≠ 0 is ILL_CONDITIONED: J
is singular there.

Sources: Moré, The Levenberg-Marquardt algorithm, 1978 (parameter iteration, radius factors 1/4, 3/4,
0.0001); Powell, A hybrid method for nonlinear equations, 1970 (dogleg); Deuflhard, Newton methods for
nonlinear problems, 2004 (simplified correction as the error estimate); Xu et al. 2018, eqs. 8-10.
"""

from __future__ import annotations

import math
from typing import Annotated, Final, NamedTuple

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.solve.linalg.factorisations import (
    Index,
    bidiagonal_solve,
    bidiagonal_solve_transposed,
    bidiagonalise,
    damped_solve,
    dot,
    largest,
    lu_factor,
    lu_inverse_transposed,
    lu_solve_transposed,
    padded,
    qr_factor,
    qr_inverse,
    qr_project,
    r_solve,
    reflect,
)

OPERATORS: Final = {"gauss_newton": 0, "levenberg_marquardt": 1, "dogleg": 2}
GAUSS_NEWTON: Final = OPERATORS["gauss_newton"]
LEVENBERG_MARQUARDT: Final = OPERATORS["levenberg_marquardt"]

# What the steps return besides a terminal Status, which is ≥ 0.
TRY: Final = -1
ACCEPTED: Final = -2
REJECTED: Final = -3
OUTSIDE: Final = -4

# The compiled code sees plain integers.
CONVERGED: Final = int(Status.CONVERGED)
MAX_STEPS: Final = int(Status.MAX_STEPS)
RADIUS_TOO_SMALL: Final = int(Status.RADIUS_TOO_SMALL)
STEP_TOO_SMALL: Final = int(Status.STEP_TOO_SMALL)
ILL_CONDITIONED: Final = int(Status.ILL_CONDITIONED)
NON_FINITE: Final = int(Status.NON_FINITE)
INVALID_START: Final = int(Status.INVALID_START)

EPS: Final = float(np.finfo(np.float64).eps)
ROOT_SHARE: Final = EPS ** (1 / 2)
MINIMUM_SHARE: Final = EPS ** (1 / 3)
"""An error estimate above this share of max(1, ‖x‖∞) is no root, no minimum: half the digits of a root are
given, and ‖r‖² does not fix those of a minimum to better than √eps."""
STATIONARY: Final = 1e-6
"""A gradient below this share of ‖J_j‖ ‖r‖ is zero: r² is then flat to rounding, about √eps."""
STALL_LIMIT: Final = 30
"""Steps below the rounding of ‖r‖² that a tall system may take to settle its x."""

# Scalars of a solve, in Work.s
LIMIT, RADIUS, LAM, NORM, LENGTH, NEWTON_LENGTH, ERROR, ANGLE, SCALARS = range(9)
# Flags of a solve, in Work.flag
FACTORED, SINGULAR, SIGN, REDUCED, STALLED, FLAGS = range(6)


class Work(NamedTuple):
    """Everything that solving m equations in n unknowns writes to."""

    x: Annotated[Float, "n"]
    trial: Annotated[Float, "n"]
    step: Annotated[Float, "n"]
    newton: Annotated[Float, "n"]
    gradient: Annotated[Float, "n"]
    scale: Annotated[Float, "n"]
    """D."""
    diagonal: Annotated[Float, "n"]
    """Diagonal of R."""
    beta: Annotated[Float, "n"]
    """β of the reflectors of Q."""
    v: Annotated[Float, "n"]
    bd: Annotated[Float, "n"]
    """Diagonal of the bidiagonal form of J D⁻¹; ``bu`` is above it."""
    bu: Annotated[Float, "n"]
    across: Annotated[Float, "n"]
    down: Annotated[Float, "n"]
    """β of its reflectors."""
    inverse: Annotated[Float, "n"]
    """1 / diagonal of the damped form; ``ru`` is above it."""
    ru: Annotated[Float, "n"]
    r: Annotated[Float, "m"]
    r_trial: Annotated[Float, "m"]
    js: Annotated[Float, "m"]
    """J·step."""
    e: Annotated[Float, "m"]
    """Scratch."""
    jt: Annotated[Float, "n m"]
    """Jᵀ at x."""
    lu: Annotated[Float, "n+3 lanes_n"]
    """LU factors of Jᵀ if the system is square; rows are whole lanes."""
    qr: Annotated[Float, "m n"]
    """QR factors of J if it is tall."""
    right: Annotated[Float, "n+3 lanes_m"]
    """Reflectors of the bidiagonal form from the right."""
    left: Annotated[Float, "n lanes_n+3"]
    """Reflectors of the bidiagonal form from the left."""
    wide: Annotated[Float, "lanes_m"]
    """Scratch as long as a row of ``right``."""
    pivot: Annotated[Index, "n"]
    s: Annotated[Float, "scalars"]
    flag: Annotated[Index, "flags"]


def workspace(n: int, m: int) -> Work:
    """A zeroed workspace for m equations in n unknowns."""
    v, e = np.zeros((15, n)), np.zeros((4, m))
    return Work(
        x=v[0], trial=v[1], step=v[2], newton=v[3], gradient=v[4], scale=v[5], diagonal=v[6], beta=v[7],
        v=v[8], bd=v[9], bu=v[10], across=v[11], down=v[12], inverse=v[13], ru=v[14],
        r=e[0], r_trial=e[1], js=e[2], e=e[3],
        jt=np.zeros((n, m)), lu=padded(n + 3, n), qr=np.zeros((m, n)),
        right=padded(n + 3, m), left=padded(n, n + 3), wide=padded(1, m)[0],
        pivot=np.zeros(n, np.int64), s=np.zeros(SCALARS), flag=np.zeros(FLAGS, np.int64),
    )  # fmt: skip


@njit_part
def begin(w: Work) -> int:
    """Start from x, r and J in the workspace. TRY, or INVALID_START where r is not finite or m < n."""
    s, flag = w.s, w.flag
    for k in range(flag.size):
        flag[k] = 0
    s[RADIUS] = -1.0  # set by the first propose, which knows D
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
def _weighted(scale: Float, v: Float) -> float:
    """‖D v‖₂"""
    total = 0.0
    for j in range(v.size):
        weighted = scale[j] * v[j]
        total += weighted * weighted
    return math.sqrt(total)


@njit_part
def _times_jacobian(jt: Float, v: Float, out: Float) -> None:
    """J v into ``out`` (m,)."""
    for k in range(out.size):
        out[k] = 0.0
    for j in range(v.size):
        row, factor = jt[j], v[j]
        for k in range(out.size):
            out[k] += factor * row[k]


@njit_part
def _correction(w: Work, r: Float, out: Float) -> float:
    """−J⁺ r into ``out`` (n,) with the factors at hand; its largest element."""
    n = out.size
    if w.r.size == n:
        for j in range(n):
            out[j] = -r[j]
        lu_solve_transposed(w.lu, w.pivot, out)
    else:
        for k in range(r.size):
            w.e[k] = -r[k]
        qr_project(w.qr, w.beta, w.e)
        r_solve(w.qr, w.diagonal, w.e)
        for j in range(n):
            out[j] = w.e[j]
    return largest(out)


@njit_part
def _rounding(w: Work, x: Float) -> float:
    """What rounding x to the nearest double does to r, eps Σ_j |J_kj x_j|, into ``e``; max |x|."""
    top = 0.0
    for k in range(w.e.size):
        w.e[k] = 0.0
    for j in range(x.size):
        row, size = w.jt[j], EPS * abs(x[j])
        if size > top:
            top = size
        for k in range(w.e.size):
            w.e[k] += abs(row[k]) * size
    return top / EPS


@njit_part
def _slope(w: Work) -> float:
    """Gradient Jᵀr into the workspace; its largest cosine |J_j·r| / (D_j ‖r‖)."""
    top = 0.0
    for j in range(w.x.size):
        w.gradient[j] = dot(w.jt[j], w.r)
        top = max(top, abs(w.gradient[j]) / (w.scale[j] * w.s[NORM]))
    return top


@njit_part
def _dogleg_step(w: Work) -> None:
    """Powell's step: along −D⁻²g to the Cauchy point, from there towards Newton, to the radius."""
    n, radius = w.x.size, w.s[RADIUS]
    square = 0.0
    for j in range(n):
        w.v[j] = -w.gradient[j] / w.scale[j] ** 2
        square += w.gradient[j] * -w.v[j]
    _times_jacobian(w.jt, w.v, w.js)
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
    root = math.sqrt(b * b - a * c)
    share = -c / (b + root) if b > 0.0 else (root - b) / a
    for j in range(n):
        w.step[j] += share * (w.newton[j] - w.step[j])


@njit_part
def _marquardt_step(w: Work) -> None:
    """The step with ‖D s‖ within a tenth of the radius, by Newton's method on lam (Moré 1978, section 5).

    In the bidiagonal form of J D⁻¹, once a Jacobian, s = D⁻¹ P t and ‖D s‖ = ‖t‖: what each lam costs is
    then of the order of n.
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
    """‖R⁻ᵀ t / ‖t‖‖²: the share of ‖t‖ that a unit of lam takes away, R as in :func:`bidiagonal_solve`;
    ``v`` (n,) is scratch."""
    share = 1.0 / length
    for j in range(t.size):
        v[j] = t[j] * share
    bidiagonal_solve_transposed(inverse, upper, v)
    return dot(v, v)


@njit_part
def _lay_trial(operator: int, w: Work) -> None:
    for j in range(w.x.size):
        w.trial[j] = w.x[j] + w.step[j]
    if operator != GAUSS_NEWTON:
        w.s[LENGTH] = _weighted(w.scale, w.step)
        _times_jacobian(w.jt, w.step, w.js)


@njit_part
def propose(operator: int, w: Work, tol_f: float, tol_x: float) -> int:
    """Newton's step as the next trial point: TRY with ``trial``, ``step`` and ``js`` set, OUTSIDE where the
    step is longer than the radius or there is none (call :func:`shorten`), or a Status."""
    n, s, flag = w.x.size, w.s, w.flag
    square = w.r.size == n
    if flag[FACTORED] == 0:
        flag[FACTORED] = 1
        flag[REDUCED] = 0
        if square:
            for j in range(n):
                target, source = w.lu[j], w.jt[j]
                for k in range(n):
                    target[k] = source[k]
            flag[SIGN] = lu_factor(w.lu, w.pivot)
            full = flag[SIGN] != 0
        else:
            full = qr_factor(w.jt, w.qr, w.diagonal, w.beta, w.v) == 1
        if full:
            s[ERROR] = _correction(w, w.r, w.newton)
            full = s[ERROR] < math.inf
        flag[SINGULAR] = 0 if full else 1
        if not full:
            for j in range(n):
                if not largest(w.jt[j]) < math.inf:
                    return NON_FINITE
        else:
            settled = largest(w.r) <= tol_f
            if not square:
                _times_jacobian(w.jt, w.newton, w.js)
                s[ANGLE] = math.sqrt(dot(w.js, w.js)) / s[NORM] if s[NORM] > 0.0 else 0.0
                settled = settled or s[ANGLE] <= tol_f
            if settled and s[ERROR] <= tol_x * max(1.0, largest(w.x)):
                return CONVERGED
        if operator != GAUSS_NEWTON:
            for j in range(n):
                w.scale[j] = max(w.scale[j], math.sqrt(dot(w.jt[j], w.jt[j])))
                if w.scale[j] == 0.0:
                    w.scale[j] = 1.0
            if s[RADIUS] < 0.0:
                size = _weighted(w.scale, w.x)
                s[RADIUS] = 100.0 * size if size > 0.0 else 100.0
                if s[LIMIT] > 0.0:
                    s[RADIUS] = s[LIMIT] * math.sqrt(dot(w.scale, w.scale))
            s[NEWTON_LENGTH] = _weighted(w.scale, w.newton) if flag[SINGULAR] == 0 else math.inf
    regular = flag[SINGULAR] == 0
    if operator == GAUSS_NEWTON:
        if not regular:
            return ILL_CONDITIONED
    elif not (regular and s[NEWTON_LENGTH] <= (1.1 if operator == LEVENBERG_MARQUARDT else 1.0) * s[RADIUS]):
        return OUTSIDE
    s[LAM] = 0.0
    for j in range(n):
        w.step[j] = w.newton[j]
    _lay_trial(operator, w)
    return TRY


@njit_part
def shorten(operator: int, w: Work) -> int:
    """The step within the trust region where Newton's leaves it: TRY, or a Status at a stationary point."""
    if _slope(w) <= EPS:
        return CONVERGED if w.flag[SINGULAR] == 0 and w.r.size > w.x.size else ILL_CONDITIONED
    if operator == LEVENBERG_MARQUARDT:
        _marquardt_step(w)
    else:
        _dogleg_step(w)
    _lay_trial(operator, w)
    return TRY


@njit_part
def judge(operator: int, w: Work, tol_f: float, tol_x: float) -> int:
    """Judge ``r_trial``: ACCEPTED (the caller evaluates J at x), REJECTED or a Status."""
    s, flag = w.s, w.flag
    square, regular = w.r.size == w.x.size, flag[SINGULAR] == 0
    before, norm = s[NORM], math.sqrt(dot(w.r_trial, w.r_trial))
    finite = norm < math.inf
    exhausted = False  # rounding hides whatever r is left
    if finite and norm > 0.25 * before and regular:
        _rounding(w, w.trial)
        exhausted = True
        for k in range(w.r.size):
            if not abs(w.r_trial[k]) <= 4.0 * w.e[k]:
                exhausted = False
    if operator == GAUSS_NEWTON:
        if not finite:
            return NON_FINITE
    elif not exhausted:
        gain, predicted, slope = -1.0, 1.0, 0.0
        if finite:
            slope = dot(w.r, w.js) / (before * before)
            gain = 1.0 - (norm / before) * (norm / before)
            predicted = -2.0 * slope - dot(w.js, w.js) / (before * before)
        noise = 4.0 * EPS  # of gain
        if finite and predicted < 1e-6:
            _rounding(w, w.x)
            for k in range(w.r.size):
                noise += 8.0 * abs(w.r[k]) * w.e[k] / (before * before)
        if finite and predicted <= noise and abs(gain) <= 16.0 * noise:  # ‖r‖ cannot tell any more
            flag[STALLED] += 1
            if square or flag[STALLED] > STALL_LIMIT:
                if _slope(w) > STATIONARY:
                    return STEP_TOO_SMALL
                return CONVERGED if regular and not square else ILL_CONDITIONED
        else:
            ratio = gain / predicted if predicted > 0.0 else -1.0
            if ratio < 0.25:
                shrink = 0.1
                if gain >= 0.0:
                    shrink = 0.5
                elif norm < 10.0 * before:  # the minimiser of the parabola through both residuals
                    shrink = 0.5 * slope / (slope + 0.5 * gain)
                    shrink = 0.1 if shrink < 0.1 else (0.5 if shrink > 0.5 else shrink)
                reach = 10.0 * s[LENGTH]
                s[RADIUS] = shrink * (reach if reach < s[RADIUS] else s[RADIUS])
                s[LAM] /= shrink
            elif s[LAM] == 0.0 or ratio >= 0.75:
                reach = 2.0 * s[LENGTH]
                if s[LAM] > 0.0 or reach > s[RADIUS]:
                    s[RADIUS] = reach
                s[LAM] *= 0.5
            if not ratio >= 1e-4:
                if s[RADIUS] <= EPS * _weighted(w.scale, w.x) or s[RADIUS] < 1e-300:
                    return RADIUS_TOO_SMALL
                return REJECTED
    for j in range(w.x.size):
        w.x[j] = w.trial[j]
    for k in range(w.r.size):
        w.r[k] = w.r_trial[k]
    s[NORM] = norm
    flag[FACTORED] = 0
    if regular:
        s[ERROR] = _correction(w, w.r, w.newton)
        if exhausted or (largest(w.r) <= tol_f and s[ERROR] <= tol_x * max(1.0, largest(w.x))):
            return CONVERGED
    return ACCEPTED


@njit_part
def certify(w: Work, inverse: Float) -> float:
    """J⁺ of the last factors into ``inverse`` (n, m); the error estimate of a converged solve.

    That is the correction still to come and what rounding of x leaves open through the condition of J, as a
    share of max(1, ‖x‖∞). Inf where J is singular.
    """
    n, m = w.jt.shape
    if w.flag[SINGULAR] == 1:
        return math.inf
    if m == n:
        lu_inverse_transposed(w.lu, w.pivot, inverse)
    else:
        qr_inverse(w.qr, w.diagonal, w.beta, w.r_trial, inverse)
    size = _rounding(w, w.x)
    top = 0.0
    for j in range(n):
        row, total = inverse[j], 0.0
        for k in range(m):
            total += abs(row[k]) * w.e[k]
        if not total <= top:
            top = total
    return float((w.s[ERROR] + top) / max(1.0, size))


@njit
def start(w: Work) -> int:
    """:func:`begin` for callers in Python."""
    return begin(w)


@njit
def advance(operator: int, w: Work, went: int, tol_f: float, tol_x: float) -> int:
    """:func:`judge` the trial of the last call, then :func:`propose`, for callers in Python.

    ``went`` is what the last call returned, ``REJECTED`` at first. Returns TRY (evaluate r at ``trial`` into
    ``r_trial``), ACCEPTED (evaluate J at ``x`` into ``jt``) or a Status.
    """
    if went == TRY:
        went = judge(operator, w, tol_f, tol_x)
        if went != REJECTED:
            return went
    went = propose(operator, w, tol_f, tol_x)
    return shorten(operator, w) if went == OUTSIDE else went


@njit
def assure(w: Work, inverse: Float) -> float:
    """:func:`certify` for callers in Python."""
    return certify(w, inverse)
