"""Path following as in the paper: solves a recorded press sample by sample, up to the last sample.

The path is the solution of H(X, t) = F(X) − ρ / R(t) = 0, where X(0) is the grid at rest. Each sample is
solved from the solution of the previous sample (Lahaye; Xu et al. 2018, section 3.2). Step control
(:mod:`skinnode.solve.paths.step_control`) chooses the samples, their tolerance and any points between
samples.
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
"""Accuracy of a solve that starts from the posterior.

The tolerance is that of the paper for the last sample; the maximum number of steps is that of the paper for
all earlier samples.
"""
STARTS: Final = 12
"""Number of random starting points in the search for other roots of F = b.

The starting points are drawn from the posterior with a fixed random seed.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PathResult:
    """Solution at the end of a path, and a log of the solver calls on the path.

    Row s of ``position``, ``steps``, ``evaluations`` and ``optimality`` belongs to solver call number s. If
    the call skipped a wire, the position and the optimality of this wire are NaN. Calls after the first solve
    of the last sample are second attempts and checks.
    """

    upper_m: Float
    """(U, N, 3) electrodes at the last sample, metres."""
    displacement_m: Float
    """(U, N, 3) displacement from the rest position, metres."""
    status: tuple[Status, ...]
    """Status of each upper wire."""
    error_estimate_m: Float
    """(U,) largest coordinate error due to tolerance and rounding, in metres; inf if unknown.

    Assumes exact samples.
    """
    residual: Float
    """(U,) RMS of the relative residual F/b − 1 at the last sample."""
    cycle: int | None
    """Number of samples from one solve to the next in periodic step control; None in all other cases."""
    searched: int
    """Number of initial rows of the log that belong to the search for the cycle."""
    position: Float
    """(S, U) sample numbers, counted from 0; 1.5 is halfway between samples 1 and 2, and −1 is the patch at
    rest."""
    steps: NDArray[np.int64]
    """(S, U) number of operator steps; 0 if the sample was skipped."""
    evaluations: NDArray[np.int64]
    """(S, U) evaluations of F and J."""
    optimality: Float
    """(S, U) first-order optimality ‖Jᵀr‖∞ of the dimensionless problem at the end of the call."""
    stats: SolveStats
    """Solver steps, evaluations and computing time of the path, including the search for a cycle."""


def solve_path(
    layout: PatchLayout,
    samples_ohm: ArrayLike,
    *,
    operator: str = "dogleg",
    schedule: Schedule | None = None,
    baseline_ohm: ArrayLike | None = None,
) -> PathResult:
    """Follow a press from the rest position to its last sample.

    F = b has several roots, separated by folds (det J = 0). A wire is ILL_CONDITIONED instead of CONVERGED if
    its root may be wrong, for one of four reasons:

    - the determinant of its Jacobian changed sign on the path;
    - an electrode crossed the lower layer;
    - an equally smooth root exists on the other side of a nearby fold;
    - the path ended smoothly at a different root, which is then reported instead.

    The skin itself can cross a fold. A root across a fold is therefore accepted if both the path and the
    posterior of the patch lead to this root.

    Args:
        layout: The patch, with at least as many lower wires as unknowns per wire (K ≥ 3N).
        samples_ohm: (T, U, K) resistances, ohm, in time order; the last sample is the frame to solve.
        operator: ``dogleg``, ``levenberg_marquardt`` or ``gauss_newton``.
        schedule: Step control: ``Uniform()`` by default, ``Periodic()`` or ``Adaptive()``.
        baseline_ohm: (U, K) resistances measured at rest, ohm; if given, resistivity and gain cancel.

    Returns:
        Positions at the last sample, a status for each wire, and the log of the solver calls.

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
            "must be at least as many"
        )
    if schedule is not None and (isinstance(schedule, type) or not hasattr(schedule, "follow")):
        raise ValueError(f"schedule: got {schedule!r}, must be Uniform(), Periodic(), Adaptive() or similar")
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
    """Select roots with the posterior; return its estimate of the patch, or None if it is not trusted."""
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
