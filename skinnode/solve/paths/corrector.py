"""Corrector of a path tracker: solves wires at given positions on the path and logs each call.

A path position is a sample number, counted from 0; the patch at rest is at −1. Between samples, ``a``
(R · gain) is interpolated linearly. Interpolating 1/a or log a instead solves about the same number of wires.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.patch_solver import PatchSolver
from skinnode.solve.wires.problem import PatchProblem

REST: Final = -1.0
"""Path position of the patch at rest; the samples are at 0, 1, 2, …"""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Stopping criteria of a solve.

    Args:
        tolerance: Tolerance, for r and for x in pitches.
        max_steps: Maximum number of operator steps.
    """

    tolerance: float
    max_steps: int


@dataclass(frozen=True, slots=True, eq=False)
class PathLog:
    """Log of S corrector calls. For a wire that a call did not solve, floats are NaN and counts are 0."""

    position: Float
    """(S, U) path positions."""
    steps: Index
    """(S, U) numbers of operator steps."""
    evaluations: Index
    """(S, U) numbers of evaluations of F and J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ at the end of the call."""


class Corrector:
    """Solver for the wires of a patch at positions on a path; each path needs its own instance.

    Args:
        problem: The patch.
        a: (T, U, K) R · gain of the samples.
        operator: Operator code.

    Attributes:
        solver: Solver, which contains the positions of the wires and the report of the last call.
        samples: Number T of samples.
    """

    def __init__(self, problem: PatchProblem, a: Float, operator: int) -> None:
        self.solver = PatchSolver(problem, operator)
        self.samples = len(a)
        self._knots = np.concatenate([problem.a_rest[None], a])
        self._weight = np.ones_like(problem.a_rest)
        self._rows: list[tuple[Float, Index, Index, Float]] = []

    @property
    def last(self) -> float:
        """Path position of the last sample."""
        return self.samples - 1.0

    @property
    def rows(self) -> int:
        """Number of logged calls."""
        return len(self._rows)

    def log(self) -> PathLog:
        """Return the log of all calls so far."""
        position, steps, evaluations, optimality = zip(*self._rows, strict=True)
        return PathLog(np.array(position), np.array(steps), np.array(evaluations), np.array(optimality))

    def sample_a(self, sample: int) -> Float:
        """Return R · gain (U, K) of a sample, as an array that must not be modified."""
        return np.asarray(self._knots[sample + 1])

    def log_start(self, wires_: NDArray[np.bool_], evaluations: Index) -> None:
        """Log the numbers of evaluations (U,) for the starting points of the wires in the mask (U,)."""
        nothing = np.full(len(evaluations), math.nan)
        self._rows.append((np.where(wires_, self.last, nothing), evaluations, evaluations, nothing))

    def a_at(self, position: Float | float) -> Float:
        """Return R · gain (U, K) at one path position per wire (U,), or at one sample for all wires."""
        if isinstance(position, float):
            return np.asarray(self._knots[int(position) + 1].copy())
        before = np.clip(np.floor(position).astype(np.int64), -1, self.samples - 2)
        share = (position - before)[:, None]
        every = np.arange(len(position))
        first, second = self._knots[before + 1, every], self._knots[before + 2, every]
        return np.where(share == 1.0, second, first + share * (second - first))

    def correct(
        self,
        todo: NDArray[np.uint8],
        position: Float | float,
        accuracy: Accuracy,
        *,
        tasks: int = 0,
        operator: int | None = None,
    ) -> None:
        """Solve wires, starting from their current positions; update :attr:`solver` and the log.

        Args:
            todo: (U,) action for each wire: LEAVE, SOLVE or PREDICT (:mod:`skinnode.solve.wires.arrays`).
            position: (U,) path position of each wire, or one sample for all wires.
            accuracy: Stopping criteria.
            tasks: Additional tasks, combined with bitwise OR.
            operator: Operator code; default: the operator of this corrector.
        """
        solver = self.solver
        solver.solve(
            todo,
            self.a_at(position),
            self._weight.copy(),
            wires.solve_options(
                solver.operator if operator is None else operator,
                tasks,
                accuracy.tolerance,
                accuracy.tolerance,
                accuracy.max_steps,
            ),
        )
        asked = todo != wires.LEAVE
        steps, evaluations = solver.report[:, wires.STEPS], solver.report[:, wires.EVALUATIONS]
        optimality = solver.measure[:, wires.OPTIMALITY]
        if asked.all():
            every = np.full(len(todo), position) if isinstance(position, float) else position
            self._rows.append((every, steps.copy(), evaluations.copy(), optimality.copy()))
            return
        self._rows.append(
            (
                np.where(asked, position, math.nan),
                np.where(asked, steps, 0),
                np.where(asked, evaluations, 0),
                np.where(asked, optimality, math.nan),
            )
        )
