"""Solver for all wires of a patch: buffers, and a compiled function that runs all stages of a frame.

All stages run in a single call, because passing arguments from Python to compiled code takes longer than most
of the stages.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators.work import workspace
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.arrays import (
    FrameArrays,
    SolveOptions,
    SolverArrays,
    read_frame,
    read_options,
    read_solver,
    solve_options,
)
from skinnode.solve.wires.decode import decode, scale
from skinnode.solve.wires.problem import PatchProblem
from skinnode.solve.wires.solve_wires import solve_wires
from skinnode.solve.wires.stages import accept_roots, choose, start, store

# Stages of a call, in the order in which they run; combine them with bitwise OR
DECODE: Final = 1
"""Convert codes to resistances."""
SCALE: Final = 2
"""Scale the resistances, and set the starting points to the last trusted positions."""
CHOOSE: Final = 4
"""Choose the action for each wire: SOLVE, PREDICT or HOLD."""
SOLVE: Final = 8
ACCEPT: Final = 16
"""Determine which wires have an acceptable root."""
STORE: Final = 32
"""Store the results; in a call with ACCEPT, only if all wires have an acceptable root."""

# Flags that a call returns, combined with bitwise OR
ALL_GOOD: Final = 1
INCOMPLETE: Final = 2
"""A new trusted solution was stored in which at least one equation has weight 0."""

REST_TOLERANCE: Final = 1e-9
"""Tolerance of the solve at the rest position, where the residual consists only of rounding errors."""
_NO_FRAME: Final = np.zeros((1, 4), np.int64)


@njit
def solve_patch(  # noqa: PLR0913 - numba unpacks a tuple of arguments eight times as slowly
    stages: int,
    frame_table: Index,
    solver_table: Index,
    options_table: Index,
    todo: NDArray[np.uint8],
    a: Float,
    weight: Float,
    order: Index,
    sigma: float,
    units: float,
) -> tuple[float, float, int, int]:
    """Run the given ``stages`` of a frame; the last six arguments are those of :func:`solve_wires`.

    Returns the time spent, as in :func:`solve_wires`; ``sigma``, which SCALE updates; the number of invalid
    codes; and the flags.
    """
    solver: SolverArrays = read_solver(solver_table)
    spent, invalid, found = 0.0, 0, 0
    if stages & (DECODE | SCALE | CHOOSE):
        frame: FrameArrays = read_frame(frame_table)
        if stages & DECODE:
            invalid = decode(frame)
        if stages & SCALE:
            sigma = scale(frame, sigma)
            start(solver, frame)
        if stages & CHOOSE:
            choose(frame)
    if stages & SOLVE:
        options: SolveOptions = read_options(options_table)
        spent = solve_wires(solver, options, todo, a, weight, order, sigma, units)
    if stages & (ACCEPT | STORE):
        done: FrameArrays = read_frame(frame_table)
        if stages & ACCEPT and accept_roots(solver, done):
            found |= ALL_GOOD
        if stages & STORE and (found & ALL_GOOD or not stages & ACCEPT) and store(solver, done):
            found |= INCOMPLETE
    return spent, sigma, invalid, found


class PatchSolver:
    """Solver for the wires of one patch; each tracker and each thread needs its own instance.

    Args:
        problem: The patch in solver units.
        operator: Operator code.
        normal_only: Whether to solve for z only.
    """

    def __init__(self, problem: PatchProblem, operator: int, normal_only: bool = False) -> None:
        upper, lower = problem.layout.shape
        unknowns = problem.layout.unknowns
        self.problem = problem
        self.operator = operator
        self.x = problem.rest.copy()
        """(U, 3N) positions, in pitches: starting points before a solve, solutions after it."""
        self.inverse = np.zeros((upper, unknowns, lower))
        self.a_solved = np.ones((upper, lower))
        self.noise = np.zeros((upper, lower))
        self.std = np.full((upper, unknowns), np.inf)
        """(U, 3N) standard deviation of ``x``, in pitches; inf if unknown."""
        self.report = np.zeros((upper, wires.REPORT), np.int64)
        self.measure = np.zeros((upper, wires.MEASURES))
        self.tally = np.zeros(3, np.int64)
        """Numbers of F evaluations, J evaluations and steps since the array was last set to 0."""
        self.turn = np.zeros(1, np.int64)
        """(1,) frame number, which SCALE increments.

        The frame number determines which wires compute a new inverse despite REUSE.
        """
        self.still_std = np.full((upper, unknowns), np.inf)
        """(U, 3N) standard deviations of the coordinates that are not unknowns, in pitches."""
        self.each = 1 if normal_only else 3
        """Number of unknowns per electrode."""
        most = unknowns // 3
        self.free = np.full(upper, most)
        """(U,) number of electrodes with unknowns."""
        self._sizes: list[int] | None = [most]  # distinct values of ``free``; None if unknown
        self._in_turn = np.arange(upper)
        self._electrodes = np.tile(np.arange(most), (upper, 1))
        self._still = np.zeros((upper, lower))
        self._lower = problem.lower.copy()
        self._arrays: dict[int, SolverArrays] = {}  # key: number of electrodes with unknowns

    def electrodes(self, u: int) -> Index:
        """Return the electrodes of wire u that have unknowns."""
        return self._electrodes[u, : self.free[u]]

    def set_electrodes(self, u: int, electrodes: Index) -> None:
        """Make the given electrodes of wire u its unknowns, and fix all its other electrodes at rest.

        The inverse and the standard deviations of the wire are invalid until its next converged solve.
        """
        n = self.problem.layout.unknowns // 3
        rest = np.setdiff1d(np.arange(n), electrodes)
        self.free[u], self._sizes = len(electrodes), None
        self._electrodes[u, : len(electrodes)] = electrodes
        self.x[u].reshape(n, 3)[rest] = self.problem.rest[u].reshape(n, 3)[rest]
        self._still[u] = self.problem.share_at_rest[u, rest].sum(axis=0)

    def solve_rest(self) -> Index:
        """Compute J⁻¹ at the rest position; return the signs (U,) of det J, or 0 if J is not square."""
        todo, weight = np.full(len(self.x), wires.SOLVE, np.uint8), np.ones_like(self.a_solved)
        self.x[:] = self.problem.rest
        options = solve_options(self.operator, wires.COVARIANCE, REST_TOLERANCE, REST_TOLERANCE, 1)
        self.solve(todo, self.problem.a_rest.copy(), weight, options)
        self.x[:] = self.problem.rest
        return self.report[:, wires.BRANCH].copy()

    def solve(  # noqa: PLR0913 - what changes from call to call
        self,
        todo: NDArray[np.uint8],
        a: Float,
        weight: Float,
        options: SolveOptions,
        *,
        sigma: float = 0.0,
        order: Index | None = None,
        units: float = math.inf,
    ) -> None:
        """Solve the wires selected by ``todo``, starting at :attr:`x`, and store the results in this object.

        Args:
            todo: (U,) uint8 action for each wire: LEAVE, SOLVE, PREDICT or HOLD.
            a: (U, K) scaled resistances; values out of range are overwritten.
            weight: (U, K) weights of the equations; overwritten with 0 for values of ``a`` out of range.
            options: Operator, tasks and tolerances.
            sigma: Standard deviation of a residual of weight 1; 0 if unknown.
            order: (U,) indices of the wires, in the order in which to solve them; default: 0, 1, 2, …
            units: Time limit, as in :func:`skinnode.solve.wires.solve_wires.solve_wires`. The report of each
                processed wire has a TURN of 1.

        Raises TypeError if ``todo``, ``a`` or ``weight`` has the wrong element type or shape.
        """
        shape = self.a_solved.shape
        given = (
            ("todo", todo, np.uint8, shape[:1]),
            ("a", a, np.float64, shape),
            ("weight", weight, np.float64, shape),
        )
        for name, array, dtype, due in given:
            if array.dtype != dtype or array.shape != due or not array.flags.c_contiguous:
                raise TypeError(
                    f"{name}: got {array.dtype} of shape {array.shape}, must be a contiguous "
                    f"{np.dtype(dtype)} array of shape {due}"
                )
        sizes = self._sizes or sorted(set(self.free[todo != wires.LEAVE].tolist()))
        for size in sizes:  # several sizes occur only after set_electrodes()
            chosen = todo if len(sizes) == 1 else np.where(self.free == size, todo, wires.LEAVE)
            spent, _, _, _ = solve_patch(
                SOLVE,
                _NO_FRAME,
                self._table(size),
                options.table,
                chosen.astype(np.uint8, copy=False),
                a,
                weight,
                self._in_turn if order is None else order,
                sigma,
                units,
            )
            units -= spent

    def advance(
        self, stages: int, frame: FrameArrays, options: SolveOptions, sigma: float, units: float
    ) -> tuple[float, int, int]:
        """Run the given ``stages`` of a frame. SOLVE requires all wires to have the same number of unknowns.

        Returns the standard deviation of a residual of weight 1, the number of invalid codes, and the flags
        ALL_GOOD and INCOMPLETE.
        """
        _, sigma, invalid, found = solve_patch(
            stages,
            frame.table,
            self._table(self._sizes[0] if self._sizes else 0),
            options.table,
            frame.todo,
            frame.a,
            frame.weight,
            frame.order,
            sigma,
            units,
        )
        return sigma, invalid, found

    def _table(self, size: int) -> NDArray[np.int64]:
        """Return the table of the solver's arrays for wires with unknowns on ``size`` electrodes."""
        if size not in self._arrays:
            lower = self.problem.layout.shape[1]
            self._arrays[size] = SolverArrays(
                x=self.x,
                inverse=self.inverse,
                a_solved=self.a_solved,
                noise=self.noise,
                std=self.std,
                report=self.report,
                measure=self.measure,
                tally=self.tally,
                lower=self._lower,
                electrodes=self._electrodes,
                still=self._still,
                still_std=self.still_std,
                turn=self.turn,
                step_limit=self.problem.step_limit,
                point=np.zeros(3 * size),
                raw=np.zeros((3 * size, lower)),
                work=workspace(self.each * size, lower),
            )
        return self._arrays[size].table
