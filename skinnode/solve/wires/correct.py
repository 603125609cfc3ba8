"""Compiled corrector: solves r = w (a F − 1) = 0 for one wire by Newton-like iteration.

The unknowns are coordinates of the wire's electrodes. Some electrodes can be fixed at rest, and x and y can
be fixed (``normal_only``). A system with more equations than unknowns is called tall.

The solution of a tall system minimises χ² = Σ (ρ_k/σ_k)². Here ρ_k = a_k F_k − 1 is the relative residual,
and σ_k is its standard deviation. If χ² exceeds its 1 − 1e-9 quantile, the resistances contradict the model,
and the wire is ILL_CONDITIONED. If χ² exceeds its 95 % quantile, the standard deviations are multiplied by
√(χ²/dof) (Birge, Physical Review 40, 207, 1932). For a square system, the sign of det J is reported instead.
"""

from __future__ import annotations

import math
from typing import Any, Final

from skinnode.compiled.jit import njit_part
from skinnode.model.kernels import potential_jacobian, relative_residual_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index, dot, largest
from skinnode.solve.operators.codes import (
    ACCEPTED,
    CONVERGED,
    EPS,
    ILL_CONDITIONED,
    MAX_STEPS,
    OUTSIDE,
    ROOT_SHARE,
    TRY,
)
from skinnode.solve.operators.gauss_newton import estimate_error
from skinnode.solve.operators.loop import assess, begin, propose, shorten
from skinnode.solve.operators.work import ERROR, LIMIT, NORM, SIGN
from skinnode.solve.roots import Z_REFUSE
from skinnode.solve.wires.arrays import (
    BRANCH,
    CHI2,
    COVARIANCE,
    ERROR_ESTIMATE,
    OPTIMALITY,
    RESIDUAL,
    SKIP,
    SolveOptions,
    SolverArrays,
)
from skinnode.solve.wires.hold import chi2_quantile_part

DATA_ROUNDING: Final = 2.0
"""Relative rounding error of the product a F, in units of eps: half a unit each for R, the gain, their
product and F."""

Z_95_ONE_SIDED: Final = 1.645
"""95 % quantile of the standard normal distribution."""


@njit_part
def _data_rounding(inverse: Float, weight: Float) -> float:
    """Return the largest coordinate error caused by rounding the product a F."""
    top = 0.0
    for j in range(inverse.shape[0]):
        row, total = inverse[j], 0.0
        for k in range(row.size):
            total += abs(row[k]) * weight[k]
        top = max(top, total)
    return DATA_ROUNDING * EPS * top


@njit_part
def _evaluate(  # noqa: PLR0913 - arrays of one wire
    x: Float, point: Float, still: Float, lower: Float, a: Float, weight: Float, r: Float, raw: Float
) -> None:
    """Copy the unknowns ``x`` to ``point``, and evaluate the residual ``r`` and the Jacobian ``raw`` of F.

    ``still`` (K,) is the contribution of the fixed electrodes to F.
    """
    if x.size == point.size:
        for j in range(x.size):
            point[j] = x[j]
    else:
        for j in range(x.size):
            point[3 * j + 2] = x[j]
    potential_jacobian(point, lower, r, raw)
    for k in range(r.size):
        r[k] = weight[k] * relative_residual_part(a[k], r[k] + still[k])


@njit_part
def _take_jacobian(raw: Float, a: Float, weight: Float, jt: Float) -> None:
    """Compute ``jt``, the transposed Jacobian of r with respect to the unknowns, from ``raw``."""
    normal_only = jt.shape[0] != raw.shape[0]
    for j in range(jt.shape[0]):
        target, source = jt[j], raw[3 * j + 2 if normal_only else j]
        for k in range(a.size):
            target[k] = source[k] * (weight[k] * a[k])


@njit_part
def coordinate(electrodes: Index, j: int, each: int) -> int:
    """Return the index of unknown ``j`` among a wire's 3N coordinates.

    ``each`` is the number of unknowns per electrode: 3, or 1 if only z is unknown.
    """
    if each == 3:
        return int(3 * electrodes[j // 3] + j % 3)
    return int(3 * electrodes[j] + 2)


@njit_part
def _optimality(jt: Float, r: Float) -> float:
    top = 0.0
    for j in range(jt.shape[0]):
        top = max(top, abs(dot(jt[j], r)))
    return top


@njit_part
def correct(  # noqa: PLR0913 - one wire of a call
    u: int, solver: SolverArrays, options: SolveOptions, a_u: Float, w_u: Float, sigma: float, steps: int,
) -> tuple[int, int, int, int, bool]:  # fmt: skip
    """Solve wire ``u``, starting at ``x`` in the workspace, until the iteration converges or fails.

    ``steps`` is the number of steps already taken for this wire in this frame. Returns the status, the number
    of evaluations of F, the number of evaluations of J, the total number of steps, and whether the wire was
    skipped (see SKIP).
    """
    w: Any = solver.work
    operator, tasks, tol_f, tol_x = options.operator, options.tasks, options.tol_f, options.tol_x
    lower, point, raw, still_u = solver.lower, solver.point, solver.raw, solver.still[u]
    tall = w.r.size > w.x.size
    _evaluate(w.x, point, still_u, lower, a_u, w_u, w.r, raw)
    _take_jacobian(raw, a_u, w_u, w.jt)
    evaluations, jacobians = 1, 1
    w.s[LIMIT] = solver.step_limit
    status = begin(w)
    if tasks & SKIP and status == TRY and _optimality(w.jt, w.r) <= tol_f:
        w.s[ERROR] = 0.0
        return CONVERGED, evaluations, jacobians, steps, True
    while status < 0:
        # At the solution of a tall system, only the component of r in the range of J vanishes. tol_f limits
        # this component.
        tol_r = tol_f
        if tall and sigma > 0.0:
            tol_r = min(0.1, tol_f / max(tol_f, w.s[NORM]))
        status = propose(operator, w, tol_r, tol_x)
        if status == OUTSIDE:
            status = shorten(operator, w)
        if status != TRY:
            break
        if steps == options.max_steps:
            status = MAX_STEPS
            break
        steps += 1
        evaluations += 1
        jacobians += 1
        _evaluate(w.trial, point, still_u, lower, a_u, w_u, w.r_trial, raw)
        status = assess(operator, w, tol_r, tol_x)
        if status == ACCEPTED:
            _take_jacobian(raw, a_u, w_u, w.jt)
    return status, evaluations, jacobians, steps, False


@njit_part
def report_correction(  # noqa: C901, PLR0913 - one wire of a call; its results in one piece
    u: int, solver: SolverArrays, options: SolveOptions, a_u: Float, w_u: Float, sigma: float, count: int,
    status: int, skipped: bool,
) -> int:  # fmt: skip
    """Store the solution and the reports of wire ``u``, for which :func:`correct` has returned ``status``.

    With COVARIANCE, also store the inverse and the standard deviations. ``count`` is the number of equations
    in use. Returns ILL_CONDITIONED if the root is poorly determined or fails the χ² test, otherwise
    ``status``.
    """
    w: Any = solver.work
    unknowns, tol_f = w.x.size, options.tol_f
    tall = w.r.size > unknowns
    each = 1 if unknowns < solver.point.size else 3
    x_u, electrodes, measure = solver.x[u], solver.electrodes[u], solver.measure[u]
    for j in range(unknowns):
        value = w.x[j]
        if status == CONVERGED and not skipped:  # apply the correction that the convergence test computed
            value += w.newton[j]
        x_u[coordinate(electrodes, j, each)] = value
    measure[RESIDUAL] = math.sqrt(dot(w.r, w.r) / count)
    measure[OPTIMALITY] = _optimality(w.jt, w.r)
    if status != CONVERGED:
        return status
    solver.report[u, BRANCH] = w.flag[SIGN]
    measure[ERROR_ESTIMATE] = w.s[ERROR]
    square = dot(w.r, w.r) / (sigma * sigma + tol_f * tol_f)
    measure[CHI2] = square if tall else 0.0
    if not options.tasks & COVARIANCE:
        return status
    inverse_u = solver.inverse[u]
    share = estimate_error(w, inverse_u)
    measure[ERROR_ESTIMATE] = share * max(1.0, largest(w.x)) + _data_rounding(inverse_u, w_u)
    if not share <= ROOT_SHARE:
        return ILL_CONDITIONED
    a_solved, noise = solver.a_solved[u], solver.noise[u]
    for k in range(w.r.size):
        a_solved[k] = 1.0
        noise[k] = math.inf
        if w_u[k] > 0.0:
            a_solved[k] = a_u[k] / (1.0 + w.r[k] / w_u[k]) if tall else a_u[k]
            noise[k] = (sigma / w_u[k]) ** 2
    spare = count - unknowns
    scale = sigma
    if spare > 0 and sigma > 0.0:
        if square > chi2_quantile_part(spare, Z_95_ONE_SIDED):  # Birge's ratio
            scale *= math.sqrt(square / spare)
        if not square <= chi2_quantile_part(spare, Z_REFUSE):
            status = ILL_CONDITIONED
    std, still_std = solver.std[u], solver.still_std[u]
    for j in range(x_u.size):
        std[j] = still_std[j]
    for j in range(unknowns):
        row = inverse_u[j]
        std[coordinate(electrodes, j, each)] = scale * math.sqrt(dot(row, row))
        for k in range(row.size):
            row[k] *= w_u[k]
    return status
