"""Solver for any system r(x) = 0 with at least as many equations as unknowns.

Levenberg-Marquardt and dogleg make up to three attempts from the same starting point x₀, with different trust
regions:

1. Moré's column scaling with an initial radius of 100 ‖D x₀‖, as in MINPACK;
2. D = I with an initial radius of ‖x₀‖;
3. D = I with an initial radius of 0.1 ‖x₀‖.

No choice of D is best for every system. Column scaling suits unknowns with different units, but a column of J
with a large norm near x₀ restricts all later steps. The attempts therefore take turns of 100, 200, 400, …
steps each, until one of them finds a root or a minimum.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float, require_array
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve.operators import codes as op
from skinnode.solve.operators.attempt import Attempt, System
from skinnode.solve.operators.minimum import Point
from skinnode.solve.operators.result import PointKind, Solution

TURN: Final = 100
"""Number of steps in the first turn of each attempt; each later turn has twice as many as the turn before.

With column scaling, the operators converge from 90 of the 138 starting points in 46 problems by Moré, Garbow
& Hillstrom. In 79 (dogleg) or 72 (Levenberg-Marquardt) of these 90 cases, 100 steps are enough.
"""
RADII: Final = (1.0, 0.1)
"""Initial trust radii of the attempts with D = I, relative to ‖x₀‖. From some starting points, only one of
the two radii leads to a solution."""


def operator_code(name: str) -> int:
    """Return the code of an operator. Raises ValueError if the name is unknown."""
    if not isinstance(name, str) or name not in op.OPERATORS:
        raise ValueError(f"operator: got {name!r}, must be one of {', '.join(op.OPERATORS)}")
    return op.OPERATORS[name]


def require_tolerances(tol_f: float, tol_x: float, max_steps: int) -> None:
    """Raise ValueError if a tolerance is not positive or ``max_steps`` is less than 1."""
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
    max_steps: int = 2000,
) -> Solution:
    """Solve residual(x) = 0, or minimise ‖residual(x)‖₂ if there are more equations than unknowns.

    Args:
        residual: Function that returns r (m,), m ≥ n, for x (n,).
        jacobian: Function that returns ∂r/∂x (m, n) for x (n,).
        x0: (n,) starting point.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        tol_f: Limit on max|r| at a root, and on ‖P r‖ / ‖r‖ at a minimum, where P projects onto the range of
            J.
        tol_x: Maximum size of the last Newton correction, relative to max(1, max|x|).
        max_steps: Maximum number of trial steps in all attempts together, including rejected steps.

    Returns:
        The best iterate, with its status and kind. CONVERGED means a root or, with more equations than
        unknowns, an isolated minimum of ‖r‖; ``kind`` says which. ILL_CONDITIONED means that the
        equations do not determine the point, or that J is singular at a minimum of a square system with
        r ≠ 0.
        INVALID_START means that there are fewer equations than unknowns, or that the residual or the Jacobian
        is not finite at ``x0``. The test for a minimum evaluates at least 2 n Jacobians, which are included
        in ``stats``.

    Raises:
        ValueError: If an argument is out of range, or an argument or a returned array has the wrong shape. A
            residual or Jacobian that is not finite does not raise an exception.
    """
    code = operator_code(operator)
    require_tolerances(tol_f, tol_x, max_steps)
    begin = perf_counter()
    x = require_array("x0", x0, ("n",))
    system = System(residual, jacobian, x)
    wide = system.m < system.n
    first = np.zeros((system.m, system.n)) if wide else system.jacobian(x).copy()
    start = Point(x, system.first, first)
    best = _solve(code, system, start, tol_f, tol_x, int(max_steps))
    at, invalid = best.at, best.went == op.INVALID_START
    with np.errstate(all="ignore"):
        return Solution(
            x=at.x.copy(),
            status=Status(best.went if best.went >= 0 else op.MAX_STEPS),
            kind=best.kind,
            residual_norm=math.sqrt(at.r.dot(at.r)),
            optimality=math.nan if invalid else float(np.abs(at.j.T @ at.r).max()),
            error_estimate=best.error if best.went == op.CONVERGED else math.inf,
            stats=SolveStats(system.evaluations, system.jacobians, system.steps, perf_counter() - begin),
        )


def _solve(  # noqa: PLR0913 - the arguments of solve_system
    code: int, system: System, start: Point, tol_f: float, tol_x: float, max_steps: int
) -> Attempt:
    """Run the attempts in turns; return the first that succeeds, or the one with the smallest residual."""
    attempts = [Attempt(code, system, start, 0.0)]
    later = [] if code == op.GAUSS_NEWTON else list(RADII)
    turn = TURN if later else max_steps
    while not all(each.ended for each in attempts):
        for number in range(1 + len(RADII)):
            if number >= len(attempts) and later:
                size = float(np.linalg.norm(start.x)) or 1.0
                attempts.append(Attempt(code, system, start, -size * later.pop(0)))
            if number < len(attempts) and not attempts[number].ended:
                attempts[number].run(min(turn, max_steps - system.steps), tol_f, tol_x)
                if attempts[number].decided:
                    return attempts[number]
            if system.steps >= max_steps:
                return _best(attempts, tol_x, 0)
        turn *= 2
    return _best(attempts, tol_x, max_steps - system.steps)


def _best(attempts: list[Attempt], tol_x: float, steps: int) -> Attempt:
    """Classify the point of the attempt with the smallest residual, and return the attempt."""
    best = min(attempts, key=lambda each: each.norm)
    if best.kind is PointKind.UNFINISHED and best.went != op.INVALID_START:
        best.settle(tol_x, steps)
    return best
