"""The paper's method: the samples taken during a press lead the solver to the last one.

H(X, t) = F(X) − ρ / R(t); X(0) is the grid at rest, and each sample is solved from the solution of the one
before (Lahaye; Xu et al. 2018, section 3.2). Step control (:mod:`skinnode.solve.paths.step_control`) chooses
the samples, their tolerance and the points between them.
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
from skinnode.solve import roots
from skinnode.solve.cramer_rao import wire_std
from skinnode.solve.operators.system import operator_code
from skinnode.solve.paths.corrector import Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.paths.root_selection import (
    PatchEstimate,
    compare_with_estimate,
    doubt_twins,
    keep_likeliest,
)
from skinnode.solve.paths.step_control import Schedule, Uniform
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.wires.problem import PatchProblem

SELECTION: Final = Accuracy(tolerance=1e-12, max_steps=100)
"""Accuracy of a root looked for on the posterior's word: the paper's final tolerance, and its maximum steps
of an intermediate sample."""
STARTS: Final = 12
"""Starts, drawn from the posterior, from which another root is looked for if a layout has folds; every call
draws the same."""


@dataclass(frozen=True, slots=True, eq=False)
class PathResult:
    """End of a path, and cost of each point on it.

    Row s of the last four arrays is one call of the solver, in order; a wire that the call left alone has a
    position and an optimality of NaN. After the first row at the last sample come second tries and checks.
    """

    upper_m: Float
    """(U, N, 3) electrodes at the last sample, metres."""
    displacement_m: Float
    """(U, N, 3) from the rest position."""
    status: tuple[Status, ...]
    """One for each upper wire."""
    error_estimate_m: Float
    """(U,) metres, largest error of a coordinate left by tolerance and rounding, given exact samples; inf if
    unknown."""
    residual: Float
    """(U,) RMS of F/b − 1 at the end."""
    cycle: int | None
    """Samples between two solves, if step control found or was given a cycle."""
    searched: int
    """Rows spent on the search for the cycle; the rows after them are the path."""
    position: Float
    """(S, U) sample solved, from 0; 1.5 is halfway from sample 1 to sample 2, −1 the rest."""
    steps: NDArray[np.int64]
    """(S, U) steps of the operator; 0 if the sample was skipped."""
    evaluations: NDArray[np.int64]
    """(S, U) evaluations of F with J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ of the dimensionless problem at the end of the call."""
    stats: SolveStats
    """Cost of the path, including the search for a cycle."""


def solve_path(
    layout: PatchLayout,
    samples_ohm: ArrayLike,
    *,
    operator: str = "dogleg",
    schedule: Schedule | None = None,
    baseline_ohm: ArrayLike | None = None,
) -> PathResult:
    """Follow a press through its resistances from the rest position to the last sample.

    A wire can end on another branch of F = b than the skin: if its Jacobian changed the sign of its
    determinant on the way, if its electrodes left their side of the lower layer, or if a second root as
    smooth lies across a fold nearby. It is then ILL_CONDITIONED, not CONVERGED. The skin itself can pass a
    fold; such a root is believed if the samples led across and the posterior of the patch comes to the same
    root.

    Args:
        layout: The patch, with at least as many lower wires as unknowns a wire (K ≥ 3N).
        samples_ohm: (T, U, K) resistances, ohm, in the order they were taken; the last is the frame wanted.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        schedule: Step control: ``Uniform()`` by default, ``Periodic()`` or ``Adaptive()``.
        baseline_ohm: (U, K) resistances measured at rest, ohm; the resistivity and gain then cancel.

    Returns:
        Positions at the last sample, a status for each wire, and the cost.

    Raises:
        ValueError: If a shape is wrong, a value is not positive and finite, or the operator is unknown.
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
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a diverged wire has a status
        tracker = PathTracker(problem, samples * problem.gain, code)
        (Uniform() if schedule is None else schedule).follow(tracker)
        estimate = None
        if roots.folded_wires(layout).any():
            estimate = _ask_posterior(tracker, layout, samples[-1], baseline_ohm)
        doubt_twins(tracker, estimate)
        tracker.end.doubt(roots.blind_wires(layout))
    displacement = problem.displacement_m(tracker.solver.x)
    log, end = tracker.corrector.log(), tracker.end
    total = int(log.evaluations.sum())
    return PathResult(
        upper_m=layout.upper_m + displacement,
        displacement_m=displacement,
        status=tuple(Status(code) for code in end.status.tolist()),
        error_estimate_m=end.error_estimate * layout.pitch_m,
        residual=end.residual,
        cycle=tracker.cycle,
        searched=tracker.searched,
        position=log.position,
        steps=log.steps,
        evaluations=log.evaluations,
        optimality=log.optimality,
        stats=SolveStats(total, total, int(log.steps.sum()), time.perf_counter() - start),
    )


def _ask_posterior(
    tracker: PathTracker, layout: PatchLayout, last_ohm: Float, baseline_ohm: ArrayLike | None
) -> PatchEstimate | None:
    """Let the posterior of the patch select the roots of the last sample; its estimate, None if untrusted."""
    patch = Posterior(layout, relative_noise=roots.REFEREE_NOISE, baseline_ohm=baseline_ohm, hold=False)
    field = patch.update(last_ohm)
    if not field.trusted:
        return None
    shape = tracker.problem.rest.shape
    moved, std = (
        (metres / layout.pitch_m).reshape(shape)
        for metres in (field.displacement_m, field.displacement_std_m)
    )
    estimate = PatchEstimate(tracker.problem.rest + moved, std)
    compare_with_estimate(tracker, estimate, SELECTION)
    covariance = patch.covariance_m2().reshape(*shape, *shape) / layout.pitch_m**2
    own = covariance[np.arange(shape[0]), :, np.arange(shape[0])]
    power, axes = np.linalg.eigh(own)
    z = np.random.default_rng(1).normal(size=(STARTS, *shape)) * np.sqrt(np.maximum(power, 0.0))
    drawn = estimate.x + np.einsum("uij,suj->sui", axes, z)
    nearly_blind = wire_std(layout, 1.0) > roots.NEARLY_BLIND
    unlikely = np.where(nearly_blind, roots.UNLIKELY_BLIND, roots.UNLIKELY)
    keep_likeliest(tracker, drawn, patch.energy, unlikely, SELECTION)
    return estimate
