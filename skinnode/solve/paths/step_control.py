"""Step control: which points of a path to solve, and to what tolerance.

A schedule leads a :class:`skinnode.solve.paths.path_tracker.PathTracker` from the rest to the last sample.
"""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skinnode.solve.paths.corrector import REST, Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.paths.predictor import SQUARE_FLOOR
from skinnode.solve.paths.root_selection import doubt_rough, doubtful, guide

RELAXED_TOLERANCES: Final = (1e-6, 1e-5, 1e-4, 1e-3)
"""Intermediate tolerances of figure 10, from tight to loose."""
MISS: Final = 0.2
"""Wanted distance between the corrected and the predicted point, in first trust radii."""
SHRINK: Final = 0.5
GROW: Final = 4.0
"""Largest growth of a step length at once (Allgower & Georg 1990, section 6.1: factor 2 to 4)."""
SHORTEST: Final = 1 / 64
"""Shortest step as a share of the path: at a fold, halving would never end."""
ADAPTIVE_POINT: Final = Accuracy(tolerance=1e-9, max_steps=6)
"""Accuracy of an intermediate point: below √eps a root is certain enough for its ∂X/∂R to be kept, and Newton
takes 5 steps from a contraction of 1/2 to 1e-9."""


class Schedule(Protocol):
    """Step control: any object that can lead a path tracker to the end of a path."""

    def follow(self, tracker: PathTracker) -> None:
        """Lead ``tracker`` from the rest to its last sample, and finish it."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Solve ``steps`` of the samples, spread evenly; the last sample is always among them.

    The other defaults are the paper's protocol (section 4).

    Args:
        steps: Number of samples to solve; default all, and all if there are fewer.
        plain: Whether to start each sample at the last solution, as the paper does (Lahaye), and to leave a
            wire where the last sample left it. Otherwise each sample starts on the secant through the two
            solutions before, and a wire without a root, or with a rough one, has a second try from the
            smoothest displacement that explains the last sample. On staggered, h = 1, with 10 samples of 21
            presses of 50 %, the secant alone loses none of 197 wires instead of 7, in 2.9 evaluations a
            sample instead of 4.
        intermediate_tolerance: Tolerance of r, and of x in pitches, at all samples but the last.
        final_tolerance: Tolerance at the last sample.
        intermediate_steps: Maximum steps of the operator at all samples but the last.
        final_steps: Maximum steps at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite or a number is not an integer of at least 1.
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
        """Solve each chosen sample from the solution of the one before."""
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
    """Solve one sample a cycle T (section 5.2).

    Between two solves the tracked point stays within the relaxed tolerance, so that the samples between add
    nothing.

    The cycle is found on the samples themselves. They are followed from the rest at 1e-6, 1e-5, …; a sample
    whose first-order optimality is below the tolerance is skipped. When the skips have a period, T is the
    median number of samples from one solve to the next, on the wire that needs the most solves. Then the
    path starts again with every T-th sample at that tolerance; the last sample is always among them. If no
    tolerance shows a cycle of at least two samples that comes at least twice, every sample is solved at 1e-6.

    The paper's tolerance is of MATLAB's unscaled problem, in which ‖Jᵀr‖∞ is F² times that of r = a F − 1 in
    pitches here. F depends on the unit of length, which the paper does not print.

    Args:
        cycle: T, if an earlier press of that size and rate showed it; the search is skipped then.
        plain: As in :class:`Uniform`. The search is always plain: Lahaye's start is what has the cycle.
        intermediate_tolerance: Tolerance with ``cycle``; the paper's 1e-4.
        final_tolerance: Tolerance at the last sample.
        intermediate_steps: Maximum steps of the operator at all samples but the last.
        final_steps: Maximum steps at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite or a number is not an integer of at least 1.
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
        """Find the cycle, go back to the rest, solve at the end of each cycle."""
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
        """The cycle and the tolerance that shows it."""
        for tolerance in RELAXED_TOLERANCES:
            tracker.restart()
            accuracy = Accuracy(tolerance, self.intermediate_steps)
            solved = [tracker.solve(sample, accuracy) > 0 for sample in range(tracker.samples - 1)]
            cycle = shortest_cycle(np.array(solved).reshape(-1, tracker.wires))
            if cycle is None:
                break  # a looser tolerance still leaves the whole path in one cycle
            if cycle > 1:
                return cycle, tolerance
        return None, RELAXED_TOLERANCES[0]


def shortest_cycle(solved: NDArray[np.bool_]) -> int | None:
    """Return the median number of samples between solves of the wire that is solved most often.

    Args:
        solved: (T, U) whether a sample was solved on a wire.

    Returns:
        The cycle, in samples; None if no wire has two cycles.
    """
    cycles = [
        np.median(gaps) for gaps in (np.diff(np.flatnonzero(wire)) for wire in solved.T) if gaps.size > 1
    ]
    return int(min(cycles)) if cycles else None


@dataclass(frozen=True)
class Adaptive:
    """Solve as few points as each wire needs, on the samples or between them, where R is interpolated.

    Every wire has its own step length: Euler's step along ∂X/∂R from the factors of the last Jacobian, then
    the operator. The next step is as long as keeps Newton's contraction: Euler's error grows with its square
    (Deuflhard 2004, section 5.1.3), and F is smooth on the scale of the clearance between the layers. A step
    that does not come to a root on the branch of the rest is taken back and halved.

    A straight line of R is no deformation of rubber, and can meet a fold that the press itself does not
    meet. A wire that gets stuck there, or arrives at a root too rough to be a press, is solved by
    Levenberg-Marquardt, whatever the operator, from the smoothest displacement that explains the last sample
    (:func:`skinnode.solve.starts.guided_start`), and keeps the smoother of the two roots.

    The first and the last sample are enough: the rest and the frame wanted.

    Args:
        points: Maximum points of the path that a wire may try.
        final_tolerance: Tolerance of r, and of x in pitches, at the last sample.
        final_steps: Maximum steps of the operator at the last sample.

    Raises:
        ValueError: If a tolerance is not positive and finite or a number is not an integer of at least 1.
    """

    points: int = 50
    final_tolerance: float = 1e-12
    final_steps: int = 1000

    def __post_init__(self) -> None:
        _require_count("points", self.points)
        _require(self, "final_tolerance", "final_steps")

    def follow(self, tracker: PathTracker) -> None:
        """Predict, correct, choose the next step length; then finish what arrived and guide the rest."""
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
        guide(tracker, doubtful(tracker), accuracy)


def _finish(tracker: PathTracker, how: Uniform | Periodic) -> None:
    """Solve the last sample, and check what does not seem to be the root."""
    accuracy = Accuracy(how.final_tolerance, how.final_steps)
    if not how.plain:
        tracker.extrapolate(tracker.samples - 1)
    tracker.finish(accuracy)
    tracker.second_tries = not how.plain
    if how.plain:
        doubt_rough(tracker, accuracy)
    else:
        guide(tracker, doubtful(tracker), accuracy)


def _require_count(name: str, value: int) -> None:
    if not isinstance(value, numbers.Integral) or value < 1:
        raise ValueError(f"{name}: got {value}, must be an integer of at least 1")


def _require(options: object, *names: str) -> None:
    """ValueError unless the tolerances are positive and the numbers of steps at least 1."""
    for name in names:
        value = getattr(options, name)
        if name.endswith("steps"):
            _require_count(name, value)
        elif not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: got {value}, must be positive and finite")
