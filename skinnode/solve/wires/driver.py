"""The compiled driver: all upper wires of a patch in one call that holds no GIL and allocates nothing.

A wire is solved for all coordinates of its electrodes, or for fewer: some electrodes only, the others at
rest (``Solver.electrodes``), and z only (``normal_only``). Fewer unknowns than equations make a tall system,
whose χ² = Σ (ρ_k/σ_k)² at the minimum is a test: above its 1 − 1e-9 quantile no position explains the
frame, and the wire is ILL_CONDITIONED; from the 95 % quantile on the deviations grow by √(χ²/dof) (Birge,
Phys. Rev. 40, 207, 1932). This stands for the sign of det J, which only a square system has.

Before that a wire can be held where it is, or followed with the inverse at hand (see ``follow``).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import cube, fixed_cube, int_matrix, int_vector, matrix, vector
from skinnode.compiled.jit import njit_body, njit_part
from skinnode.model.kernels import potential_jacobian
from skinnode.model.layout import Float
from skinnode.solve.linalg.factorisations import Index, dot, largest
from skinnode.solve.operators.steps import (
    ACCEPTED,
    CONVERGED,
    EPS,
    ERROR,
    ILL_CONDITIONED,
    LIMIT,
    MAX_STEPS,
    NON_FINITE,
    NORM,
    OUTSIDE,
    ROOT_SHARE,
    SIGN,
    TRY,
    Work,
    begin,
    certify,
    judge,
    propose,
    shorten,
)
from skinnode.solve.roots import Z_REFUSE
from skinnode.solve.wires.follow import FRESH, chi2_quantile_part, deviations, follow, step_back, within_noise

# The arrays of a solver, by their number in its bundle
(
    X,
    INVERSE,
    A_SOLVED,
    NOISE,
    STD,
    REPORTS,
    MEASURE,
    TALLY,
    LOWER,
    ELECTRODES,
    STILL,
    STILL_STD,
    POINT,
    RAW,
    WORK,
) = range(15)
"""``WORK`` is the first of those of :class:`Work`."""

# Columns of the integer report of a wire
STATUS, EVALUATIONS, STEPS, BRANCH, HELD, SPARE, TURN, REPORT = range(8)
# Columns of the real report of a wire; the residual is the weighted RMS over the equations in use, and CHI2
# the residual's χ² at the end of a solve, with SPARE, equations less unknowns, degrees of freedom
RESIDUAL, OPTIMALITY, ERROR_ESTIMATE, CHI2, MEASURES = range(5)

A_MIN: Final = 1e-12
A_MAX: Final = 1e12
"""An a outside is no resistance: at rest it is about 1 / N M."""

REST_TOLERANCE: Final = 1e-9
"""The rest position is a root by construction, to rounding."""

# What to do with a wire
LEAVE: Final = 0
SOLVE: Final = 1
PREDICT: Final = 2
"""Solve, from x + (∂x/∂a) (a − a of the last solve) on."""
HOLD: Final = 3
"""As PREDICT, unless the residual at x is within noise: then x stays."""

# What a call may do besides solving, or-ed together
COVARIANCE: Final = 1
"""Compute J⁻¹, and with it the deviation of x and whether rounding leaves x open."""
SKIP: Final = 2
"""Skip a wire whose first-order optimality ‖Jᵀr‖∞ is below tol_f (Xu et al. 2018, section 5.2)."""
REUSE: Final = 4
"""Follow a wire that moved a little with the inverse at hand, which is kept."""
REFRESH: Final = 8
"""Calls after which a wire that is followed has a new inverse at the latest, each wire in its turn."""


COVARIANCE_UNITS: Final = 3.0
"""What a covariance costs, in evaluations of F and J with their step, of a square system of 30."""
HELD_UNITS: Final = 0.25
"""What it costs to see that a wire can be held."""

DATA_ROUNDING: Final = 2.0
"""Relative error of an a F, in eps: R, the gain, their product and F are rounded to half an eps each."""

Z_95_ONE_SIDED: Final = 1.645
"""Normal deviate below which 95 % of a normal distribution lie."""


@njit_part
def _data_rounding(inverse: Float, weight: Float) -> float:
    """What rounding of the resistances leaves open of the largest coordinate: ``inverse`` (n, K) ∂x/∂r."""
    top = 0.0
    for j in range(inverse.shape[0]):
        row, total = inverse[j], 0.0
        for k in range(row.size):
            total += abs(row[k]) * weight[k]
        top = max(top, total)
    return DATA_ROUNDING * EPS * top


@njit_part
def _evaluate(
    x: Float,
    point: Float,
    still: Float,
    lower: Float,
    a: Float,
    weight: Float,
    r: Float,
    raw: Float,
) -> None:
    """r = w (a F − 1) and the Jacobian of F at the unknowns ``x`` put into ``point``.

    ``still`` (K,) is the potential of the electrodes that are not in ``point``.
    """
    if x.size == point.size:
        for j in range(x.size):
            point[j] = x[j]
    else:
        for j in range(x.size):
            point[3 * j + 2] = x[j]
    potential_jacobian(point, lower, r, raw)
    for k in range(r.size):
        r[k] = weight[k] * (a[k] * (r[k] + still[k]) - 1.0)


@njit_part
def _take_jacobian(raw: Float, a: Float, weight: Float, jt: Float) -> None:
    """∂r/∂x of the unknowns from ∂F/∂x of all coordinates."""
    normal_only = jt.shape[0] != raw.shape[0]
    for j in range(jt.shape[0]):
        target, source = jt[j], raw[3 * j + 2 if normal_only else j]
        for k in range(a.size):
            target[k] = source[k] * (weight[k] * a[k])


@njit_part
def _coordinate(electrodes: Index, j: int, each: int) -> int:
    """Where unknown ``j`` is in the 3N coordinates of a wire, with three or one (z) unknowns an electrode."""
    if each == 3:
        return int(3 * electrodes[j // 3] + j % 3)
    return int(3 * electrodes[j] + 2)


@njit_body
def _work(own: Index) -> Work:
    """The workspace in the bundle of a solver."""
    return Work(
        vector(own, WORK), vector(own, WORK + 1), vector(own, WORK + 2), vector(own, WORK + 3),
        vector(own, WORK + 4), vector(own, WORK + 5), vector(own, WORK + 6), vector(own, WORK + 7),
        vector(own, WORK + 8), vector(own, WORK + 9), vector(own, WORK + 10), vector(own, WORK + 11),
        vector(own, WORK + 12), vector(own, WORK + 13), vector(own, WORK + 14),
        vector(own, WORK + 15), vector(own, WORK + 16), vector(own, WORK + 17), vector(own, WORK + 18),
        matrix(own, WORK + 19), matrix(own, WORK + 20), matrix(own, WORK + 21), matrix(own, WORK + 22),
        matrix(own, WORK + 23), vector(own, WORK + 24),
        int_vector(own, WORK + 25), vector(own, WORK + 26), int_vector(own, WORK + 27),
    )  # fmt: skip


@njit_body
def solve_wires(
    own: Index,
    operator: int,
    tasks: int,
    todo: NDArray[np.uint8],
    a: Float,
    weight: Float,
    order: Index,
    sigma: float,
    tol_f: float,
    tol_x: float,
    max_steps: int,
    step_limit: float,
    units: float,
    turn: int,
) -> float:
    """Solve r_k = w_k (a_k F_k(x) − 1) = 0 for every upper wire in ``todo`` (U,).

    ``a`` and ``weight`` (U, K), where an ``a`` that is no resistance loses its weight; ``sigma`` deviation of
    a residual of weight 1, 0 where not known. Of the solver's ``own``: ``x`` (U, 3N) start, then solution,
    pitches. The unknowns are those of ``electrodes`` (U, N), as many of a row as ``point`` (3 E,) holds,
    three or one (z) each as the workspace has; ``still`` (U, K) is the potential of the others and
    ``still_std`` (U, 3N) what is not known of all that is no unknown, pitches. ``inverse`` (U, n, K),
    ``a_solved`` and ``noise`` (U, K) keep ∂x/∂r, 1/F and the variance of a of the last converged solve of
    each wire for the next frame, 1 and inf where it had no equation; ``std`` (U, 3N) is inf where not known.
    A wire with fewer equations than unknowns keeps its x and is ILL_CONDITIONED, or NON_FINITE where an ``a``
    lost its weight. Wires have their turn in ``order`` (U,), until one may need more than what is left of
    ``units``, evaluations of F and J with all that goes with them. Returns how many were needed, by estimate;
    to ``tally`` (3,) the evaluations of F, those of J and the steps are added. ``turn`` counts the calls.
    """
    w: Any = _work(own)
    x, lower, point, raw = matrix(own, X), fixed_cube(own, LOWER), vector(own, POINT), matrix(own, RAW)
    electrodes, still, still_std = int_matrix(own, ELECTRODES), matrix(own, STILL), matrix(own, STILL_STD)
    inverse, a_solved, noise = cube(own, INVERSE), matrix(own, A_SOLVED), matrix(own, NOISE)
    std, report, measure = matrix(own, STD), int_matrix(own, REPORTS), matrix(own, MEASURE)
    tally = int_vector(own, TALLY)
    unknowns = w.x.size
    equations = a.shape[1]
    tall = equations > unknowns
    each = 1 if unknowns < point.size else 3
    spent, worst = 0.0, max_steps + 1 + COVARIANCE_UNITS
    for u in order:
        if todo[u] == LEAVE:
            continue
        if spent + worst > units:
            break
        report[u, TURN] = 1
        x_u, a_u, w_u, inverse_u = x[u], a[u], weight[u], inverse[u]
        status = TRY
        count, lost = 0, 0
        for k in range(equations):
            if w_u[k] > 0.0:
                if A_MIN < a_u[k] < A_MAX:
                    count += 1
                    continue
                lost += 1
            a_u[k] = 1.0
            w_u[k] = 0.0
        if count < unknowns or count == 0:
            status = ILL_CONDITIONED if lost == 0 else NON_FINITE
        evaluations, jacobians, steps, skipped, followed, held = 0, 0, 0, False, False, -1.0
        report[u, BRANCH] = 0
        report[u, SPARE] = count - unknowns
        measure[u, CHI2] = math.inf
        measure[u, RESIDUAL] = math.inf
        measure[u, OPTIMALITY] = math.inf
        measure[u, ERROR_ESTIMATE] = math.inf
        for j in range(x_u.size):
            std[u, j] = math.inf
        if status == TRY and todo[u] == HOLD:
            held = within_noise(
                a_u, w_u, sigma, tol_f, a_solved[u], noise[u], inverse_u, unknowns,
                w.e, w.r, w.r_trial, w.newton,
            )  # fmt: skip
            if held >= 0.0:
                status = CONVERGED
                measure[u, RESIDUAL] = held
                for j in range(x_u.size):
                    std[u, j] = still_std[u, j]
                for j in range(unknowns):
                    std[u, _coordinate(electrodes[u], j, each)] = w.newton[j]
        report[u, HELD] = 1 if held >= 0.0 else 0
        if status == TRY:
            for i in range(point.size):
                point[i] = x_u[_coordinate(electrodes[u], i, 3)]
            for j in range(unknowns):
                w.x[j] = x_u[_coordinate(electrodes[u], j, each)]
            if todo[u] != SOLVE:
                for k in range(equations):
                    w.e[k] = a_u[k] / a_solved[u, k] - 1.0 if w_u[k] > 0.0 else 0.0
                moved = step_back(inverse_u, w.e, w.newton)
                for j in range(unknowns):
                    w.x[j] += w.newton[j]
                if tasks & REUSE and not tall and unknowns == point.size == x_u.size:
                    evaluations, steps, first = follow(
                        w.x, lower, a_u, inverse_u, moved, tol_f, tol_x, w.e, w.newton
                    )
                    followed = evaluations > 0 and first <= FRESH and (turn + u) % REFRESH != 0
                    if evaluations > 0 and not followed:
                        for j in range(unknowns):
                            w.x[j] += w.newton[j]
                        steps += 1
                    evaluations = abs(evaluations)
            if followed:
                status = CONVERGED
                for j in range(unknowns):
                    x_u[j] = w.x[j] + w.newton[j]
                measure[u, ERROR_ESTIMATE] = largest(w.newton)
                measure[u, CHI2] = 0.0
                for k in range(equations):
                    w.r[k] = w_u[k] * w.e[k]
                    a_solved[u, k] = a_u[k]
                    noise[u, k] = (sigma / w_u[k]) ** 2
                measure[u, RESIDUAL] = math.sqrt(dot(w.r, w.r) / count)
                deviations(inverse_u, noise[u], std[u])
        if status == TRY:
            _evaluate(w.x, point, still[u], lower, a_u, w_u, w.r, raw)
            _take_jacobian(raw, a_u, w_u, w.jt)
            evaluations += 1
            jacobians = 1
            w.s[LIMIT] = step_limit
            status = begin(w)
            if tasks & SKIP and status == TRY:
                top = 0.0
                for j in range(unknowns):
                    top = max(top, abs(dot(w.jt[j], w.r)))
                if top <= tol_f:
                    status = CONVERGED
                    skipped = True
                    w.s[ERROR] = 0.0
            while status < 0:
                # with the noise known, a minimum is near when less than tol_f is left in the range of J
                tol_r = tol_f
                if tall and sigma > 0.0:
                    tol_r = min(0.1, tol_f / max(tol_f, w.s[NORM]))
                status = propose(operator, w, tol_r, tol_x)
                if status == OUTSIDE:
                    status = shorten(operator, w)
                if status != TRY:
                    break
                if steps == max_steps:
                    status = MAX_STEPS
                    break
                steps += 1
                evaluations += 1
                jacobians += 1
                _evaluate(w.trial, point, still[u], lower, a_u, w_u, w.r_trial, raw)
                status = judge(operator, w, tol_r, tol_x)
                if status == ACCEPTED:
                    _take_jacobian(raw, a_u, w_u, w.jt)
            for j in range(unknowns):
                value = w.x[j]
                if status == CONVERGED and not skipped:  # the correction that proved convergence, for nothing
                    value += w.newton[j]
                x_u[_coordinate(electrodes[u], j, each)] = value
            measure[u, RESIDUAL] = math.sqrt(dot(w.r, w.r) / count)
            top = 0.0
            for j in range(unknowns):
                top = max(top, abs(dot(w.jt[j], w.r)))
            measure[u, OPTIMALITY] = top
            if status == CONVERGED:
                report[u, BRANCH] = w.flag[SIGN]
                measure[u, ERROR_ESTIMATE] = w.s[ERROR]
                square = dot(w.r, w.r) / (sigma * sigma + tol_f * tol_f)
                measure[u, CHI2] = square if tall else 0.0
                if tasks & COVARIANCE:
                    share = certify(w, inverse_u)
                    error = share * max(1.0, largest(w.x)) + _data_rounding(inverse_u, w_u)
                    measure[u, ERROR_ESTIMATE] = error
                    if not share <= ROOT_SHARE:
                        status = ILL_CONDITIONED
                    else:
                        for k in range(equations):
                            a_solved[u, k] = 1.0
                            noise[u, k] = math.inf
                            if w_u[k] > 0.0:
                                a_solved[u, k] = a_u[k] / (1.0 + w.r[k] / w_u[k]) if tall else a_u[k]
                                noise[u, k] = (sigma / w_u[k]) ** 2
                        spare = count - unknowns
                        scale = sigma
                        if spare > 0 and sigma > 0.0:
                            if square > chi2_quantile_part(spare, Z_95_ONE_SIDED):  # Birge's ratio
                                scale *= math.sqrt(square / spare)
                            if not square <= chi2_quantile_part(spare, Z_REFUSE):
                                status = ILL_CONDITIONED
                        for j in range(x_u.size):
                            std[u, j] = still_std[u, j]
                        for j in range(unknowns):
                            row = inverse_u[j]
                            std[u, _coordinate(electrodes[u], j, each)] = scale * math.sqrt(dot(row, row))
                            for k in range(equations):
                                row[k] *= w_u[k]
        report[u, STATUS] = status
        report[u, EVALUATIONS] = evaluations
        report[u, STEPS] = steps
        tally[0] += evaluations
        tally[1] += jacobians
        tally[2] += steps
        if held >= 0.0:
            spent += HELD_UNITS
        elif evaluations > 0:
            spent += evaluations + (0.0 if followed else COVARIANCE_UNITS)
    return spent
