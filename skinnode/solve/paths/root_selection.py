"""Root selection at the last sample of a path: second attempts and acceptance tests.

A fold is a surface where det J = 0. The twin of a root is the root on the other side of a nearby fold.
:mod:`skinnode.solve.roots` defines the thresholds. The functions modify :attr:`PathTracker.end` and the
positions in the solver. A wire whose root is rejected becomes ILL_CONDITIONED.
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
"""Maximum number of steps in a solve that starts from the smoothest displacement (:func:`guide`).

Solves that start near a root take 1 to 20 steps. Others do not converge.
"""
TWIN: Final = Accuracy(tolerance=1e-9, max_steps=30)
"""Accuracy of roots that are only compared with other roots; distinct roots differ by far more than this."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchEstimate:
    """Estimate of the whole patch, used to check roots."""

    x: Float
    """(U, n) positions, in pitches."""
    std: Float
    """(U, n) standard deviations, in pitches."""

    def agrees(self, x: Float) -> Mask:
        """Return a mask (U,) of the wires whose positions (U, n), in pitches, agree with the estimate."""
        return roots.agrees(np.abs(x - self.x), roots.AGREE * self.std)


def doubtful(tracker: PathTracker) -> Mask:
    """Return a mask (U,) of the wires that have no root, a root too rough for a press, or an undone step."""
    return np.asarray(~tracker.end.converged | _rough(tracker) | tracker.stumbled)


def guide(tracker: PathTracker, todo: Mask, accuracy: Accuracy) -> None:
    """Solve the last sample again, starting from the smoothest displacement that explains it.

    If the new root is across a fold, its twin on the same side as the rest position is used instead. For each
    wire, the smoother of the old and new solutions is kept. If no new root is found, the wire is not
    CONVERGED, even if it was previously.

    Args:
        tracker: Tracker at the end of its path.
        todo: (U,) mask of the wires to solve again.
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
    """Reject each rough root unless :func:`guide` ends at the same root. The positions do not change."""
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

    A wire that has no root, or whose root contradicts the estimate, is solved again, starting from the
    estimate. A new root across a fold is accepted only if the path led to the same root, because the skin
    itself can cross a fold.
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
    """Search for other roots of each wire, and keep the likeliest.

    The search starts at the twins of the current roots and at ``starts``. A wire stays CONVERGED only if the
    energy of every other root is higher by at least ``unlikely``.

    Args:
        tracker: Tracker at the end of its path.
        starts: (S, U, n) starting positions, in pitches.
        energy: Function that returns the energy of a displacement field (U, n) in pitches: −2 log of its
            probability density, up to a constant.
        unlikely: (U,) minimum energy difference between the likeliest root and any other root.
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

    If an ``estimate`` of the patch is given, only twins that it confirms count.
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
    """Reject roots that differ from the end of a smooth path, and move these wires back to the path's end.

    If the skin itself has crossed a fold, a wrong root on the near side can be smoother and likelier than the
    correct root. In that case, :func:`guide` and the posterior find the wrong root, and only the path leads
    to the correct root. If any root is rejected for this reason, so is every other root that is not at the
    end of its path.
    """
    if not tracker.second_tries:
        return  # the wires have not left the ends of their paths
    todo = tracker.led_elsewhere()
    if todo.any():
        moved = ~tracker.at_path_end()
        tracker.end.doubt(moved)
        tracker.return_to_path_end(todo | (moved & tracker.reached), accuracy)


def _twins(tracker: PathTracker) -> Float:
    """Return the estimated twins (U, n) of all roots; NaN for wires that are not CONVERGED."""
    x, end, last_a = tracker.solver.x, tracker.end, tracker.last_a
    twins = np.full_like(x, math.nan)
    for u in np.flatnonzero(end.converged).tolist():
        twins[u] = near_twin(tracker.problem, x[u], last_a[u], end.inverse[u])
    return twins


def _rough(tracker: PathTracker) -> Mask:
    x, problem = tracker.solver.x, tracker.problem
    return roots.rough_at_path_end(tracker.smoothness.roughness(x), x - problem.rest, problem.step_limit)
