"""Compiled solver for all upper wires of a patch. It releases the GIL and allocates no memory.

The solver tries up to three methods for each wire, until one succeeds: keep the last position (``hold``),
take Newton steps with the inverse of an earlier solve (``follow``), or iterate with new Jacobians
(``correct``).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_body, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index, dot, largest
from skinnode.solve.operators.codes import CONVERGED, ILL_CONDITIONED, NON_FINITE, TRY
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.arrays import SolveOptions, SolverArrays
from skinnode.solve.wires.correct import coordinate, correct, report_correction
from skinnode.solve.wires.decode import A_MAX, A_MIN
from skinnode.solve.wires.follow import FRESH, follow, newton_step, standard_deviations
from skinnode.solve.wires.hold import within_noise

REFRESH: Final = 8
"""Maximum number of successive frames in which a wire is solved with the same inverse. The inverses of
different wires are recomputed in different frames."""
COVARIANCE_UNITS: Final = 3.0
"""Time to compute the covariance of a square system with 30 unknowns, in units of one evaluation of F and J
plus one step."""
HELD_UNITS: Final = 0.25
"""Time to test whether a wire can be held, in units of one evaluation of F and J plus one step."""


@njit_part
def _drop_unusable(a: Float, weight: Float) -> tuple[int, int]:
    """Set a = 1 and weight = 0 for unusable equations.

    Returns the number of usable equations, and the number of equations dropped because a is out of range.
    """
    count, lost = 0, 0
    for k in range(a.size):
        if weight[k] > 0.0:
            if A_MIN < a[k] < A_MAX:
                count += 1
                continue
            lost += 1
        a[k] = 1.0
        weight[k] = 0.0
    return count, lost


@njit_part
def _hold(u: int, solver: SolverArrays, a: Float, weight: Float, sigma: float, tol_f: float) -> bool:  # noqa: PLR0913 - one wire of a call
    """Hold wire ``u`` if its residual is within the noise; return whether it is held.

    For a held wire, also store the residual and the standard deviations.
    """
    w: Any = solver.work
    held = within_noise(
        a, weight, sigma, tol_f, solver.a_solved[u], solver.noise[u], solver.inverse[u], w.x.size,
        w.e, w.r, w.r_trial, w.newton,
    )  # fmt: skip
    if held < 0.0:
        return False
    solver.measure[u, wires.RESIDUAL] = held
    each = 1 if w.x.size < solver.point.size else 3
    std, still_std, electrodes = solver.std[u], solver.still_std[u], solver.electrodes[u]
    for j in range(std.size):
        std[j] = still_std[j]
    for j in range(w.x.size):
        std[coordinate(electrodes, j, each)] = w.newton[j]
    return True


@njit_part
def _predict(u: int, solver: SolverArrays, a: Float, weight: Float) -> float:
    """Extrapolate ``x`` in the workspace to the new resistances; return the largest coordinate change."""
    w: Any = solver.work
    a_solved = solver.a_solved[u]
    for k in range(a.size):
        w.e[k] = a[k] / a_solved[k] - 1.0 if weight[k] > 0.0 else 0.0
    moved = newton_step(solver.inverse[u], w.e, w.newton)
    for j in range(w.x.size):
        w.x[j] += w.newton[j]
    return moved


@njit_part
def _follow(  # noqa: PLR0913 - one wire of a call
    u: int, solver: SolverArrays, options: SolveOptions, a: Float, weight: Float, moved: float
) -> tuple[int, int, bool]:
    """Solve wire ``u`` with its old inverse, after a predicted step of size ``moved``.

    Returns the number of evaluations of F, the number of steps, and whether a root was found and the old
    inverse can be kept.
    """
    w: Any = solver.work
    evaluations, steps, first = follow(
        w.x, solver.lower, a, solver.inverse[u], moved, options.tol_f, options.tol_x, w.e, w.newton
    )
    followed = evaluations > 0 and first <= FRESH and (solver.turn[0] + u) % REFRESH != 0
    if evaluations > 0 and not followed:
        for j in range(w.x.size):
            w.x[j] += w.newton[j]
        steps += 1
    return abs(evaluations), steps, followed


@njit_part
def _report_followed(u: int, solver: SolverArrays, a: Float, weight: Float, sigma: float, count: int) -> None:  # noqa: PLR0913 - one wire of a call
    """Store the solution and the reports of wire ``u``, for which :func:`_follow` has found a root."""
    w: Any = solver.work
    x_u, measure, a_solved, noise = solver.x[u], solver.measure[u], solver.a_solved[u], solver.noise[u]
    for j in range(w.x.size):
        x_u[j] = w.x[j] + w.newton[j]
    measure[wires.ERROR_ESTIMATE] = largest(w.newton)
    measure[wires.CHI2] = 0.0
    for k in range(a.size):
        w.r[k] = weight[k] * w.e[k]
        a_solved[k] = a[k]
        noise[k] = (sigma / weight[k]) ** 2
    measure[wires.RESIDUAL] = math.sqrt(dot(w.r, w.r) / count)
    standard_deviations(solver.inverse[u], noise, solver.std[u])


@njit_part
def _solve_wire(  # noqa: C901, PLR0913 - one wire of a call, from start to report
    u: int, todo: int, solver: SolverArrays, options: SolveOptions, a: Float, weight: Float, sigma: float
) -> float:
    """Solve wire ``u``; return the estimated time spent, in the same unit as ``COVARIANCE_UNITS``."""
    w: Any = solver.work
    point, x_u, electrodes = solver.point, solver.x[u], solver.electrodes[u]
    report, measure, std = solver.report[u], solver.measure[u], solver.std[u]
    unknowns = w.x.size
    tall = a.size > unknowns
    each = 1 if unknowns < point.size else 3
    report[wires.TURN] = 1
    count, lost = _drop_unusable(a, weight)
    status = TRY
    if count < unknowns or count == 0:
        status = ILL_CONDITIONED if lost == 0 else NON_FINITE
    evaluations, jacobians, steps, held, followed = 0, 0, 0, False, False
    report[wires.BRANCH] = 0
    report[wires.SPARE] = count - unknowns
    measure[wires.CHI2] = math.inf
    measure[wires.RESIDUAL] = math.inf
    measure[wires.OPTIMALITY] = math.inf
    measure[wires.ERROR_ESTIMATE] = math.inf
    for j in range(x_u.size):
        std[j] = math.inf
    if status == TRY and todo == wires.HOLD:
        held = _hold(u, solver, a, weight, sigma, options.tol_f)
        if held:
            status = CONVERGED
    report[wires.HELD] = 1 if held else 0
    if status == TRY:
        for i in range(point.size):
            point[i] = x_u[coordinate(electrodes, i, 3)]
        for j in range(unknowns):
            w.x[j] = x_u[coordinate(electrodes, j, each)]
        if todo != wires.SOLVE:
            moved = _predict(u, solver, a, weight)
            if options.tasks & wires.REUSE and not tall and unknowns == point.size == x_u.size:
                evaluations, steps, followed = _follow(u, solver, options, a, weight, moved)
        if followed:
            status = CONVERGED
            _report_followed(u, solver, a, weight, sigma, count)
        else:
            status, more, jacobians, steps, skipped = correct(u, solver, options, a, weight, sigma, steps)
            evaluations += more
            status = report_correction(u, solver, options, a, weight, sigma, count, status, skipped)
    report[wires.STATUS] = status
    report[wires.EVALUATIONS] = evaluations
    report[wires.STEPS] = steps
    tally = solver.tally
    tally[0] += evaluations
    tally[1] += jacobians
    tally[2] += steps
    if held:
        return HELD_UNITS
    if evaluations > 0:
        return evaluations + (0.0 if followed else COVARIANCE_UNITS)
    return 0.0


@njit_body
def solve_wires(  # noqa: PLR0913 - what changes from call to call
    solver: SolverArrays,
    options: SolveOptions,
    todo: NDArray[np.uint8],
    a: Float,
    weight: Float,
    order: Index,
    sigma: float,
    units: float,
) -> float:
    """Solve r_k = w_k (a_k F_k(x) − 1) = 0 for each upper wire selected by ``todo``.

    Args:
        solver: Starting points and results. On entry, ``x`` and ``inverse`` contain the results of the last
            converged solve.
        options: Operator, tasks and tolerances.
        todo: (U,) action for each wire: LEAVE, SOLVE, PREDICT or HOLD.
        a: (U, K) scaled resistances. Values out of range are set to 1, and their weights to 0.
        weight: (U, K) weights of the equations; an equation with weight 0 is ignored.
        order: (U,) indices of the wires, in the order in which to solve them.
        sigma: Standard deviation of a residual of weight 1; 0 if unknown.
        units: Time limit, in units of one evaluation of F and J plus one step. The call returns before
            starting a wire whose solve could exceed the limit.

    Returns the estimated time spent, in the same unit as ``units``. A wire with fewer usable equations than
    unknowns is not solved; its status is NON_FINITE if a value of ``a`` is out of range, otherwise
    ILL_CONDITIONED.
    """
    spent, worst = 0.0, options.max_steps + 1 + COVARIANCE_UNITS
    for u in order:
        if todo[u] == wires.LEAVE:
            continue
        if spent + worst > units:
            break
        spent += _solve_wire(u, todo[u], solver, options, a[u], weight[u], sigma)
    return spent
