"""The paper's method: the samples taken while the press happens lead the solver to the last one.

H(X, t) = F(X) − ρ / R(t); X(0) is the grid at rest, and each sample is solved from the solution of the one
before (Lahaye; Xu et al. 2018, section 3.2). Which samples, how well, and what happens between them is the
schedule's (:mod:`skinnode.solve.paths.step_control`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status
from skinnode.solve.branch import BLIND, NEARLY_BLIND, REFEREE_NOISE, folded_wires, wire_deviations
from skinnode.solve.operators.system import operator_code
from skinnode.solve.paths.path_tracker import Walk
from skinnode.solve.paths.step_control import Schedule, Uniform
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.wires.problem import PatchProblem

CONSULT_TOLERANCE: Final = 1e-12
CONSULT_STEPS: Final = 100
"""The paper's final tolerance, and its most steps of an intermediate sample."""
UNLIKELY: Final = 4.0
"""Energy by which other roots must be less likely. Of 1530 pairs of roots of presses of 30 to 70 % on
staggered, h = 1, and aligned, h = 0.5, the wrong one was the likelier in 19, by 1.4 at most, and in as many
pairs more by 2.6. That the samples led to a root is no better proof: with 5 of them by 2.5 as well."""
UNLIKELY_BLIND: Final = 16.0
"""The same for wires that see next to nothing, where there may be more roots than are found."""
RIVALS: Final = 12
"""Starts, drawn from the posterior, from which another root is looked for where a layout has folds; the same
ones every time."""


@dataclass(frozen=True, slots=True, eq=False)
class PathResult:
    """Where a path ended, and what each point on it cost.

    Row s of the last four arrays is one call of the solver, in order; a wire the call left alone has a
    position and an optimality of NaN. After the first row at the last sample come second tries and checks.
    """

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
    cycle: int | None
    """Samples between two solves, where the schedule found or was given a cycle."""
    searched: int
    """Rows spent on finding the cycle; the path itself is what follows them."""
    position: Float
    """(S, U) sample solved, from 0; 1.5 is halfway from sample 1 to sample 2, −1 the rest."""
    steps: NDArray[np.int64]
    """(S, U) steps of the operator; 0 where the sample was passed over."""
    evaluations: NDArray[np.int64]
    """(S, U) evaluations of F with J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ of the dimensionless problem at the end of the call."""
    stats: SolveStats
    """The whole cost, the search for a cycle included."""


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
        schedule: which samples to solve and how well: ``Uniform()`` by default, ``Periodic()``,
            ``Adaptive()``.
        baseline_ohm: (U, K) resistances measured at rest; the resistivity and gain then cancel.

    A wire may sit on another branch of F = b than the skin: where its Jacobian changed the sign of its
    determinant on the way, its electrodes left the side of the lower layer they were on, or a second root as
    smooth lies across a fold nearby. It is ILL_CONDITIONED then, not CONVERGED. The skin itself can pass a
    fold; that is believed where the samples led across and the posterior of the patch comes to the same root.
    Raises ValueError for wrong shapes, values that are not positive and finite, or an unknown operator.
    """
    code = operator_code(operator)
    samples = require_array("samples_ohm", samples_ohm, ("T", *layout.shape))
    if not (samples > 0).all():
        where = tuple(int(i) for i in np.argwhere(~(samples > 0))[0])
        raise ValueError(f"samples_ohm: got {samples[where]} at {list(where)}, must be positive")
    if layout.shape[1] < layout.unknowns:
        raise ValueError(
            f"layout: got {layout.shape[1]} lower wires for {layout.unknowns} unknowns an upper wire, "
            "must be at least as many"
        )
    if schedule is not None and (isinstance(schedule, type) or not hasattr(schedule, "follow")):
        raise ValueError(f"schedule: got {schedule!r}, must be Uniform(), Periodic(), Adaptive() or alike")
    problem = PatchProblem.of(layout, baseline_ohm)
    start = time.perf_counter()
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a diverged wire, told by its status
        walk = Walk(problem, samples * problem.gain, code)
        (Uniform() if schedule is None else schedule).follow(walk)
        if folded_wires(layout).any():
            _consult(walk, layout, samples[-1], baseline_ohm)
        walk.doubt_twins()
        walk.refuse(wire_deviations(layout, 1.0) > BLIND)
    displacement = problem.displacement_m(walk.solver.x)
    position, steps, evaluations, optimality = walk.log
    total = int(evaluations.sum())
    return PathResult(
        upper_m=layout.upper_m + displacement,
        displacement_m=displacement,
        status=tuple(Status(code) for code in walk.status.tolist()),
        error_estimate_m=walk.error_estimate * layout.pitch_m,
        residual=walk.residual,
        cycle=walk.cycle,
        searched=walk.searched,
        position=position,
        steps=steps,
        evaluations=evaluations,
        optimality=optimality,
        stats=SolveStats(total, total, int(steps.sum()), time.perf_counter() - start),
    )


def _consult(walk: Walk, layout: PatchLayout, last_ohm: Float, baseline_ohm: ArrayLike | None) -> None:
    """Let the posterior of the patch say which root of the last sample the skin is at."""
    patch = Posterior(layout, relative_noise=REFEREE_NOISE, baseline_ohm=baseline_ohm, hold=False)
    field = patch.update(last_ohm)
    if not field.trusted:
        return
    shape = walk.problem.rest.shape
    moved, std = (
        (metres / layout.pitch_m).reshape(shape)
        for metres in (field.displacement_m, field.displacement_std_m)
    )
    estimate = walk.problem.rest + moved
    walk.consult(estimate, std, CONSULT_TOLERANCE, CONSULT_STEPS)
    covariance = patch.covariance_m2().reshape(*shape, *shape) / layout.pitch_m**2
    own = covariance[np.arange(shape[0]), :, np.arange(shape[0])]
    power, axes = np.linalg.eigh(own)
    z = np.random.default_rng(1).normal(size=(RIVALS, *shape)) * np.sqrt(np.maximum(power, 0.0))
    drawn = estimate + np.einsum("uij,suj->sui", axes, z)
    nearly_blind = wire_deviations(layout, 1.0) > NEARLY_BLIND
    unlikely = np.where(nearly_blind, UNLIKELY_BLIND, UNLIKELY)
    walk.weigh_rivals(drawn, patch.energy, unlikely, CONSULT_TOLERANCE, CONSULT_STEPS)
