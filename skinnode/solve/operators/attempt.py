"""Attempt of ``solve_system``: runs an operator with one initial trust region and classifies the last point.

The compiled loop reports CONVERGED at roots and near stationary points of ‖r‖. An attempt then decides
whether the equations determine x, and whether a stationary point with r ≠ 0 is a minimum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.layout import Float, require_array
from skinnode.solve.operators import codes as op
from skinnode.solve.operators.loop import advance, final_error
from skinnode.solve.operators.loop import start as start_solve
from skinnode.solve.operators.minimum import CURVED, Point, settle
from skinnode.solve.operators.result import PointKind
from skinnode.solve.operators.work import LIMIT, NORM, workspace

NEAR: Final = 1e-2
"""Largest cosine between r and a column of J below which an attempt switches to Newton's method for a
minimum.

Near a minimum with a large residual, the operators converge only linearly: they take 454 steps on the problem
of Brown & Dennis.
"""


class System:
    """Wrapper around the caller's functions that counts calls and validates the returned arrays.

    The returned array can be the caller's own, and the next call may overwrite it.
    """

    def __init__(
        self, residual: Callable[[Float], ArrayLike], jacobian: Callable[[Float], ArrayLike], x0: Float
    ) -> None:
        self._residual, self._jacobian = residual, jacobian
        self.n, self.evaluations, self.jacobians = x0.size, 1, 0
        first = residual(x0.copy())
        shape: tuple[int | str, ...] = ("m",)
        if type(first) is np.ndarray and first.ndim == 1 and first.size > 0:
            shape = first.shape  # require_array has a fast path for arrays of a known shape
        self.first = require_array("residual(x0)", first, shape, finite=False).copy()
        self.m = self.first.size

    def residual(self, x: Float) -> Float:
        """Return r (m,) at x. Raises ValueError if the caller's function returns the wrong shape."""
        self.evaluations += 1
        return require_array("residual(x)", self._residual(x.copy()), (self.m,), finite=False)

    def jacobian(self, x: Float) -> Float:
        """Return J (m, n) at x. Raises ValueError if the caller's function returns the wrong shape."""
        self.jacobians += 1
        j, shape = self._jacobian(x.copy()), (self.m, self.n)
        if type(j) is np.ndarray and j.dtype == np.float64 and j.shape == shape:
            return j  # J will be copied, so its memory order does not matter
        return require_array("jacobian(x)", j, shape, finite=False)

    @property
    def steps(self) -> int:
        """Number of trial points so far: all evaluations of r except the first."""
        return self.evaluations - 1


class Attempt:
    """Attempt to solve a system; it can be paused after any number of steps.

    Args:
        code: Operator code.
        system: The system to solve.
        start: Starting point.
        limit: 0 for Moré's column scaling and initial trust radius; a negative value for D = I and an initial
            trust radius of −``limit``.
    """

    def __init__(self, code: int, system: System, start: Point, limit: float) -> None:
        self._code, self._system = code, system
        self.kind, self.error = PointKind.UNFINISHED, math.inf
        self._settled: Point | None = None
        w = self._w = workspace(system.n, system.m)
        w.x[:], w.r[:], w.jt[:], w.s[LIMIT] = start.x, start.r, start.j.T, limit
        self.went = start_solve(w)
        if self.went == op.TRY:
            self.went = op.REJECTED if np.isfinite(w.jt).all() else op.INVALID_START

    @property
    def at(self) -> Point:
        """Best iterate. Its arrays are overwritten when the attempt continues."""
        return self._settled or Point(self._w.x, self._w.r, self._w.jt.T)

    @property
    def norm(self) -> float:
        """‖r‖₂ at the best iterate."""
        return float(self._w.s[NORM])

    @property
    def ended(self) -> bool:
        """Whether the attempt has ended with a status."""
        return self.went >= 0

    @property
    def decided(self) -> bool:
        """Whether the result of this attempt is final: an invalid start, or a root, minimum or flat point."""
        return self.went in (op.CONVERGED, op.INVALID_START) or self.kind in (PointKind.ROOT, PointKind.FLAT)

    def run(self, steps: int, tol_f: float, tol_x: float) -> None:
        """Take at most ``steps`` steps; classify the point if the solve ends or approaches a minimum."""
        code, w, system, went, left = self._code, self._w, self._system, self.went, steps
        while went < 0:
            if went == op.TRY:
                if left == 0:
                    break
                left -= 1
                w.r_trial[:] = system.residual(w.trial)
            went = advance(code, w, went, tol_f, tol_x)
            if went == op.ACCEPTED:
                w.jt[:] = system.jacobian(w.x).T
        self.went = went
        if went == op.INVALID_START:
            return
        if self._is_root(tol_f):
            self.kind = PointKind.ROOT
        elif system.m > system.n:
            self.settle(tol_x, left)

    def _is_root(self, tol_f: float) -> bool:
        """Return whether the solve ended at a root; estimate the error in x.

        If the error is too large, CONVERGED becomes ILL_CONDITIONED.
        """
        w, system = self._w, self._system
        square = system.m == system.n
        if self.went == op.CONVERGED:
            share = final_error(w, np.empty((system.n, system.m)))
            self.error = share * max(1.0, float(np.abs(w.x).max()))
            if share <= (op.ROOT_SHARE if square else op.MINIMUM_SHARE):
                return square or self.at.is_root(tol_f)
            self.went = op.ILL_CONDITIONED
        return self.ended and float(np.abs(w.r).max()) <= tol_f

    def settle(self, tol_x: float, steps: int) -> None:
        """Move to a nearby minimum of ‖r‖ by Newton's method and classify the stationary point reached."""
        at, system, converged = self.at, self._system, self.went == op.CONVERGED
        if converged:
            self.went = op.ILL_CONDITIONED
        if not at.cosine <= NEAR:
            return
        settled = settle(
            lambda x: system.residual(x).copy(), lambda x: system.jacobian(x).copy(), at, tol_x, steps
        )
        minimum = settled.error <= op.MINIMUM_SHARE * max(1.0, float(np.abs(settled.at.x).max()))
        if minimum:
            self.error = settled.error
        elif converged and settled.at is at:
            # In a very flat valley, rounding errors hide the curvature, but J has full rank.
            minimum = abs(settled.lowest) <= CURVED
        if minimum:
            self._settled, self.kind = settled.at, PointKind.MINIMUM
            self.went = op.CONVERGED if system.m > system.n else op.ILL_CONDITIONED
        elif self.ended:
            self._settled = settled.at
            if settled.at.cosine <= op.STATIONARY and not math.isnan(settled.lowest):
                self.kind = PointKind.FLAT if settled.lowest > -CURVED else PointKind.SADDLE
