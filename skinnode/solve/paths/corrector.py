"""Corrector for a path tracker: solves wires at given path positions, and logs the solver steps.

A path position is a sample number, counted from 0; −1 is the patch at rest. Between two samples, ``a`` is
interpolated linearly. In tests, interpolating 1/a or log a instead did not significantly change the number of
wires that were solved.
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
"""Path position of the undeformed patch; the samples are at 0, 1, 2, …"""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Stopping criteria of a correction.

    Args:
        tolerance: Tolerance of r, and of x in pitches.
        max_steps: Maximum number of operator steps.
    """

    tolerance: float
    max_steps: int


@dataclass(frozen=True, slots=True, eq=False)
class PathLog:
    """Solver steps and evaluations of each of S corrector calls; NaN or 0 for wires that a call skipped."""

    position: Float
    """(S, U) position on the path."""
    steps: Index
    """(S, U) operator steps."""
    evaluations: Index
    """(S, U) evaluations of F and J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ at the end of the call."""


class Corrector:
    """Solver for a patch's wires at positions on a path; each path needs its own instance.

    Args:
        problem: The patch.
        a: (T, U, K) R · gain of the samples.
        operator: Operator code.

    Attributes:
        solver: Solver with the position ``x`` of every wire and the report of the last call.
        samples: Number of samples, T.
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
        """Return R · gain (U, K) of a sample; do not write to the array."""
        return np.asarray(self._knots[sample + 1])

    def log_start(self, wires_: NDArray[np.bool_], evaluations: Index) -> None:
        """Log the ``evaluations`` (U,) needed to find starting points for the given wires (U,)."""
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
        """Solve wires from their current positions; store the result in ``solver``, and log the solver steps.

        Args:
            todo: (U,) LEAVE, SOLVE or PREDICT per wire (:mod:`skinnode.solve.wires.arrays`).
            position: (U,) path position of each wire, or one sample for all wires.
            accuracy: Stopping criteria.
            tasks: Additional tasks, combined with bitwise or.
            operator: Operator code; the default is the corrector's operator.
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
