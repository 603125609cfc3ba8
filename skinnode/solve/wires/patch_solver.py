"""The buffers of one patch and the one compiled call that reads and writes them.

Around the solve of a patch there is work on each frame, before and after (see ``frame``). All of it that a
frame needs is done in one call: a call from Python, its arguments checked and unpacked, costs more than any
of these steps, most of all with cold caches.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import Bundle
from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.linalg.factorisations import Index
from skinnode.solve.operators.steps import workspace
from skinnode.solve.wires import driver as wires
from skinnode.solve.wires import frame
from skinnode.solve.wires.problem import PatchProblem

# What a call does, or-ed together and in this order
DECODE: Final = 1
"""Codes to resistances."""
TAKE: Final = 2
"""The frame into the units of the problem; a solver that starts from the last trusted position."""
CHOOSE: Final = 4
"""What to do with each wire."""
SOLVE: Final = 8
REACH: Final = 16
"""Which wires came to a root that counts."""
FINISH: Final = 32
"""The outcome; after REACH only where all came to one."""

# What came of it, or-ed together
ALL_GOOD: Final = 1
INCOMPLETE: Final = 2
"""See :func:`skinnode.solve.wires.frame.finish`."""

_NO_FRAME: Final = np.zeros((1, 4), np.int64)


@njit
def solve_patch(
    stages: int,
    its: Index,
    first: int,
    pitch_m: float,
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
) -> tuple[float, float, int, int]:
    """The ``stages`` of a frame, whose arrays are ``its``, with the solver whose arrays are its ``own``;
    arguments as in ``driver.solve_wires`` and the functions of ``frame``. Returns what the
    solve cost, σ, how many codes were no measurement, and what came of it."""
    spent, invalid, found = 0.0, 0, 0
    if stages & DECODE:
        invalid = frame.decode(its)
    if stages & TAKE:
        sigma = frame.take(its, sigma)
        frame.clear(own, its)
    if stages & CHOOSE:
        frame.choose(its, first, todo)
    if stages & SOLVE:
        spent = wires.solve_wires(
            own, operator, tasks, todo, a, weight, order, sigma,
            tol_f, tol_x, max_steps, step_limit, units, turn,
        )  # fmt: skip
    if stages & REACH and frame.reach(own, its):
        found |= ALL_GOOD
    if stages & FINISH and (found & ALL_GOOD or not stages & REACH) and frame.finish(own, its, pitch_m):
        found |= INCOMPLETE
    return spent, sigma, invalid, found


class PatchSolver:
    """The buffers of one patch around :func:`solve_patch`. One owner, no threads."""

    def __init__(self, problem: PatchProblem, operator: int, normal_only: bool = False) -> None:
        upper, lower = problem.layout.shape
        unknowns = problem.layout.unknowns
        self.problem = problem
        self.operator = operator
        self.x = problem.rest.copy()
        """(U, 3N) the iterate of each wire, pitches."""
        self.inverse = np.zeros((upper, unknowns, lower))
        self.a_solved = np.ones((upper, lower))
        self.noise = np.zeros((upper, lower))
        self.std = np.full((upper, unknowns), np.inf)
        """(U, 3N) pitches."""
        self.report = np.zeros((upper, wires.REPORT), np.int64)
        self.measure = np.zeros((upper, wires.MEASURES))
        self.tally = np.zeros(3, np.int64)
        """Evaluations of F, of J and steps of all calls since its owner set it to zero."""
        self.turn = 0
        """Counted by the owner: says whose turn it is to have a new inverse, where it is reused."""
        self.still_std = np.full((upper, unknowns), np.inf)
        """(U, 3N) deviation of what is no unknown, pitches."""
        self.each = 1 if normal_only else 3
        """Unknowns an electrode."""
        most = unknowns // 3
        self.free = np.full(upper, most)
        """(U,) number of electrodes with unknowns."""
        self._sizes: list[int] | None = [most]  # of ``free``, None where they have to be looked for
        self._in_turn = np.arange(upper)
        self._electrodes = np.tile(np.arange(most), (upper, 1))
        self._still = np.zeros((upper, lower))
        self._lower = problem.lower.copy()
        self._bundles: dict[int, Bundle] = {}  # by the number of electrodes with unknowns
        self.step_limit = problem.step_limit

    def electrodes(self, u: int) -> Index:
        """The electrodes of wire u that have unknowns."""
        return self._electrodes[u, : self.free[u]]

    def set_electrodes(self, u: int, electrodes: Index) -> None:
        """Give unknowns to these electrodes of wire u only; the others go to rest. ``inverse`` and all that
        belongs to it is void until the next converged solve."""
        n = self.problem.layout.unknowns // 3
        rest = np.setdiff1d(np.arange(n), electrodes)
        self.free[u], self._sizes = len(electrodes), None
        self._electrodes[u, : len(electrodes)] = electrodes
        self.x[u].reshape(n, 3)[rest] = self.problem.rest[u].reshape(n, 3)[rest]
        self._still[u] = self.problem.share_at_rest[u, rest].sum(axis=0)

    def solve_rest(self) -> Index:
        """Solve the rest position itself, for its inverse; sign of det J (U,) there, 0 where it has none."""
        todo, weight = np.full(len(self.x), wires.SOLVE, np.uint8), np.ones_like(self.a_solved)
        self.x[:] = self.problem.rest
        self.solve(
            todo,
            self.problem.a_rest.copy(),
            weight,
            wires.COVARIANCE,
            wires.REST_TOLERANCE,
            wires.REST_TOLERANCE,
            1,
        )
        self.x[:] = self.problem.rest
        return self.report[:, wires.BRANCH].copy()

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
        order: Index | None = None,
        units: float = math.inf,
    ) -> None:
        """Solve the wires in ``todo`` from :attr:`x` on, into :attr:`x`, :attr:`std`, :attr:`report` and
        :attr:`measure`. ``a`` and ``weight`` (U, K) may be overwritten. ``order`` and ``units`` as in
        :func:`skinnode.solve.wires.driver.solve_wires`; who had a turn has TURN 1 in its report."""
        sizes = self._sizes or sorted(set(self.free[todo != wires.LEAVE].tolist()))
        for size in sizes:  # all the same, unless electrodes are left out
            chosen = todo if len(sizes) == 1 else np.where(self.free == size, todo, wires.LEAVE)
            spent, _, _, _ = solve_patch(
                SOLVE,
                _NO_FRAME,
                wires.LEAVE,
                0.0,
                self._bundle(size).table,
                self.operator if operator is None else operator,
                tasks,
                chosen.astype(np.uint8, copy=False),
                a,
                weight,
                self._in_turn if order is None else order,
                sigma,
                tol_f,
                tol_x,
                max_steps,
                self.step_limit,
                units,
                self.turn,
            )
            units -= spent

    def advance(
        self,
        stages: int,
        its: frame.FrameArrays,
        first: int,
        todo: NDArray[np.uint8],
        tasks: int,
        tolerance: float,
        max_steps: int,
        sigma: float,
        order: Index,
        units: float,
    ) -> tuple[float, int, int]:
        """The ``stages`` of a frame in one call: σ, how many codes were no measurement, and what came of it.
        To solve, all wires must have as many unknowns."""
        size = self._sizes[0] if self._sizes else 0
        _, sigma, invalid, found = solve_patch(
            stages,
            its.table,
            first,
            self.problem.layout.pitch_m,
            self._bundle(size).table,
            self.operator,
            tasks,
            todo,
            its.a,
            its.weight,
            order,
            sigma,
            tolerance,
            tolerance,
            max_steps,
            self.step_limit,
            units,
            self.turn,
        )
        return sigma, invalid, found

    def _bundle(self, size: int) -> Bundle:
        """All arrays, with a workspace for wires of which so many electrodes have unknowns."""
        if size not in self._bundles:
            lower = self.problem.layout.shape[1]
            point, raw = np.zeros(3 * size), np.zeros((3 * size, lower))
            work = workspace(self.each * size, lower)
            self._bundles[size] = Bundle(
                [
                    self.x, self.inverse, self.a_solved, self.noise, self.std, self.report, self.measure,
                    self.tally, self._lower, self._electrodes, self._still, self.still_std, point, raw, *work,
                ]
            )  # fmt: skip
        return self._bundles[size]
