"""Step control: schedules that choose which points on a path to solve, and to what tolerance.

A schedule moves a :class:`skinnode.solve.paths.path_tracker.PathTracker` from the rest position to the last
sample.
"""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skinnode.solve import roots
from skinnode.solve.paths.corrector import REST, Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.paths.predictor import SQUARE_FLOOR
from skinnode.solve.paths.root_selection import doubt_rough, doubtful, guide
from skinnode.solve.roots import Mask

RELAXED_TOLERANCES: Final = (1e-6, 1e-5, 1e-4, 1e-3)
"""Tolerances of intermediate samples in figure 10 of the paper, in increasing order."""
MISS: Final = 0.2
"""Target distance between the predicted and the corrected point, relative to the initial trust radius."""
SHRINK: Final = 0.5
GROW: Final = 4.0
"""Maximum ratio of successive step lengths. Allgower & Georg (1990, section 6.1) use 2 to 4."""
SHORTEST: Final = 1 / 64
"""Minimum step length, as a fraction of the path. At a fold, steps are halved down to this length."""
ADAPTIVE_POINT: Final = Accuracy(tolerance=1e-9, max_steps=6)
"""Accuracy of an intermediate point.

A tolerance below √eps makes ∂X/∂R accurate enough for the next prediction. Newton's method reaches 1e-9 in 5
steps if its first contraction ratio is 1/2.
"""

ADAPTIVE_WALK: Final = Accuracy(tolerance=1e-9, max_steps=100)
"""Accuracy of the samples when a path is followed again to check its end.

The step limit is taken from the paper.
"""


class Schedule(Protocol):
    """Interface of a schedule: an object that moves a path tracker to the end of its path."""

    def follow(self, tracker: PathTracker) -> None:
        """Move ``tracker`` from rest to its last sample, and call ``tracker.finish``."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Schedule that solves ``steps`` evenly spaced samples, including the last.

    The default tolerances and step limits are taken from the paper (section 4).

    Args:
        steps: Number of samples to solve; default: all. If there are fewer samples, all of them are solved.
        plain: If True, each sample starts at the last solution, as in the paper (Lahaye), and the positions
            found at the last sample are final. If False (default), each sample starts on the secant through
            the last two solutions, and wires without a plausible root at the last sample are solved again
            from the smoothest displacement. In tests with presses of 50 % of h, the secant reduced the number
            of unsolved wires from 7 of 197 to 0, and the number of evaluations per sample from 4 to 2.9.
        intermediate_tolerance: Tolerance on both r and x (in pitches) at all samples except the last.
        final_tolerance: Tolerance at the last sample.
        intermediate_steps: Maximum number of operator steps at each sample except the last.
        final_steps: Maximum number of operator steps at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite, or a count is not a positive integer.
    """

    steps: int | None = None
    plain: bool = False
    intermediate_tolerance: float = 1e-6
    final_tolerance: float = 1e-12
    intermediate_steps: int = 100
    final_steps: int = 1000

    def __post_init__(self) -> None:
        if self.steps is not None:
            _require_count("steps", self.steps)
        _require(self, "intermediate_tolerance", "final_tolerance", "intermediate_steps", "final_steps")

    def follow(self, tracker: PathTracker) -> None:
        """Solve the chosen samples in time order, then check the roots at the last sample."""
        count = tracker.samples if self.steps is None else min(self.steps, tracker.samples)
        accuracy = Accuracy(self.intermediate_tolerance, self.intermediate_steps)
        for part in range(1, count):
            sample = round(part * tracker.samples / count) - 1
            if not self.plain:
                tracker.extrapolate(sample)
            tracker.solve(sample, accuracy)
        _finish(tracker, self)


@dataclass(frozen=True)
class Periodic:
    """Schedule that solves one sample per cycle of T samples (section 5.2 of the paper).

    The other samples are skipped, because the last solution satisfies their equations within the tolerance.
    The last sample is always solved.

    If no cycle is given, the schedule searches for it. The search follows the path from the rest position
    with a tolerance of 1e-6, then 1e-5, 1e-4 and 1e-3, and skips samples whose first-order optimality is
    below the tolerance. T is the median number of samples between successive solves of a wire, for the wire
    with the smallest median. The search ends at the first tolerance for which T is at least 2; the path then
    restarts from rest and is solved with this cycle and tolerance. If no tolerance yields a cycle, every
    sample is solved with a tolerance of 1e-6.

    The tolerances are not directly comparable with the paper's tolerances. The paper does not scale its
    equations, and its ‖Jᵀr‖∞ is larger by a factor of F² than the value used here, with r = a F − 1 and
    lengths in pitches. The value of F depends on the unit of length, which the paper does not state.

    Args:
        cycle: Cycle T in samples, if known from an earlier press of the same size and rate; None to search
            for the cycle.
        plain: As in :class:`Uniform`. The search for the cycle always uses ``plain=True``.
        intermediate_tolerance: Tolerance if ``cycle`` is given; the default is the paper's 1e-4.
        final_tolerance: Tolerance at the last sample.
        intermediate_steps: Maximum number of operator steps at each sample except the last.
        final_steps: Maximum number of operator steps at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite, or a count is not a positive integer.
    """

    cycle: int | None = None
    plain: bool = False
    intermediate_tolerance: float = 1e-4
    final_tolerance: float = 1e-12
    intermediate_steps: int = 100
    final_steps: int = 1000

    def __post_init__(self) -> None:
        if self.cycle is not None:
            _require_count("cycle", self.cycle)
        _require(self, "intermediate_tolerance", "final_tolerance", "intermediate_steps", "final_steps")

    def follow(self, tracker: PathTracker) -> None:
        """Find the cycle unless it is given, then solve the last sample of each cycle, starting from rest."""
        tracker.cycle, tolerance = self.cycle, self.intermediate_tolerance
        if tracker.cycle is None:
            tracker.cycle, tolerance = self._search(tracker)
            tracker.searched = tracker.corrector.rows
            tracker.restart()
        apart = tracker.cycle or 1
        accuracy = Accuracy(tolerance, self.intermediate_steps)
        for sample in range(apart - 1, tracker.samples - 1, apart):
            if not self.plain:
                tracker.extrapolate(sample)
            tracker.solve(sample, accuracy)
        _finish(tracker, self)

    def _search(self, tracker: PathTracker) -> tuple[int | None, float]:
        """Return the cycle and the tolerance for which it was found; None and 1e-6 if there is no cycle."""
        for tolerance in RELAXED_TOLERANCES:
            tracker.restart()
            accuracy = Accuracy(tolerance, self.intermediate_steps)
            solved = [tracker.solve(sample, accuracy) > 0 for sample in range(tracker.samples - 1)]
            cycle = shortest_cycle(np.array(solved).reshape(-1, tracker.wires))
            if cycle is None:
                break  # a larger tolerance would skip even more samples
            if cycle > 1:
                return cycle, tolerance
        return None, RELAXED_TOLERANCES[0]


def shortest_cycle(solved: NDArray[np.bool_]) -> int | None:
    """Return the shortest cycle of any wire: its median number of samples between successive solves.

    Args:
        solved: (T, U) bool: True where the wire was solved at the sample.

    Returns:
        Cycle in samples; None if no wire was solved at least three times.
    """
    cycles = [
        np.median(gaps) for gaps in (np.diff(np.flatnonzero(wire)) for wire in solved.T) if gaps.size > 1
    ]
    return int(min(cycles)) if cycles else None


@dataclass(frozen=True)
class Adaptive:
    """Schedule that adapts each wire's step length to solve few points; interpolates R between samples.

    Each step consists of an Euler step along ∂X/∂R, computed with the factors of the last Jacobian, followed
    by operator steps that correct the position. The step length keeps the distance between the predicted and
    the corrected point constant, so that Newton's method contracts equally well in every step. The error of
    an Euler step is proportional to the square of its length (Deuflhard 2004, section 5.1.3). A step that
    does not reach a root on the branch of the rest position is undone, and the next step is half as long.

    Interpolated resistances do not correspond to any deformation of the skin, so the path can reach a fold
    (det J = 0) even if the press does not. If a wire cannot pass a fold, or its root is too rough for a
    press, it is solved again with Levenberg-Marquardt, starting from the smoothest displacement that explains
    the last sample (:func:`skinnode.solve.starts.guided_start`). The smoother of the two roots is kept.

    One sample is enough, because the path starts at rest and ends at the last sample. If there are more
    samples, the wires with doubtful roots are also followed sample by sample, as are the wires that moved far
    enough to have crossed a fold. Across a fold, the smoother root can be wrong, and only the samples reveal
    this.

    Args:
        points: Maximum number of path points to attempt per wire.
        final_tolerance: Tolerance on both r and x (in pitches) at the last sample.
        final_steps: Maximum number of operator steps at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite, or a count is not a positive integer.
    """

    points: int = 50
    final_tolerance: float = 1e-12
    final_steps: int = 1000

    def __post_init__(self) -> None:
        _require_count("points", self.points)
        _require(self, "final_tolerance", "final_steps")

    def follow(self, tracker: PathTracker) -> None:
        """Advance all wires to the last sample and solve it; then retry doubtful wires."""
        end = tracker.samples - 1.0
        reach = tracker.problem.step_limit
        position = np.full(tracker.wires, REST)
        length = end - position
        for _ in range(self.points):
            todo = (position < end) & (length >= SHORTEST * (end - REST))
            if not todo.any():
                break
            target = np.minimum(position + length, end)
            far = np.abs(tracker.predict(target) - tracker.solver.x).max(axis=1)
            shortened = position + (target - position) * reach / np.maximum(far, reach)
            target = np.where(far > reach, shortened, target)
            predicted = tracker.predict(target)
            arrived = tracker.step(todo, target, ADAPTIVE_POINT)
            miss = np.abs(tracker.solver.x - predicted).max(axis=1)
            growth = np.clip(np.sqrt(MISS * reach / np.maximum(miss, SQUARE_FLOOR)), SHRINK, GROW)
            length = (target - position) * np.where(arrived, growth, SHRINK)
            position = np.where(arrived, target, position)
        accuracy = Accuracy(self.final_tolerance, self.final_steps)
        tracker.finish(accuracy, position == end)
        unsure = doubtful(tracker)
        guide(tracker, unsure, accuracy)
        unsure |= _far_and_folded(tracker)
        if tracker.samples > 1 and unsure.any():
            count = min(self.points, tracker.samples)
            samples = [round(part * tracker.samples / count) - 1 for part in range(1, count + 1)]
            tracker.walk(unsure, samples, ADAPTIVE_WALK)


def _finish(tracker: PathTracker, how: Uniform | Periodic) -> None:
    """Solve the last sample; reject doubtful roots if ``how.plain``, otherwise solve their wires again."""
    accuracy = Accuracy(how.final_tolerance, how.final_steps)
    if not how.plain:
        tracker.extrapolate(tracker.samples - 1)
    tracker.finish(accuracy)
    tracker.second_tries = not how.plain
    if how.plain:
        doubt_rough(tracker, accuracy)
    else:
        guide(tracker, doubtful(tracker), accuracy)


def _far_and_folded(tracker: PathTracker) -> Mask:
    """Return a mask (U,) of the wires that moved far enough to have crossed a fold."""
    problem = tracker.problem
    moved = roots.distance(tracker.solver.x, problem.rest)
    far = np.asarray(moved > roots.JUMP * problem.clearance.min())
    return np.asarray(far & roots.folded_wires(problem.layout)) if far.any() else far


def _require_count(name: str, value: int) -> None:
    if not isinstance(value, numbers.Integral) or value < 1:
        raise ValueError(f"{name}: got {value}, must be an integer of at least 1")


def _require(options: object, *names: str) -> None:
    """Raise ValueError if a tolerance is not positive and finite, or a number of steps is less than 1."""
    for name in names:
        value = getattr(options, name)
        if name.endswith("steps"):
            _require_count(name, value)
        elif not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: got {value}, must be positive and finite")
