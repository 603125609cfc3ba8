"""State of a stream, shared by the exact tracker's modules: solver, arrays and acceptance of roots.

A root of F = b is accepted only if it passes two tests. Each electrode must be within its clearance of its
rest position; the clearance is its distance at rest from the nearest lower electrode. The determinant of J
must have the same sign as at rest. If a wire has more equations than unknowns, J has no determinant, and a χ²
test of the residual replaces the second test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.kernels import relative_residual
from skinnode.model.layout import Float
from skinnode.process.clock import perf_counter
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators import codes as op
from skinnode.solve.roots import on_rest_branch
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.arrays import FrameArrays, SolveOptions, solve_options
from skinnode.solve.wires.patch_solver import PatchSolver
from skinnode.solve.wires.problem import PatchProblem

TOLERANCE: Final = 1e-9
"""Tolerance of a solve, for the residual r and for the positions x in pitches.

The tolerance is four orders of magnitude below the relative noise of a 24-bit converter. A single Newton step
reduces an error of 1e-5 to less than 1e-9.
"""
FRAME_STEPS: Final = 12
"""Maximum number of steps per solve; Newton's method takes 3 to 6 steps within the trust region."""
TASKS: Final = wires.COVARIANCE | wires.REUSE
"""Tasks of each solve: compute the covariance and reuse the last J⁻¹ where possible."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Noise, deadline and order of the wires in the current frame."""

    sigma: float
    """Minimum relative standard deviation of the resistances."""
    order: Index
    """(U,) indices of the upper wires, in the order in which to solve them."""
    until: float
    """Deadline on the ``perf_counter`` clock, in s; inf for no deadline."""

    @property
    def expired(self) -> bool:
        """Whether the deadline has passed."""
        return self.until < math.inf and perf_counter() >= self.until


class StreamState:
    """Solver and arrays of one stream, which the modules of the exact tracker modify in place.

    Each stream needs its own instance.

    Args:
        problem: The patch in solver units.
        operator: Operator code.
        normal_only: Whether to solve for z only.
        first: Action for wires with a valid J⁻¹: HOLD or PREDICT.
    """

    def __init__(self, problem: PatchProblem, operator: int, normal_only: bool, first: int) -> None:
        self.problem = problem
        self.solver = PatchSolver(problem, operator, normal_only)
        self._rest_branch = self.solver.solve_rest()
        self._rest_known = self.solver.report[:, wires.STATUS] == op.CONVERGED
        self._rest_inverse = self.solver.inverse.copy()
        self.arrays = FrameArrays(problem, self._rest_branch, self.unknowns, first)
        self.options = solve_options(operator, TASKS, TOLERANCE, TOLERANCE, FRAME_STEPS)

    def reset(self) -> None:
        """Discard the state of the stream and return to the rest position."""
        solver, arrays = self.solver, self.arrays
        arrays.x[:], arrays.a_solved[:] = self.problem.rest, self.problem.a_rest
        solver.inverse[:] = self._rest_inverse
        solver.turn[:] = 0
        solver.a_solved[:] = self.problem.a_rest
        solver.noise[:] = 0.0
        arrays.weight_solved[:] = 1.0
        arrays.predictable[:] = self._rest_known

    @property
    def unknowns(self) -> NDArray[np.int64]:
        """(U,) number of unknowns of each wire."""
        return np.asarray(self.solver.each * self.solver.free)

    def solve(
        self,
        todo: NDArray[np.uint8],
        frame: Frame,
        *,
        a: Float | None = None,
        options: SolveOptions | None = None,
        units: float = math.inf,
    ) -> None:
        """Solve the wires selected by ``todo`` (U,).

        Args:
            todo: (U,) action for each wire: LEAVE, SOLVE, PREDICT or HOLD.
            frame: Frame that provides σ and the order of the wires.
            a: (U, K) scaled resistances; default: those of the frame.
            options: Options for the solve; default: those of the stream.
            units: Time limit, as in :meth:`PatchSolver.solve`.
        """
        self.solver.solve(
            todo,
            self.arrays.a if a is None else a,
            self.arrays.weight,
            self.options if options is None else options,
            sigma=frame.sigma,
            order=frame.order,
            units=units,
        )

    def only(self, u: int) -> NDArray[np.uint8]:
        """Return the actions (U,) that solve only wire u."""
        todo = np.full(len(self.solver.x), wires.LEAVE, np.uint8)
        todo[u] = wires.SOLVE
        return todo

    def roots(self) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires with a plausible root on the branch of the rest position."""
        solver = self.solver
        report, out_of_reach = solver.report, self.problem.out_of_reach(solver.x)
        return on_rest_branch(
            report[:, wires.STATUS], report[:, wires.BRANCH], self._rest_branch, out_of_reach
        )

    def solvable(self) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires with at least as many usable resistances as unknowns."""
        count = np.count_nonzero(self.arrays.used, axis=1)
        return np.asarray((count > 0) & (count >= self.unknowns))

    def relative_residual(self, x: Float, a: Float) -> Float:
        """Return the residuals a F(x) − 1 (K,) of a wire with its electrodes at ``x`` (3N,) in pitches."""
        gaps = x.reshape(-1, 1, 3, 1) - self.problem.lower.transpose(1, 0, 2)[None]
        return np.asarray(relative_residual(a, (1.0 / np.sqrt((gaps**2).sum(axis=2))).sum(axis=(0, 1))))

    def a_at(self, x: Float) -> Float:
        """Return the ``a`` (K,) for which a F(x) = 1, with the electrodes at ``x`` (3N,) in pitches."""
        return np.asarray(1.0 / (1.0 + self.relative_residual(x, np.ones(self.problem.layout.shape[1]))))
