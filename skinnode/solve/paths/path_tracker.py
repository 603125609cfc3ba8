"""Path tracker: follows each wire along a press with a predictor and a corrector.

The schedule (:mod:`skinnode.solve.paths.step_control`) uses one of two modes. With Lahaye's method, all wires
are solved at the same sample (:meth:`PathTracker.solve`). With adaptive step control, each wire has its own
path position (:meth:`PathTracker.step`). :mod:`skinnode.solve.paths.root_selection` checks the roots at the
last sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve import roots
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators import codes as op
from skinnode.solve.paths.corrector import Accuracy, Corrector
from skinnode.solve.paths.predictor import euler, secant
from skinnode.solve.roots import Mask
from skinnode.solve.smoothness import Smoothness
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.problem import PatchProblem


@dataclass(slots=True, eq=False)
class PathEnd:
    """Outcome of solving the last sample."""

    status: Index
    """(U,) status codes."""
    residual: Float
    """(U,) RMS of F/b − 1."""
    error_estimate: Float
    """(U,) estimate of the largest coordinate error due to the tolerance and to rounding, in pitches."""
    inverse: Float
    """(U, n, K) ∂x/∂r."""
    side: Index
    """(U,) sign of det J."""

    @property
    def converged(self) -> Mask:
        """(U,) mask of the CONVERGED wires."""
        return np.asarray(self.status == op.CONVERGED)

    def copy(self) -> PathEnd:
        """Return a deep copy."""
        return PathEnd(
            self.status.copy(), self.residual.copy(), self.error_estimate.copy(), self.inverse.copy(),
            self.side.copy(),
        )  # fmt: skip

    def restore(self, wires_: Mask, earlier: PathEnd) -> None:
        """Copy the outcome of the wires in the mask (U,) from ``earlier``."""
        for name in ("status", "residual", "error_estimate", "inverse", "side"):
            getattr(self, name)[wires_] = getattr(earlier, name)[wires_]

    def doubt(self, wires_: Mask) -> None:
        """Change the status of the wires in the mask (U,) from CONVERGED to ILL_CONDITIONED."""
        self.status[wires_ & (self.status == op.CONVERGED)] = op.ILL_CONDITIONED


class PathTracker:
    """Tracks the wires through the samples of one press; each press needs its own instance.

    Args:
        problem: The patch.
        a: (T, U, K) R · gain of the samples.
        operator: Operator code.

    Attributes:
        end: Outcome at the last sample, after :meth:`finish`.
        cycle: Cycle of periodic step control: number of samples from one solve to the next; None if there is
            none.
        searched: Number of rows at the start of the log that belong to the search for the cycle.
        second_tries: Whether the last sample may be solved again after the end of the path. If False, only
            the status of a wire may change.
        stumbled: (U,) mask of the wires with a step that failed and was undone.
        reached: (U,) mask of the wires whose path ended at a root.
    """

    def __init__(self, problem: PatchProblem, a: Float, operator: int) -> None:
        self.problem = problem
        self.wires = len(problem.rest)
        self.samples = len(a)
        self.corrector = Corrector(problem, a, operator)
        self.solver = self.corrector.solver
        self.end = PathEnd(
            status=np.full(self.wires, op.MAX_STEPS, np.int64),
            residual=np.full(self.wires, math.inf),
            error_estimate=np.full(self.wires, math.inf),
            inverse=np.zeros_like(self.solver.inverse),
            side=np.zeros(self.wires, np.int64),
        )
        self.cycle: int | None = None
        self.searched = 0
        self.second_tries = True
        self._path_end = problem.rest.copy()
        self.reached = np.zeros(self.wires, bool)
        self._everywhere = np.full(self.wires, wires.SOLVE, np.uint8)
        self._smoothness: Smoothness | None = None
        self._rest_branch = self.solver.solve_rest()
        self._rest = self.solver.inverse.copy(), self.solver.a_solved.copy()
        self.restart()

    @property
    def smoothness(self) -> Smoothness:
        """Smoothness model of the patch, created on first use; most paths do not need it."""
        if self._smoothness is None:
            self._smoothness = Smoothness(self.problem)
        return self._smoothness

    @property
    def last_a(self) -> Float:
        """(U, K) R · gain of the last sample."""
        return self.corrector.sample_a(self.samples - 1)

    def restart(self) -> None:
        """Move all wires back to the rest position."""
        self.solver.x[:] = self.problem.rest
        self.solver.inverse[:], self.solver.a_solved[:] = self._rest
        self._branch = self._rest_branch.copy()
        self._crossed = np.zeros(self.wires, bool)
        self.stumbled = np.zeros(self.wires, bool)
        self._points = self._at_rest()

    def _at_rest(self) -> list[tuple[Float, Float]]:
        """Return the first two points of a path: the rest position twice, so the first secant is zero."""
        return [(self.problem.rest.copy(), self.problem.a_rest)] * 2

    # -- sample by sample, as in the paper -------------------------------------------------------------

    def extrapolate(self, sample: int) -> None:
        """Move every wire along its secant to the position predicted for ``sample``.

        No coordinate moves farther than the trust radius.
        """
        (x_before, a_before), (x, a) = self._points[-2:]
        a_next = self.corrector.sample_a(sample)
        secant(x_before, a_before, x, a, a_next, self.problem.step_limit, self.solver.x)

    def solve(self, sample: int, accuracy: Accuracy) -> Index:
        """Solve a sample for all wires, starting from their current positions.

        Returns:
            (U,) numbers of steps; 0 if the first-order optimality was below the tolerance at the start.
        """
        self.corrector.correct(self._everywhere, float(sample), accuracy, tasks=wires.SKIP)
        self._points.append((self.solver.x.copy(), self.corrector.sample_a(sample)))
        known = self.solver.report[:, wires.BRANCH]
        self._crossed |= roots.crossed_fold(known, self._branch)
        self._branch = np.where(known != 0, known, self._branch)
        return np.asarray(self.solver.report[:, wires.STEPS].copy())

    def finish(self, accuracy: Accuracy, todo: Mask | None = None) -> None:
        """Solve the last sample to the final accuracy, for all wires or for the wires in ``todo`` (U,)."""
        todo = np.ones(self.wires, bool) if todo is None else todo
        self.take(todo, accuracy)
        self._arrive(todo)
        self._crossed |= todo & roots.crossed_fold(self.solver.report[:, wires.BRANCH], self._branch)
        self.end.doubt(self._crossed)

    def walk(self, todo: Mask, samples: list[int], accuracy: Accuracy) -> None:
        """Follow the wires in ``todo`` (U,) from rest along ``samples`` and store the ends of their paths.

        ``samples`` contains sample numbers in time order and includes the last sample of the press. The
        positions of the wires and :attr:`end` do not change.
        """
        x = self.solver.x.copy()
        call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
        self._points = self._at_rest()
        for sample in samples[:-1]:
            self.extrapolate(sample)
            self.corrector.correct(call, float(sample), accuracy, tasks=wires.SKIP)
            self._points.append((self.solver.x.copy(), self.corrector.sample_a(sample)))
        self.extrapolate(samples[-1])
        self.corrector.correct(call, float(samples[-1]), accuracy)
        self._arrive(todo)
        self.solver.x[:] = x

    def _arrive(self, todo: Mask) -> None:
        """Store the current positions of the wires in ``todo`` (U,) as the ends of their paths."""
        self._path_end[todo] = self.solver.x[todo]
        residual = self.solver.measure[:, wires.RESIDUAL]
        self.reached[todo] = (residual <= roots.ROOT_RESIDUAL)[todo]

    # -- wire by wire ----------------------------------------------------------------------------------

    def predict(self, position: Float) -> Float:
        """Predict x (U, n), in pitches, at ``position`` (U,) from the last converged solve of each wire."""
        solver = self.solver
        return euler(solver.x, solver.inverse, solver.a_solved, self.corrector.a_at(position))

    def step(self, todo: Mask, position: Float, accuracy: Accuracy) -> Mask:
        """Move the wires in ``todo`` (U,) to their path positions (U,): predict, then correct.

        Returns:
            (U,) mask of the wires that reached a root on the branch of the rest position. The positions of
            all other wires do not change.
        """
        solver = self.solver
        before = solver.x.copy(), solver.inverse.copy(), solver.a_solved.copy()
        call = np.where(todo, wires.PREDICT, wires.LEAVE).astype(np.uint8)
        self.corrector.correct(call, position, accuracy, tasks=wires.COVARIANCE)
        arrived = todo & self.on_branch()
        lost = todo & ~arrived
        self.stumbled |= lost
        for now, then in zip((solver.x, solver.inverse, solver.a_solved), before, strict=True):
            now[lost] = then[lost]
        return arrived

    # -- the last sample -------------------------------------------------------------------------------

    def take(
        self,
        todo: Mask,
        accuracy: Accuracy,
        operator: int | None = None,
        also: Callable[[], Mask] | None = None,
    ) -> None:
        """Solve the last sample for the wires in ``todo`` (U,) and store the outcome in :attr:`end`.

        Args:
            todo: (U,) mask of the wires to solve.
            accuracy: Stopping criteria.
            operator: Operator code; default: the operator of this tracker.
            also: Function that returns a mask (U,) of the wires whose roots are accepted even across a fold;
                for all other wires, such a root is ILL_CONDITIONED.
        """
        call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
        self.corrector.correct(call, self.corrector.last, accuracy, tasks=wires.COVARIANCE, operator=operator)
        solver, end = self.solver, self.end
        end.status[todo] = solver.report[todo, wires.STATUS]
        good = self.on_branch() if also is None else self.on_branch() | also()
        end.doubt(todo & ~good)
        end.side[todo] = solver.report[todo, wires.BRANCH]
        end.residual[todo] = solver.measure[todo, wires.RESIDUAL]
        end.error_estimate[todo] = solver.measure[todo, wires.ERROR_ESTIMATE]
        end.inverse[todo] = solver.inverse[todo]

    def try_root(self, todo: Mask, accuracy: Accuracy) -> None:
        """Solve the last sample for the wires in ``todo`` (U,) without changing :attr:`end`."""
        call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
        self.corrector.correct(call, self.corrector.last, accuracy, operator=op.LEVENBERG_MARQUARDT)

    def on_branch(self) -> Mask:
        """Return a mask (U,) of the wires whose last solve found a root on the rest position's branch."""
        report = self.solver.report
        return roots.on_rest_branch(
            report[:, wires.STATUS], report[:, wires.BRANCH], self._rest_branch, self.out_of_reach()
        )

    def at_path_end(self) -> Mask:
        """Return a mask (U,) of the wires at the end of their path and with a plausible displacement."""
        apart = roots.distance(self.solver.x, self._path_end)
        size = roots.distance(self._path_end, self.problem.rest)
        return np.asarray((apart <= roots.SAME_ROOT * size) & ~self.out_of_reach())

    def led_elsewhere(self) -> Mask:
        """Return a mask (U,) of the wires that have left the root to which a smooth path led.

        A path is smooth if each solution is close to the position predicted by the secant through the two
        previous ones, and the first solution is close to the rest position
        (:data:`skinnode.solve.roots.SMOOTH_PATH`). For a long path, only the second half is tested.
        """
        size = roots.distance(self._path_end, self.problem.rest)
        elsewhere = roots.distance(self.solver.x, self._path_end) > roots.SAME_ROOT * size
        elsewhere &= self.reached
        if not elsewhere.any():
            return elsewhere
        points = [*self._points, (self._path_end, self.last_a)]
        samples = len(points) - 2
        if samples >= roots.LONG_PATH:
            points = points[samples // 2 :]
        predicted = np.empty_like(self._path_end)
        for before, last, (x, a) in zip(points[:-2], points[1:-1], points[2:], strict=True):
            secant(*before, *last, a, self.problem.step_limit, predicted)
            elsewhere &= roots.distance(x, predicted) <= roots.SMOOTH_PATH * size
        return elsewhere

    def return_to_path_end(self, todo: Mask, accuracy: Accuracy) -> None:
        """Move the wires in ``todo`` (U,) back to the end of their path; none of them stays CONVERGED."""
        self.solver.x[todo] = self._path_end[todo]
        self.take(todo, accuracy)
        self.end.doubt(todo)

    def out_of_reach(self) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires with an electrode farther from rest than its clearance."""
        return self.problem.out_of_reach(self.solver.x)
