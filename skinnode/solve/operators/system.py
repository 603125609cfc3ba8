"""Solver for any square or tall system F(x) = 0, with the same operators as for the skin."""

from __future__ import annotations

import math
import numbers
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float, require_array
from skinnode.model.status import Status
from skinnode.solve.operators import codes as op
from skinnode.solve.operators.loop import advance, final_error
from skinnode.solve.operators.loop import start as start_solve
from skinnode.solve.operators.result import Solution
from skinnode.solve.operators.work import workspace


def operator_code(name: str) -> int:
    """Return the number of an operator in compiled code. Raises ValueError if the name is unknown."""
    if not isinstance(name, str) or name not in op.OPERATORS:
        raise ValueError(f"operator: got {name!r}, must be one of {', '.join(op.OPERATORS)}")
    return op.OPERATORS[name]


def require_tolerances(tol_f: float, tol_x: float, max_steps: int) -> None:
    """Raise ValueError unless both tolerances are positive and at least one step is allowed."""
    for name, value in (("tol_f", tol_f), ("tol_x", tol_x)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: got {value}, must be positive and finite")
    if not isinstance(max_steps, numbers.Integral) or max_steps < 1:
        raise ValueError(f"max_steps: got {max_steps}, must be an integer of at least 1")


def solve_system(  # noqa: PLR0913 - keyword arguments of the public interface
    residual: Callable[[Float], ArrayLike],
    jacobian: Callable[[Float], ArrayLike],
    x0: ArrayLike,
    operator: str = "dogleg",
    tol_f: float = 1e-12,
    tol_x: float = 1e-12,
    max_steps: int = 1000,
) -> Solution:
    """Solve residual(x) = 0, or minimise ‖residual(x)‖₂ if there are more equations than unknowns.

    Args:
        residual: Function that returns r (m,), m ≥ n, for x (n,).
        jacobian: Function that returns ∂r/∂x (m, n) for x (n,).
        x0: (n,) starting point.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        tol_f: Largest |r| at a root; at a minimum, largest fraction of r in the range of J.
        tol_x: Largest remaining correction, relative to max(1, max|x|).
        max_steps: Maximum number of trial steps, including rejected steps.

    Returns:
        The best iterate with its status, which is ``INVALID_START`` if there are fewer equations than
        unknowns, or if the residual or Jacobian is not finite at ``x0``. For the meaning of CONVERGED, see
        :mod:`skinnode.solve.operators.loop`.

    Raises:
        ValueError: If an argument is out of range, or an argument or returned array has the wrong shape. A
            residual or Jacobian that is not finite never raises an exception.
    """
    code = operator_code(operator)
    require_tolerances(tol_f, tol_x, max_steps)
    start = time.perf_counter()
    x = require_array("x0", x0, ("n",))
    n = x.size
    first = require_array("residual(x0)", residual(x.copy()), ("m",), finite=False)
    m = first.size
    w = workspace(n, m)
    w.x[:], w.r[:] = x, first
    evaluations, jacobians, steps = 1, 0, 0

    def refresh_jacobian() -> None:
        w.jt[:] = require_array("jacobian(x)", jacobian(w.x.copy()), (m, n), finite=False).T

    if m >= n:
        refresh_jacobian()
        jacobians += 1
    went = start_solve(w)
    if went == op.TRY:
        went = op.REJECTED if np.isfinite(w.jt).all() else op.INVALID_START
    while went < 0:
        went = advance(code, w, went, tol_f, tol_x)
        if went == op.ACCEPTED:
            refresh_jacobian()
            jacobians += 1
        elif went == op.TRY:
            if steps >= max_steps:
                went = op.MAX_STEPS
                break
            steps += 1
            evaluations += 1
            w.r_trial[:] = require_array("residual(x)", residual(w.trial.copy()), (m,), finite=False)
    error = math.inf
    if went == op.CONVERGED:
        share = final_error(w, np.empty((n, m)))
        error = share * max(1.0, float(np.abs(w.x).max()))
        if not share <= (op.ROOT_SHARE if m == n else op.MINIMUM_SHARE):
            went = op.ILL_CONDITIONED
    with np.errstate(all="ignore"):
        return Solution(
            x=w.x.copy(),
            status=Status(went),
            residual_norm=float(np.linalg.norm(w.r)),
            optimality=float(np.abs(w.jt @ w.r).max()) if went != op.INVALID_START else math.nan,
            error_estimate=error,
            stats=SolveStats(evaluations, jacobians, steps, time.perf_counter() - start),
        )
