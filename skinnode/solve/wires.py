"""The compiled driver: all upper wires of a patch in one call that holds no GIL and allocates nothing."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.jit import njit, njit_part
from skinnode.model.kernels import potential_jacobian
from skinnode.model.layout import Float
from skinnode.solve.linear import Index, dot, largest
from skinnode.solve.operators import (
    ACCEPTED,
    CONVERGED,
    ERROR,
    ILL_CONDITIONED,
    LIMIT,
    MAX_STEPS,
    NON_FINITE,
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
    workspace,
)
from skinnode.solve.problem import PatchProblem

# Columns of the integer report of a wire
STATUS, EVALUATIONS, STEPS, BRANCH, REPORT = range(5)
# Columns of the real report of a wire; the residual is the weighted RMS over the equations in use
RESIDUAL, OPTIMALITY, ERROR_ESTIMATE, MEASURES = range(4)

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

# What a call may do besides solving, or-ed together
COVARIANCE: Final = 1
"""Compute J⁻¹, and with it the deviation of x and whether rounding leaves x open."""
SKIP: Final = 2
"""Skip a wire whose first-order optimality ‖Jᵀr‖∞ is below tol_f (Xu et al. 2018, section 5.2)."""


@njit_part
def _evaluate(x: Float, lower: Float, a: Float, weight: Float, r: Float, jt: Float) -> None:
    """r = w (a F − 1) and its Jacobian."""
    potential_jacobian(x, lower, r, jt)
    for k in range(r.size):
        r[k] = weight[k] * (a[k] * r[k] - 1.0)
    for j in range(jt.shape[0]):
        row = jt[j]
        for k in range(r.size):
            row[k] *= weight[k] * a[k]


@njit
def solve_wires(
    operator: int,
    tasks: int,
    todo: NDArray[np.uint8],
    x: Float,
    a: Float,
    weight: Float,
    sigma: float,
    lower: Float,
    tol_f: float,
    tol_x: float,
    max_steps: int,
    step_limit: float,
    w: Work,
    jt_trial: Float,
    inverse: Float,
    a_solved: Float,
    std: Float,
    report: Index,
    measure: Float,
) -> None:
    """Solve r_k = w_k (a_k F_k(x) − 1) = 0 for every upper wire in ``todo`` (U,).

    ``x`` (U, n) start, then solution, pitches; ``a`` and ``weight`` (U, K), where an ``a`` that is no
    resistance loses its weight; ``sigma`` deviation of a residual of weight 1; ``inverse`` (U, n, K) and
    ``a_solved`` (U, K) keep ∂x/∂r and a of the last converged solve of each wire for the prediction;
    ``std`` (U, n) is inf where not known. A wire with fewer equations than unknowns keeps its x and is
    ILL_CONDITIONED, or NON_FINITE where an ``a`` lost its weight.
    """
    unknowns = x.shape[1]
    equations = a.shape[1]
    for u in range(x.shape[0]):
        if todo[u] == LEAVE:
            continue
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
        if count < unknowns:
            status = ILL_CONDITIONED if lost == 0 else NON_FINITE
        evaluations, steps, skipped = 0, 0, False
        report[u, BRANCH] = 0
        measure[u, RESIDUAL] = math.inf
        measure[u, OPTIMALITY] = math.inf
        measure[u, ERROR_ESTIMATE] = math.inf
        for j in range(unknowns):
            std[u, j] = math.inf
        if status == TRY:
            for j in range(unknowns):
                w.x[j] = x_u[j]
            if todo[u] == PREDICT:
                for k in range(equations):
                    w.e[k] = a_u[k] / a_solved[u, k] - 1.0 if w_u[k] > 0.0 else 0.0
                for j in range(unknowns):
                    w.x[j] -= dot(inverse_u[j], w.e)
            _evaluate(w.x, lower, a_u, w_u, w.r, w.jt)
            evaluations = 1
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
                status = propose(operator, w, tol_f, tol_x)
                if status == OUTSIDE:
                    status = shorten(operator, w)
                if status != TRY:
                    break
                if steps == max_steps:
                    status = MAX_STEPS
                    break
                steps += 1
                evaluations += 1
                _evaluate(w.trial, lower, a_u, w_u, w.r_trial, jt_trial)
                status = judge(operator, w, tol_f, tol_x)
                if status == ACCEPTED:
                    for j in range(unknowns):
                        target, source = w.jt[j], jt_trial[j]
                        for k in range(equations):
                            target[k] = source[k]
            for j in range(unknowns):
                x_u[j] = w.x[j]
                if status == CONVERGED and not skipped:  # the correction that proved convergence, for nothing
                    x_u[j] += w.newton[j]
            measure[u, RESIDUAL] = math.sqrt(dot(w.r, w.r) / count)
            top = 0.0
            for j in range(unknowns):
                top = max(top, abs(dot(w.jt[j], w.r)))
            measure[u, OPTIMALITY] = top
            if status == CONVERGED:
                report[u, BRANCH] = w.flag[SIGN]
                measure[u, ERROR_ESTIMATE] = w.s[ERROR]
                if tasks & COVARIANCE:
                    share = certify(w, inverse_u)
                    measure[u, ERROR_ESTIMATE] = share * max(1.0, largest(w.x))
                    if not share <= ROOT_SHARE:
                        status = ILL_CONDITIONED
                    else:
                        for k in range(equations):
                            a_solved[u, k] = a_u[k]
                        if count < equations:  # what the missing ones would have been
                            potential_jacobian(w.x, lower, w.r_trial, jt_trial)
                            for k in range(equations):
                                if w_u[k] == 0.0:
                                    a_solved[u, k] = 1.0 / w.r_trial[k]
                        for j in range(unknowns):
                            row = inverse_u[j]
                            std[u, j] = sigma * math.sqrt(dot(row, row))
                            for k in range(equations):
                                row[k] *= w_u[k]
        report[u, STATUS] = status
        report[u, EVALUATIONS] = evaluations
        report[u, STEPS] = steps


class Solver:
    """The buffers of one patch around :func:`solve_wires`. One owner, no threads."""

    def __init__(self, problem: PatchProblem, operator: int) -> None:
        wires, lower = problem.layout.shape
        unknowns = problem.layout.unknowns
        self.problem = problem
        self.operator = operator
        self.x = problem.rest.copy()
        """(U, n) the iterate of each wire, pitches."""
        self.inverse = np.zeros((wires, unknowns, lower))
        self.a_solved = np.ones((wires, lower))
        self.std = np.full((wires, unknowns), np.inf)
        """(U, n) pitches."""
        self.report = np.zeros((wires, REPORT), np.int64)
        self.measure = np.zeros((wires, MEASURES))
        self._work = workspace(unknowns, lower)
        self._jt_trial = np.zeros((unknowns, lower))
        self.step_limit = problem.step_limit

    @property
    def cost(self) -> tuple[int, int]:
        """Evaluations and steps of the last call, of all wires."""
        return int(self.report[:, EVALUATIONS].sum()), int(self.report[:, STEPS].sum())

    def solve_rest(self) -> Index:
        """Solve the rest position itself, for its inverse; sign of det J (U,) there, 0 where it has none."""
        todo, weight = np.full(len(self.x), SOLVE, np.uint8), np.ones_like(self.a_solved)
        self.x[:] = self.problem.rest
        self.solve(todo, self.problem.a_rest.copy(), weight, COVARIANCE, REST_TOLERANCE, REST_TOLERANCE, 1)
        self.x[:] = self.problem.rest
        return self.report[:, BRANCH].copy()

    def solve(
        self,
        todo: NDArray[np.uint8],
        a: Float,
        weight: Float,
        tasks: int,
        tol_f: float,
        tol_x: float,
        max_steps: int,
        sigma: float = 0.0,
        operator: int | None = None,
    ) -> None:
        """Solve the wires in ``todo`` from :attr:`x` on, into :attr:`x`, :attr:`std`, :attr:`report` and
        :attr:`measure`. ``a`` and ``weight`` (U, K) may be overwritten."""
        solve_wires(
            self.operator if operator is None else operator,
            tasks,
            todo,
            self.x,
            a,
            weight,
            sigma,
            self.problem.lower,
            tol_f,
            tol_x,
            max_steps,
            self.step_limit,
            self._work,
            self._jt_trial,
            self.inverse,
            self.a_solved,
            self.std,
            self.report,
            self.measure,
        )
