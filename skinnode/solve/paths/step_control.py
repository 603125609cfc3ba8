"""Which points of a path to solve, and how well."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skinnode.solve.paths.path_tracker import REST, TINY, Walk

RELAXED: Final = (1e-6, 1e-5, 1e-4, 1e-3)
"""Intermediate tolerances of figure 10, from harsh to loose."""
MISS: Final = 0.2
"""Wanted distance of the corrected from the predicted point, in first trust radii."""
SHRINK: Final = 0.5
GROW: Final = 4.0
"""Least and most change of a step length at once (Allgower & Georg 1990, section 6.1: factor 2 to 4)."""
SHORTEST: Final = 1 / 64
"""Shortest step as a share of the path: at a fold halving would go on for ever."""
CORRECTOR_TOLERANCE: Final = 1e-9
"""Below √eps, where a root is certain enough for its ∂X/∂R to be kept."""
CORRECTOR_STEPS: Final = 6
"""Newton's steps from a contraction of 1/2 to 1e-9 are 5."""


class Schedule(Protocol):
    """Any object that can lead a path tracker to the end of a path."""

    def follow(self, walk: Walk) -> None:
        """Lead ``walk`` from the rest to its last sample, and finish it."""
        ...


@dataclass(frozen=True)
class Uniform:
    """``steps`` of the samples, spread evenly, the last always among them. The other defaults are the
    paper's protocol (section 4).

    Args:
        steps: how many of the samples to solve; all by default, and where there are no more than that.
        plain: as the paper does, start each sample at the last solution (Lahaye), and leave a wire where the
            last sample left it. Otherwise each starts on the secant through the two solutions before, and a
            wire that comes to no root, or to a rough one, has a second try from the smoothest displacement
            that explains the last sample. On staggered, h = 1, with 10 samples of 21 presses of 50 % the
            secant alone loses none of 197 wires instead of 7, in 2.9 evaluations a sample instead of 4.
        intermediate_tolerance: of r, and of x in pitches, at all samples but the last.
        final_tolerance: at the last.
        intermediate_steps: most steps of the operator at all samples but the last.
        final_steps: most at the last.
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

    def follow(self, walk: Walk) -> None:
        """Each chosen sample from the solution of the one before."""
        count = walk.samples if self.steps is None else min(self.steps, walk.samples)
        for part in range(1, count):
            sample = round(part * walk.samples / count) - 1
            if not self.plain:
                walk.extrapolate(sample)
            walk.solve(sample, self.intermediate_tolerance, self.intermediate_steps)
        _finish(walk, self)


@dataclass(frozen=True)
class Periodic:
    """One sample a cycle T (section 5.2): between two solves the tracked point stays within the relaxed
    tolerance, so that the samples between tell nothing new.

    The cycle is looked for on the samples themselves. They are followed from the rest at 1e-6, 1e-5, …, where
    a sample whose first-order optimality is below the tolerance is passed over, until that happens with a
    period: T is the median number of samples from one solve to the next, on the wire that needs the most
    solves. Then the path starts again with every T-th sample at that tolerance, the last always among them.
    Where no tolerance shows a cycle of at least two samples that comes at least twice, every sample is solved
    at 1e-6.

    The paper's tolerance is of MATLAB's unscaled problem, where ‖Jᵀr‖∞ is F² times that of r = a F − 1 in
    pitches here. F depends on the unit of length, which the paper does not print.

    Args:
        cycle: T where it is known from an earlier press of that size and rate: nothing is looked for then.
        plain: as in :class:`Uniform`. The search is always plain: it is Lahaye's start that has the cycle.
        intermediate_tolerance: with ``cycle``; the paper's 1e-4.
        final_tolerance: at the last sample.
        intermediate_steps: most steps of the operator at all samples but the last.
        final_steps: most at the last.
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

    def follow(self, walk: Walk) -> None:
        """Find the cycle, go back to the rest, solve at the end of each cycle."""
        walk.cycle, tolerance = self.cycle, self.intermediate_tolerance
        if walk.cycle is None:
            walk.cycle, tolerance = self._search(walk)
            walk.searched = walk.rows
            walk.restart()
        apart = walk.cycle or 1
        for sample in range(apart - 1, walk.samples - 1, apart):
            if not self.plain:
                walk.extrapolate(sample)
            walk.solve(sample, tolerance, self.intermediate_steps)
        _finish(walk, self)

    def _search(self, walk: Walk) -> tuple[int | None, float]:
        """The cycle and the tolerance that shows it."""
        for tolerance in RELAXED:
            walk.restart()
            solved = [
                walk.solve(sample, tolerance, self.intermediate_steps) > 0
                for sample in range(walk.samples - 1)
            ]
            cycle = shortest_cycle(np.array(solved).reshape(-1, walk.wires))
            if cycle is None:
                break  # looser still leaves the whole path in one cycle
            if cycle > 1:
                return cycle, tolerance
        return None, RELAXED[0]


def shortest_cycle(solved: NDArray[np.bool_]) -> int | None:
    """Median number of samples between solves of the wire that is solved the most often, from (T, U) which
    samples were; None where no wire has two cycles."""
    cycles = [
        np.median(gaps) for gaps in (np.diff(np.flatnonzero(wire)) for wire in solved.T) if gaps.size > 1
    ]
    return int(min(cycles)) if cycles else None


@dataclass(frozen=True)
class Adaptive:
    """As few points as each wire needs, on the samples or between them, where R is interpolated.

    Every wire goes its own way: Euler's step along ∂X/∂R from the factors of the last Jacobian, then the
    operator. The next step is as long as keeps Newton's contraction: Euler's error grows with its square
    (Deuflhard 2004, section 5.1.3), and F is smooth on the scale of the clearance between the layers. A step
    that does not come to a root on the branch of the rest is taken back and halved.

    A straight line of R is no deformation of rubber, and can run into a fold that the press itself does not
    meet. A wire that gets stuck there, or arrives at a root too rough to be a press, is solved by
    Levenberg-Marquardt, whatever the operator, from the smoothest displacement that explains the last sample
    (:func:`skinnode.solve.branch.guided_start`), and keeps the smoother of the two roots.

    The first and the last sample are enough: the rest and the frame wanted.

    Args:
        points: most points of the path a wire may try.
        final_tolerance: of r, and of x in pitches, at the last sample.
        final_steps: most steps of the operator at the last sample.
    """

    points: int = 50
    final_tolerance: float = 1e-12
    final_steps: int = 1000

    def __post_init__(self) -> None:
        _require_count("points", self.points)
        _require(self, "final_tolerance", "final_steps")

    def follow(self, walk: Walk) -> None:
        """Predict, correct, choose the next length; then finish what arrived and guide the rest."""
        end = walk.samples - 1.0
        reach = walk.problem.step_limit
        position = np.full(walk.wires, REST)
        length = end - position
        for _ in range(self.points):
            todo = (position < end) & (length >= SHORTEST * (end - REST))
            if not todo.any():
                break
            target = np.minimum(position + length, end)
            far = np.abs(walk.predict(target) - walk.solver.x).max(axis=1)
            shortened = position + (target - position) * reach / np.maximum(far, reach)
            target = np.where(far > reach, shortened, target)
            predicted = walk.predict(target)
            arrived = walk.step(todo, target, CORRECTOR_TOLERANCE, CORRECTOR_STEPS)
            miss = np.abs(walk.solver.x - predicted).max(axis=1)
            growth = np.clip(np.sqrt(MISS * reach / np.maximum(miss, TINY)), SHRINK, GROW)
            length = (target - position) * np.where(arrived, growth, SHRINK)
            position = np.where(arrived, target, position)
        walk.finish(self.final_tolerance, self.final_steps, position == end)
        walk.guide(walk.doubtful(), self.final_tolerance, self.final_steps)


def _finish(walk: Walk, how: Uniform | Periodic) -> None:
    """The last sample, and a look at what does not seem to be the root."""
    if not how.plain:
        walk.extrapolate(walk.samples - 1)
    walk.finish(how.final_tolerance, how.final_steps)
    walk.second_tries = not how.plain
    if how.plain:
        walk.doubt_rough(how.final_tolerance, how.final_steps)
    else:
        walk.guide(walk.doubtful(), how.final_tolerance, how.final_steps)


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
