"""Root selection at the last sample of a path: second attempts, and rules for accepting a root.

The thresholds are defined in :mod:`skinnode.solve.roots`. A fold is a surface where det J = 0, and the twin
of a root is the other root near the same fold. All functions change :attr:`PathTracker.end` and the solver's
positions in place. A wire with a rejected root gets the status ILL_CONDITIONED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve import roots
from skinnode.solve.operators import codes as op
from skinnode.solve.paths.corrector import Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.roots import Mask
from skinnode.solve.starts import guided_start, near_twin
from skinnode.solve.wires import arrays as wires

GUIDED_STEPS: Final = 100
"""Maximum number of steps of a solve that starts at the smoothest displacement (:func:`guide`). A solve that
starts near a root takes 1 to 20 steps; no other solve converges."""
TWIN: Final = Accuracy(tolerance=1e-9, max_steps=30)
"""Accuracy of roots that are only compared with other roots.

Distinct roots differ by much more than the tolerance.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PatchEstimate:
    """Estimate of the whole patch, used to check roots."""

    x: Float
    """(U, n) positions, pitches."""
    std: Float
    """(U, n) standard deviations, pitches."""

    def agrees(self, x: Float) -> Mask:
        """Return a mask (U,) of the wires whose position (U, n), in pitches, is confirmed by the estimate."""
        return roots.agrees(np.abs(x - self.x), roots.AGREE * self.std)


def doubtful(tracker: PathTracker) -> Mask:
    """Return a mask (U,) of wires that have no root, have an implausibly rough root, or had a step undone."""
    return np.asarray(~tracker.end.converged | _rough(tracker) | tracker.stumbled)


def guide(tracker: PathTracker, todo: Mask, accuracy: Accuracy) -> None:
    """Solve the last sample from the smoothest displacement that explains it; keep the smoother root.

    If the new root is across a fold, :func:`guide` also solves for its twin on the side of the rest position.
    If neither solve finds a root for a wire, the wire's status is not CONVERGED.

    Args:
        tracker: Tracker at the end of its path.
        todo: (U,) wires to solve again.
        accuracy: Accuracy at the last sample.
    """
    if not todo.any():
        return
    solver, end, smoothness = tracker.solver, tracker.end, tracker.smoothness
    x, kept, last_a = solver.x.copy(), end.copy(), tracker.last_a
    evaluations = np.zeros(tracker.wires, np.int64)
    for u in np.flatnonzero(todo).tolist():
        solver.x[u], evaluations[u] = guided_start(tracker.problem, u, last_a[u], smoothness.covariance[u])
    tracker.corrector.log_start(todo, evaluations)
    accuracy = Accuracy(accuracy.tolerance, min(accuracy.max_steps, GUIDED_STEPS))
    tracker.take(todo, accuracy, op.LEVENBERG_MARQUARDT)
    across = todo & (solver.report[:, wires.STATUS] == op.CONVERGED) & ~tracker.on_branch()
    beyond = smoothness.roughness(solver.x)
    for u in np.flatnonzero(across).tolist():
        solver.x[u] = near_twin(tracker.problem, solver.x[u], last_a[u], end.inverse[u])
    if across.any():
        tracker.take(across, accuracy, op.LEVENBERG_MARQUARDT)
        end.doubt(across & (beyond < roots.TWIN_ROUGHNESS * smoothness.roughness(solver.x)))
    smoother = smoothness.roughness(solver.x) < smoothness.roughness(x)
    found = end.converged
    back = todo & kept.converged & ~(found & smoother)
    solver.x[back] = x[back]
    end.restore(back, kept)
    end.doubt(back & ~found)


def doubt_rough(tracker: PathTracker, accuracy: Accuracy) -> None:
    """Reject each rough root if :func:`guide` finds a smoother root; the positions stay unchanged."""
    end = tracker.end
    todo = _rough(tracker) & end.converged
    x, kept = tracker.solver.x.copy(), end.copy()
    guide(tracker, todo, accuracy)
    size = roots.distance(x, tracker.problem.rest)
    apart = roots.distance(tracker.solver.x, x) > roots.SAME_ROOT * size
    refused = todo & (apart | ~end.converged)
    tracker.solver.x[:] = x
    tracker.end = kept
    kept.status[refused] = op.ILL_CONDITIONED


def compare_with_estimate(tracker: PathTracker, estimate: PatchEstimate, accuracy: Accuracy) -> None:
    """Compare every root with an estimate of the whole patch.

    If a wire has no root, or its root contradicts the estimate, it is solved again, starting from the
    estimate. A new root across a fold is accepted only if the path led to the same root; the skin itself can
    cross a fold.
    """
    solver, end = tracker.solver, tracker.end
    todo = ~(estimate.agrees(solver.x) & end.converged)
    if not todo.any():
        return
    root, converged = solver.x.copy(), end.converged
    if not tracker.second_tries:
        end.doubt(todo)
        return
    solver.x[todo] = estimate.x[todo]
    tracker.take(todo, accuracy, op.LEVENBERG_MARQUARDT, tracker.at_path_end)
    found = end.converged & estimate.agrees(solver.x)
    end.doubt(todo & ~found)
    back = todo & converged & ~found
    solver.x[back] = root[back]
    end.status[back] = op.ILL_CONDITIONED


def keep_likeliest(
    tracker: PathTracker,
    starts: Float,
    energy: Callable[[Float], float],
    unlikely: Float,
    accuracy: Accuracy,
) -> None:
    """Search for other roots, starting from twin roots and from ``starts``; keep the likeliest root.

    A wire remains CONVERGED only if the energy of each other root differs from the likeliest by at least
    ``unlikely``.

    Args:
        tracker: Tracker at the end of its path.
        starts: (S, U, n) starting positions, pitches.
        energy: Function that returns −2 log of the density of a displacement field (U, n) in pitches, up to a
            constant.
        unlikely: (U,) minimum energy difference at which the less likely root is excluded.
        accuracy: Accuracy of the root that is kept.
    """
    solver, end, rest = tracker.solver, tracker.end, tracker.problem.rest
    found = solver.x.copy()
    first = np.where(end.converged[:, None], _twins(tracker), found)
    root = found.copy()
    size, least = roots.distance(root, rest), energy(root - rest)
    close, better = np.zeros(tracker.wires, bool), np.zeros(tracker.wires, bool)
    for start in (first, *starts):
        todo = end.converged
        solver.x[:] = start
        tracker.try_root(todo, TWIN)
        other = roots.distance(solver.x, root) > roots.SAME_ROOT * size
        other &= todo & (solver.report[:, wires.STATUS] == op.CONVERGED)
        for u in np.flatnonzero(other & ~tracker.out_of_reach()).tolist():
            rival = root.copy()
            rival[u] = solver.x[u]
            gain = least - energy(rival - rest)
            close[u] = abs(gain) < unlikely[u] or (close[u] and gain < 0)
            if gain > 0:
                root[u], better[u] = rival[u], True
                least -= gain
    if not tracker.second_tries:
        end.doubt(close | better)
        solver.x[:] = found
        return
    solver.x[:] = root
    if better.any():
        tracker.take(better, accuracy, op.LEVENBERG_MARQUARDT)
    end.doubt(close)


def doubt_twins(tracker: PathTracker, estimate: PatchEstimate | None) -> None:
    """Reject roots that have an equally smooth twin across a fold.

    If an ``estimate`` of the patch is given, a twin that the estimate does not confirm is ignored.
    """
    layout = tracker.problem.layout
    if layout.shape[1] != layout.unknowns:
        return  # a system with more equations than unknowns has no twin roots
    solver, end, smoothness = tracker.solver, tracker.end, tracker.smoothness
    root, twins = solver.x.copy(), _twins(tracker)
    size = roots.distance(root, tracker.problem.rest)
    todo = roots.distance(twins, root) < roots.TWIN_REACH * size
    solver.x[todo] = twins[todo]
    if todo.any():
        tracker.try_root(todo, TWIN)
        other = todo & roots.crossed_fold(solver.report[:, wires.BRANCH], end.side)
        other &= ~tracker.out_of_reach()
        if estimate is not None:
            other &= estimate.agrees(solver.x)
        smooth = smoothness.roughness(solver.x) < roots.TWIN_ROUGHNESS * smoothness.roughness(root)
        end.status[other & smooth] = op.ILL_CONDITIONED
    solver.x[:] = root


def heed_samples(tracker: PathTracker, accuracy: Accuracy) -> None:
    """Reject roots that differ from the end of a smooth path; move their wires back to that end.

    If the skin itself crosses a fold, a root on the near side of the fold can be smoother and likelier than
    the true root. :func:`guide` and the posterior both find the wrong root in this case; only the path leads
    to the true root. If the posterior is wrong on one wire, the roots of all other wires that moved away from
    the end of their paths are rejected too.
    """
    if not tracker.second_tries:
        return  # without second tries, every wire is already at the end of its path
    todo = tracker.led_elsewhere()
    if todo.any():
        moved = ~tracker.at_path_end()
        tracker.end.doubt(moved)
        tracker.return_to_path_end(todo | (moved & tracker.reached), accuracy)


def _twins(tracker: PathTracker) -> Float:
    """Return estimates (U, n) of the roots across the nearest folds; NaN for wires that are not CONVERGED."""
    x, end, last_a = tracker.solver.x, tracker.end, tracker.last_a
    twins = np.full_like(x, math.nan)
    for u in np.flatnonzero(end.converged).tolist():
        twins[u] = near_twin(tracker.problem, x[u], last_a[u], end.inverse[u])
    return twins


def _rough(tracker: PathTracker) -> Mask:
    x, problem = tracker.solver.x, tracker.problem
    return roots.rough_at_path_end(tracker.smoothness.roughness(x), x - problem.rest, problem.step_limit)
