"""Path following as in the paper: solves a recorded press sample by sample, up to the last sample.

The path X(t) is the solution of H(X, t) = F(X) − ρ / R(t) = 0; X(0) is the grid at rest. The solution for
each sample is the starting point for the next (Lahaye; Xu et al. 2018, section 3.2). Step control
(:mod:`skinnode.solve.paths.step_control`) chooses which samples to solve, to what tolerance, and whether to
solve points between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve import roots
from skinnode.solve.cramer_rao import wire_std
from skinnode.solve.operators.system import operator_code
from skinnode.solve.options import PosteriorOptions
from skinnode.solve.paths.corrector import Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.paths.root_selection import (
    PatchEstimate,
    compare_with_estimate,
    doubt_twins,
    heed_samples,
    keep_likeliest,
)
from skinnode.solve.paths.step_control import Schedule, Uniform
from skinnode.solve.posterior.frame_estimator import FrameEstimator
from skinnode.solve.wires.problem import PatchProblem

SELECTION: Final = Accuracy(tolerance=1e-12, max_steps=100)
"""Accuracy of a solve that starts from the posterior estimate.

The tolerance is the paper's tolerance for the last sample. The maximum number of steps is the paper's limit
for all earlier samples.
"""
STARTS: Final = 12
"""Number of starting points in the search for other roots of F = b.

The starting points are random samples of the posterior; the random seed is fixed.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PathResult:
    """Solution at the end of a path and log of the solver calls on the path.

    The log consists of ``position``, ``steps``, ``evaluations`` and ``optimality``, with one row per solver
    call. For a wire that a call did not solve, the position and the optimality are NaN. Calls after the first
    solve of the last sample are second attempts and checks.
    """

    upper_m: Float
    """(U, N, 3) positions of the electrodes at the last sample, in metres."""
    displacement_m: Float
    """(U, N, 3) displacements of the electrodes at the last sample, in metres."""
    status: tuple[Status, ...]
    """Status of each upper wire."""
    error_estimate_m: Float
    """(U,) estimate of the largest coordinate error, in metres; inf if unknown.

    The estimate includes errors due to the tolerance and to rounding, but not errors in the samples.
    """
    residual: Float
    """(U,) RMS of the relative residual F/b − 1 at the last sample."""
    cycle: int | None
    """Cycle of periodic step control: number of samples from one solve to the next; None if there is none."""
    searched: int
    """Number of rows at the start of the log that belong to the search for the cycle."""
    position: Float
    """(S, U) path positions: sample numbers, counted from 0. The position 1.5 is halfway between samples 1
    and 2; −1 is the patch at rest."""
    steps: NDArray[np.int64]
    """(S, U) numbers of operator steps; 0 if the sample was skipped."""
    evaluations: NDArray[np.int64]
    """(S, U) numbers of evaluations of F and J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ of the dimensionless equations at the end of the call."""
    stats: SolveStats
    """Steps, evaluations and computing time of the whole path, including the search for a cycle."""


def solve_path(
    layout: PatchLayout,
    samples_ohm: ArrayLike,
    *,
    operator: str = "dogleg",
    schedule: Schedule | None = None,
    baseline_ohm: ArrayLike | None = None,
) -> PathResult:
    """Follow a press from the rest position to its last sample.

    F = b has several roots, separated by folds (det J = 0). If a root may be wrong, the status of the wire is
    ILL_CONDITIONED instead of CONVERGED. There are four such cases:

    - the determinant of the Jacobian changed sign on the path;
    - an electrode moved farther than its distance at rest from the nearest lower electrode;
    - an equally smooth root exists on the other side of a nearby fold;
    - a smooth path ended at a different root, which is then reported instead.

    The skin itself can cross a fold. A root across a fold is therefore accepted if the path and the posterior
    of the patch both lead to it.

    Args:
        layout: The patch, with at least as many lower wires as unknowns per wire (K ≥ 3N).
        samples_ohm: (T, U, K) resistances in ohms, in time order; the last sample is the frame to solve.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        schedule: Step control: ``Uniform()`` (default), ``Periodic()`` or ``Adaptive()``.
        baseline_ohm: (U, K) resistances measured at rest, in ohms. If given, errors in resistivity and gain
            cancel.

    Returns:
        Positions at the last sample, the status of each wire, and the log of the solver calls.

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
            f"layout: got {layout.shape[1]} lower wires for {layout.unknowns} unknowns per upper wire, "
            "must have at least as many lower wires as unknowns"
        )
    if schedule is not None and (isinstance(schedule, type) or not hasattr(schedule, "follow")):
        raise ValueError(f"schedule: got {schedule!r}, must be Uniform(), Periodic() or another Schedule")
    problem = PatchProblem.of(layout, baseline_ohm)
    start = perf_counter()
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # the status reports divergence
        tracker = PathTracker(problem, samples * problem.gain, code)
        (Uniform() if schedule is None else schedule).follow(tracker)
        estimate = None
        if roots.folded_wires(layout).any():
            estimate = _ask_posterior(tracker, layout, samples[-1], baseline_ohm)
        doubt_twins(tracker, estimate)
        heed_samples(tracker, SELECTION)
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
        stats=SolveStats(total, total, int(log.steps.sum()), perf_counter() - start),
    )


def _ask_posterior(
    tracker: PathTracker, layout: PatchLayout, last_ohm: Float, baseline_ohm: ArrayLike | None
) -> PatchEstimate | None:
    """Select roots using the posterior; return the posterior estimate, or None if it is not trusted."""
    options = PosteriorOptions(
        relative_noise=roots.REFEREE_NOISE, baseline_ohm=baseline_ohm, hold=False, contacts=False,
        follow_noise=False,
    )  # fmt: skip
    patch = FrameEstimator(layout, options)
    field = patch.estimate(last_ohm, np.ones(last_ohm.shape, bool), roots.REFEREE_NOISE)
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
