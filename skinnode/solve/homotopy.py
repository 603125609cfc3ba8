"""The paper's method: the samples taken while the press happens lead the solver to the last one.

H(X, t) = F(X) − ρ / R(t); X(0) is the grid at rest, each sample is solved from the solution of the one
before (Lahaye), the intermediate ones at a loose tolerance, the last at a tight one (Xu et al. 2018,
sections 3.2, 5).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status
from skinnode.solve import operators as op
from skinnode.solve import wires
from skinnode.solve.problem import PatchProblem
from skinnode.solve.system import operator_code, require_tolerances


class Schedule(Protocol):
    """Which samples to solve, and how well."""

    def stages(self, samples: int) -> list[tuple[int, float, int]]:
        """(sample, tolerance, most steps) in the order to solve them; the last is the frame wanted."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Every sample in turn. Defaults are the paper's protocol (section 4)."""

    intermediate_tolerance: float = 1e-6
    final_tolerance: float = 1e-12
    intermediate_steps: int = 100
    final_steps: int = 1000

    def __post_init__(self) -> None:
        require_tolerances(self.intermediate_tolerance, self.final_tolerance, self.intermediate_steps)
        require_tolerances(self.intermediate_tolerance, self.final_tolerance, self.final_steps)

    def stages(self, samples: int) -> list[tuple[int, float, int]]:
        """All samples."""
        loose = [(t, self.intermediate_tolerance, self.intermediate_steps) for t in range(samples - 1)]
        return [*loose, (samples - 1, self.final_tolerance, self.final_steps)]


@dataclass(frozen=True, slots=True, eq=False)
class PathResult:
    """Where a path ended, and what each sample on it cost."""

    upper_m: Float
    """(U, N, 3) electrodes at the last sample, metres."""
    displacement_m: Float
    """(U, N, 3) from the rest position."""
    status: tuple[Status, ...]
    """One for each upper wire."""
    error_estimate_m: Float
    """(U,) largest error of a coordinate left by tolerance and rounding, given exact samples; inf where
    unknown."""
    residual: Float
    """(U,) RMS of F/b − 1 at the end."""
    sample: NDArray[np.int64]
    """(S,) index of each sample solved."""
    steps: NDArray[np.int64]
    """(S, U) steps of the operator; 0 where the sample was skipped."""
    evaluations: NDArray[np.int64]
    """(S, U) evaluations of F with J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ of the dimensionless problem at the end of the sample."""
    stats: SolveStats


def solve_path(
    layout: PatchLayout,
    samples_ohm: ArrayLike,
    *,
    operator: str = "dogleg",
    schedule: Schedule | None = None,
    baseline_ohm: ArrayLike | None = None,
) -> PathResult:
    """Follow a press through its resistances from the rest position to the last sample.

    Args:
        layout: the patch, with at least as many lower wires as unknowns a wire (K ≥ 3N).
        samples_ohm: (T, U, K) resistances in the order they were taken, the last being the frame wanted.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        schedule: which samples to solve and how well; ``Uniform()`` by default.
        baseline_ohm: (U, K) resistances measured at rest; the resistivity and gain then cancel.

    A wire whose Jacobian changed the sign of its determinant on the way, or whose electrodes left the side of
    the lower layer they were on, may sit on another branch of F = b: it is ILL_CONDITIONED, not CONVERGED.
    Raises ValueError for wrong shapes, values that are not positive and finite, or an unknown operator.
    """
    code = operator_code(operator)
    samples = require_array("samples_ohm", samples_ohm, ("T", *layout.shape))
    if not (samples > 0).all():
        where = tuple(int(i) for i in np.argwhere(~(samples > 0))[0])
        raise ValueError(f"samples_ohm: got {samples[where]} at {list(where)}, must be positive")
    schedule = Uniform() if schedule is None else schedule
    problem = PatchProblem.of(layout, baseline_ohm)
    start = time.perf_counter()
    solver = wires.Solver(problem, code)
    stages = schedule.stages(len(samples))
    shape = (len(stages), layout.shape[0])
    steps, evaluations = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    optimality = np.zeros(shape)
    todo = np.full(shape[1], wires.SOLVE, np.uint8)
    weight = np.ones(layout.shape)
    branch = solver.solve_rest()
    crossed = np.zeros(shape[1], bool)
    for s, (sample, tolerance, most) in enumerate(stages):
        tasks = wires.COVARIANCE if s == len(stages) - 1 else wires.SKIP
        solver.solve(todo, samples[sample] * problem.gain, weight, tasks, tolerance, tolerance, most)
        steps[s] = solver.report[:, wires.STEPS]
        evaluations[s] = solver.report[:, wires.EVALUATIONS]
        optimality[s] = solver.measure[:, wires.OPTIMALITY]
        known = solver.report[:, wires.BRANCH]
        crossed |= known * branch < 0
        branch = np.where(known != 0, known, branch)
    ended = solver.report[:, wires.STATUS].copy()
    ended[(ended == op.CONVERGED) & (crossed | problem.out_of_reach(solver.x))] = op.ILL_CONDITIONED
    displacement = problem.displacement_m(solver.x)
    total = int(evaluations.sum())
    return PathResult(
        upper_m=layout.upper_m + displacement,
        displacement_m=displacement,
        status=tuple(Status(code) for code in ended.tolist()),
        error_estimate_m=solver.measure[:, wires.ERROR_ESTIMATE] * layout.pitch_m,
        residual=solver.measure[:, wires.RESIDUAL].copy(),
        sample=np.array([stage[0] for stage in stages]),
        steps=steps,
        evaluations=evaluations,
        optimality=optimality,
        stats=SolveStats(total, total, int(steps.sum()), time.perf_counter() - start),
    )
