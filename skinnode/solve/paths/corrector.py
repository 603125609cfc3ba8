"""The corrector of a path tracker: solves wires at positions of a path, and logs what each call cost.

Positions count samples from 0; the rest is at −1. Between two samples ``a`` is interpolated on a straight
line. (1/a and log a do neither better nor worse: 0.3 to 1 pitch high, to 70 %, the counts of lost wires
differ by their scatter.)
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
"""Position of the rest on a path; the samples are at 0, 1, 2, …"""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """When a correction ends.

    Args:
        tolerance: Of r, and of x in pitches.
        max_steps: Maximum steps of the operator.
    """

    tolerance: float
    max_steps: int


@dataclass(frozen=True, slots=True, eq=False)
class PathLog:
    """The cost of every call of a corrector, S rows in order; NaN and 0 if a wire was left alone."""

    position: Float
    """(S, U) position solved."""
    steps: Index
    """(S, U) steps of the operator."""
    evaluations: Index
    """(S, U) evaluations of F with J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ at the end of the call."""


class Corrector:
    """Solves the wires of one patch at positions of its path. One owner.

    Args:
        problem: The patch.
        a: (T, U, K) R · gain of the samples.
        operator: Code of the operator.

    Attributes:
        solver: Holds the position ``x`` of every wire and the report of the last call.
        samples: T.
    """

    def __init__(self, problem: PatchProblem, a: Float, operator: int) -> None:
        self.solver = PatchSolver(problem, operator)
        self.samples = len(a)
        self._knots = np.concatenate([problem.a_rest[None], a])
        self._weight = np.ones_like(problem.a_rest)
        self._rows: list[tuple[Float, Index, Index, Float]] = []

    @property
    def last(self) -> float:
        """Position of the last sample."""
        return self.samples - 1.0

    @property
    def rows(self) -> int:
        """Calls logged."""
        return len(self._rows)

    def log(self) -> PathLog:
        """Return the cost of all calls so far."""
        position, steps, evaluations, optimality = zip(*self._rows, strict=True)
        return PathLog(np.array(position), np.array(steps), np.array(evaluations), np.array(optimality))

    def sample_a(self, sample: int) -> Float:
        """Return R · gain (U, K) of a sample, not to be written."""
        return np.asarray(self._knots[sample + 1])

    def log_start(self, wires_: NDArray[np.bool_], evaluations: Index) -> None:
        """Log the ``evaluations`` (U,) that a start at the last sample took on these wires (U,)."""
        nothing = np.full(len(evaluations), math.nan)
        self._rows.append((np.where(wires_, self.last, nothing), evaluations, evaluations, nothing))

    def a_at(self, position: Float | float) -> Float:
        """Return R · gain (U, K) of every wire at its position (U,), or of all wires at one sample."""
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
        """Solve wires from where they are, into ``solver``, and log the cost.

        Args:
            todo: (U,) LEAVE, SOLVE or PREDICT for each wire (:mod:`skinnode.solve.wires.arrays`).
            position: (U,) position of each wire, or one sample for all.
            accuracy: When a wire is done.
            tasks: Tasks of the driver, or-ed together.
            operator: Code of the operator; default the corrector's.
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
