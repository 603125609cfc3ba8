"""A press being followed through its samples: where every wire is, and what it cost to get there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.branch import AGREE, Smoothness, guided_start, near_twin
from skinnode.solve.linalg.factorisations import Index
from skinnode.solve.operators import steps as op
from skinnode.solve.wires import driver as wires
from skinnode.solve.wires.patch_solver import PatchSolver
from skinnode.solve.wires.problem import PatchProblem

Mask = NDArray[np.bool_]

TINY: Final = 1e-300
REST: Final = -1.0
"""Position of the rest on a path; the samples are at 0, 1, 2, …"""
TWIN_REACH: Final = 2.0
"""Largest distance of a twin worth solving for, in largest displacements of its wire: farther ones were at
least 1.3 times as rough on staggered, h = 0.3 … 1."""
TWIN_ROUGHNESS: Final = 1.05
"""Of two roots at a fold the smoother is taken for true where the other is rougher by this factor. Over 82
random presses of 50 % on staggered, h = 1, the twins of wrong roots were at most 1.044 times as rough; 4 in
100 right roots have a twin as smooth, and lose their CONVERGED. Of 60 presses more of each depth and height
(6710 wires, h = 0.3 to 1) no wrong root ended CONVERGED, of 40 others (4510) one did."""
ROUGH: Final = 0.8
"""√(uᵀ C⁻¹ u) of a press is 0.67 of its size, less than 0.9 for nine in ten and to 1.9 where it moves one
electrode; of wrong roots 0.7 to 2. Above, the smoothest displacement is looked for."""
GUIDED_STEPS: Final = 100
"""A guided start is next to its root or next to none: 1 to 20 steps."""
SAME: Final = 1e-3
"""Two solutions closer than that share of the displacement are one root."""
TWIN_TOLERANCE: Final = 1e-9
TWIN_STEPS: Final = 30


class Walk:
    """The path of one patch through the ``a`` = R · gain (T, U, K) of its samples. One owner.

    Positions count samples, with the rest at −1; between two samples ``a`` is interpolated on a straight
    line. (1/a and log a do neither better nor worse: 0.3 to 1 pitch high, to 70 %, the counts of lost wires
    differ by their scatter.)
    """

    def __init__(self, problem: PatchProblem, a: Float, operator: int) -> None:
        self.problem = problem
        self.solver = PatchSolver(problem, operator)
        self.wires = len(problem.rest)
        self.samples = len(a)
        self.cycle: int | None = None
        """Samples between two solves, where a schedule found or was given a cycle."""
        self.searched = 0
        """Leading rows of the log that looked for the cycle."""
        self.status = np.full(self.wires, op.MAX_STEPS, np.int64)
        """(U,) of the last sample, after :meth:`finish`; with the next three."""
        self.residual = np.full(self.wires, math.inf)
        self.error_estimate = np.full(self.wires, math.inf)
        """(U,) pitches."""
        self._inverse = np.zeros_like(self.solver.inverse)
        self._side = np.zeros(self.wires, np.int64)  # sign of det J where the last sample was solved
        self._path_end = problem.rest
        self._knots = np.concatenate([problem.a_rest[None], a])
        self._weight = np.ones_like(problem.a_rest)
        self._everywhere = np.full(self.wires, wires.SOLVE, np.uint8)
        self._smoothness: Smoothness | None = None
        self._estimate: tuple[Float, Float] | None = None
        self.second_tries = True
        """Whether a wire may be moved from where its path led it; if not, it is only doubted."""
        self._log: list[tuple[Float, Index, Index, Float]] = []
        self._rest_branch = self.solver.solve_rest()
        self._rest = self.solver.inverse.copy(), self.solver.a_solved.copy()
        self.restart()

    @property
    def smoothness(self) -> Smoothness:
        """Made on first use: most paths need none."""
        if self._smoothness is None:
            self._smoothness = Smoothness(self.problem)
        return self._smoothness

    def restart(self) -> None:
        """Back to the rest position."""
        self.solver.x[:] = self.problem.rest
        self.solver.inverse[:], self.solver.a_solved[:] = self._rest
        self._branch = self._rest_branch.copy()
        self._crossed = np.zeros(self.wires, bool)
        self._stumbled = np.zeros(self.wires, bool)
        self._points = [(self.problem.rest.copy(), self.problem.a_rest)] * 2

    # -- sample by sample, as the paper does -----------------------------------------------------------

    def extrapolate(self, sample: int) -> None:
        """Move every wire on towards a sample, on the secant through the last two points solved: as far as
        the change of R is a multiple of the last change, and no farther than the trust radius."""
        (x_before, a_before), (x, a) = self._points
        _secant(x_before, a_before, x, a, self._knots[sample + 1], self.problem.step_limit, self.solver.x)

    def solve(self, sample: int, tolerance: float, most_steps: int) -> Index:
        """Solve a sample from where the wires are; (U,) steps, 0 where the first-order optimality was below
        the tolerance already."""
        self._call(self._everywhere, float(sample), wires.SKIP, tolerance, most_steps)
        self._points = [self._points[1], (self.solver.x.copy(), self._knots[sample + 1])]
        known = self.solver.report[:, wires.BRANCH]
        self._crossed |= known * self._branch < 0
        self._branch = np.where(known != 0, known, self._branch)
        return np.asarray(self.solver.report[:, wires.STEPS].copy())

    def finish(self, tolerance: float, most_steps: int, todo: Mask | None = None) -> None:
        """Solve the last sample for good, on the wires in ``todo`` (U,) or all."""
        todo = np.ones(self.wires, bool) if todo is None else todo
        self._take(todo, tolerance, most_steps, None)
        self._path_end = self.solver.x.copy()
        self._crossed |= todo & (self.solver.report[:, wires.BRANCH] * self._branch < 0)
        self.status[(self.status == op.CONVERGED) & self._crossed] = op.ILL_CONDITIONED

    # -- wire by wire ----------------------------------------------------------------------------------

    def predict(self, position: Float) -> Float:
        """(U, n) Euler's prediction of x at ``position`` (U,), from the last converged solve of each wire."""
        change = self._a(position) / self.solver.a_solved - 1.0
        return np.asarray(self.solver.x - np.einsum("ujk,uk->uj", self.solver.inverse, change))

    def step(self, todo: Mask, position: Float, tolerance: float, most_steps: int) -> Mask:
        """Predict and correct the wires in ``todo`` to their ``position``; (U,) which came to a root on the
        branch they were on. The others stay where they are."""
        solver = self.solver
        before = solver.x.copy(), solver.inverse.copy(), solver.a_solved.copy()
        tasks = wires.COVARIANCE
        self._call(
            np.where(todo, wires.PREDICT, wires.LEAVE).astype(np.uint8),
            position,
            tasks,
            tolerance,
            most_steps,
        )
        arrived = todo & self._on_branch()
        lost = todo & ~arrived
        self._stumbled |= lost
        for now, then in zip((solver.x, solver.inverse, solver.a_solved), before, strict=True):
            now[lost] = then[lost]
        return arrived

    def guide(self, todo: Mask, tolerance: float, most_steps: int) -> None:
        """Solve the last sample from the smoothest displacement that explains it, or, where that is a root
        across a fold, from its twin on this side; keep the smoother root.

        Where this comes to no root, the one there was is not CONVERGED."""
        if not todo.any():
            return
        solver = self.solver
        x, inverse = solver.x.copy(), self._inverse.copy()
        kept = self.status.copy(), self.residual.copy(), self.error_estimate.copy(), self._side.copy()
        evaluations = np.zeros(self.wires, np.int64)
        for u in np.flatnonzero(todo).tolist():
            covariance = self.smoothness.covariance[u]
            solver.x[u], evaluations[u] = guided_start(self.problem, u, self._knots[-1, u], covariance)
        at = np.where(todo, self.samples - 1.0, math.nan)
        self._log.append((at, evaluations, evaluations, np.full(self.wires, math.nan)))
        most_steps = min(most_steps, GUIDED_STEPS)
        self._take(todo, tolerance, most_steps, op.LEVENBERG_MARQUARDT)
        across = todo & (solver.report[:, wires.STATUS] == op.CONVERGED) & ~self._on_branch()
        beyond = self.smoothness.roughness(solver.x)
        for u in np.flatnonzero(across).tolist():
            solver.x[u] = near_twin(self.problem, solver.x[u], self._knots[-1, u], self._inverse[u])
        if across.any():
            self._take(across, tolerance, most_steps, op.LEVENBERG_MARQUARDT)
            twins = beyond < TWIN_ROUGHNESS * self.smoothness.roughness(solver.x)
            self.status[across & (self.status == op.CONVERGED) & twins] = op.ILL_CONDITIONED
        smoother = self.smoothness.roughness(solver.x) < self.smoothness.roughness(x)
        was, came = kept[0] == op.CONVERGED, self.status == op.CONVERGED
        back = todo & was & ~(came & smoother)
        solver.x[back], self._inverse[back] = x[back], inverse[back]
        after = self.status, self.residual, self.error_estimate, self._side
        for now, then in zip(after, kept, strict=True):
            now[back] = then[back]
        self.status[back & ~came] = op.ILL_CONDITIONED

    def doubtful(self) -> Mask:
        """(U,) wires that came to no root, or to one too rough for a press, or had to take a step back."""
        return np.asarray((self.status != op.CONVERGED) | self._rough() | self._stumbled)

    def doubt_rough(self, tolerance: float, most_steps: int) -> None:
        """Take CONVERGED from a rough root that is not the smoothest to be found, and move no wire."""
        todo = self._rough() & (self.status == op.CONVERGED)
        x, inverse, side, status = (
            each.copy() for each in (self.solver.x, self._inverse, self._side, self.status)
        )
        residual, error_estimate = self.residual, self.error_estimate
        self.residual, self.error_estimate = residual.copy(), error_estimate.copy()
        self.guide(todo, tolerance, most_steps)
        apart = np.abs(self.solver.x - x).max(axis=1) > SAME * np.abs(x - self.problem.rest).max(axis=1)
        status[todo & (apart | (self.status != op.CONVERGED))] = op.ILL_CONDITIONED
        self.solver.x[:], self._inverse[:], self._side[:], self.status[:] = x, inverse, side, status
        self.residual, self.error_estimate = residual, error_estimate

    def consult(self, x: Float, std: Float, tolerance: float, most_steps: int) -> None:
        """Hold every root against an estimate of the whole patch, ``x`` and ``std`` (U, n), pitches. Where
        they disagree, and where there is no root, one is looked for from the estimate on. It may lie across a
        fold, which the skin itself can pass, where the samples led to the same root."""
        solver, reach = self.solver, AGREE * std
        self._estimate = x, reach
        agreed = (np.abs(solver.x - x) <= reach).all(axis=1)
        todo = ~(agreed & (self.status == op.CONVERGED))
        if not todo.any():
            return
        root, converged = solver.x.copy(), self.status == op.CONVERGED
        if not self.second_tries:
            self.status[todo & converged] = op.ILL_CONDITIONED
            return
        solver.x[todo] = x[todo]
        self._take(todo, tolerance, most_steps, op.LEVENBERG_MARQUARDT, self._at_path_end)
        agreed = (np.abs(solver.x - x) <= reach).all(axis=1)
        found = (self.status == op.CONVERGED) & agreed
        self.status[todo & (self.status == op.CONVERGED) & ~found] = op.ILL_CONDITIONED
        back = todo & converged & ~found
        solver.x[back] = root[back]
        self.status[back] = op.ILL_CONDITIONED

    def weigh_rivals(
        self,
        starts: Float,
        energy: Callable[[Float], float],
        unlikely: Float,
        tolerance: float,
        most_steps: int,
    ) -> None:
        """Of the roots that other starts ``starts`` (S, U, n), pitches, come to, keep the likeliest: that of
        the least ``energy``, −2 log of the density of a displacement field (U, n) to a constant.

        It is CONVERGED only where no other comes within ``unlikely`` (U,) of it.
        """
        solver, rest = self.solver, self.problem.rest
        found = solver.x.copy()
        twins = np.where((self.status == op.CONVERGED)[:, None], self._twins(), found)
        root = found.copy()
        size, least = np.abs(root - rest).max(axis=1), energy(root - rest)
        close, better = np.zeros(self.wires, bool), np.zeros(self.wires, bool)
        for start in (twins, *starts):
            todo = self.status == op.CONVERGED
            call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
            solver.x[:] = start
            self._call(call, self.samples - 1.0, 0, TWIN_TOLERANCE, TWIN_STEPS, op.LEVENBERG_MARQUARDT)
            other = np.abs(solver.x - root).max(axis=1) > SAME * size
            other &= todo & (solver.report[:, wires.STATUS] == op.CONVERGED)
            for u in np.flatnonzero(other & ~self.problem.out_of_reach(solver.x)).tolist():
                rival = root.copy()
                rival[u] = solver.x[u]
                gain = least - energy(rival - rest)
                close[u] = abs(gain) < unlikely[u] or (close[u] and gain < 0)
                if gain > 0:
                    root[u], better[u] = rival[u], True
                    least -= gain
        if not self.second_tries:
            self.status[(close | better) & (self.status == op.CONVERGED)] = op.ILL_CONDITIONED
            solver.x[:] = found
            return
        solver.x[:] = root
        if better.any():
            self._take(better, tolerance, most_steps, op.LEVENBERG_MARQUARDT)
        self.status[close & (self.status == op.CONVERGED)] = op.ILL_CONDITIONED

    def refuse(self, blind: Mask) -> None:
        """Take CONVERGED from these wires (U,), whatever they came to."""
        self.status[blind & (self.status == op.CONVERGED)] = op.ILL_CONDITIONED

    def doubt_twins(self) -> None:
        """Take CONVERGED from a root with a twin as smooth on the other side of a fold."""
        if self.problem.layout.shape[1] != self.problem.layout.unknowns:
            return  # more equations than unknowns: a fold leaves no second root
        solver = self.solver
        root, twins = solver.x.copy(), self._twins()
        size = np.abs(root - self.problem.rest).max(axis=1)
        todo = np.abs(twins - root).max(axis=1) < TWIN_REACH * size
        solver.x[todo] = twins[todo]
        if todo.any():
            call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
            self._call(call, self.samples - 1.0, 0, TWIN_TOLERANCE, TWIN_STEPS, op.LEVENBERG_MARQUARDT)
            other = solver.report[:, wires.BRANCH] * self._side < 0
            other &= todo & ~self.problem.out_of_reach(solver.x)
            if self._estimate is not None:  # and the patch speaks for it
                x, reach = self._estimate
                other &= (np.abs(solver.x - x) <= reach).all(axis=1)
            smooth = self.smoothness.roughness(solver.x) < TWIN_ROUGHNESS * self.smoothness.roughness(root)
            self.status[other & smooth] = op.ILL_CONDITIONED
        solver.x[:] = root

    def _twins(self) -> Float:
        """(U, n) estimates of the roots across the nearest folds, NaN of wires that are not CONVERGED."""
        twins = np.full_like(self.solver.x, math.nan)
        for u in np.flatnonzero(self.status == op.CONVERGED).tolist():
            twins[u] = near_twin(self.problem, self.solver.x[u], self._knots[-1, u], self._inverse[u])
        return twins

    # -- the log ---------------------------------------------------------------------------------------

    @property
    def log(self) -> tuple[Float, Index, Index, Float]:
        """(S, U) position, steps, evaluations and first-order optimality of every call; position and
        optimality are NaN where a wire was left alone."""
        position, steps, evaluations, optimality = zip(*self._log, strict=True)
        return np.array(position), np.array(steps), np.array(evaluations), np.array(optimality)

    @property
    def rows(self) -> int:
        """Length of the log."""
        return len(self._log)

    # -- inside ----------------------------------------------------------------------------------------

    def _take(
        self,
        todo: Mask,
        tolerance: float,
        most_steps: int,
        operator: int | None,
        also: Callable[[], Mask] | None = None,
    ) -> None:
        """Solve the last sample for the wires in ``todo`` and keep what came of it; a root across a fold is
        not CONVERGED, unless ``also`` says so, (U,)."""
        call = np.where(todo, wires.SOLVE, wires.LEAVE).astype(np.uint8)
        self._call(call, self.samples - 1.0, wires.COVARIANCE, tolerance, most_steps, operator)
        solver = self.solver
        self.status[todo] = solver.report[todo, wires.STATUS]
        good = self._on_branch() if also is None else self._on_branch() | also()
        self.status[todo & (self.status == op.CONVERGED) & ~good] = op.ILL_CONDITIONED
        self._side[todo] = solver.report[todo, wires.BRANCH]
        self.residual[todo] = solver.measure[todo, wires.RESIDUAL]
        self.error_estimate[todo] = solver.measure[todo, wires.ERROR_ESTIMATE]
        self._inverse[todo] = solver.inverse[todo]

    def _call(
        self,
        todo: NDArray[np.uint8],
        position: Float | float,
        tasks: int,
        tolerance: float,
        most_steps: int,
        operator: int | None = None,
    ) -> None:
        solver = self.solver
        solver.solve(
            todo,
            self._a(position),
            self._weight.copy(),
            tasks,
            tolerance,
            tolerance,
            most_steps,
            operator=operator,
        )
        steps, evaluations = solver.report[:, wires.STEPS], solver.report[:, wires.EVALUATIONS]
        optimality = solver.measure[:, wires.OPTIMALITY]
        if isinstance(position, float):
            position = np.full(self.wires, position)
        if todo is self._everywhere:
            self._log.append((position, steps.copy(), evaluations.copy(), optimality.copy()))
            return
        asked = todo != wires.LEAVE
        self._log.append(
            (
                np.where(asked, position, math.nan),
                np.where(asked, steps, 0),
                np.where(asked, evaluations, 0),
                np.where(asked, optimality, math.nan),
            )
        )

    def _at_path_end(self) -> Mask:
        """(U,) wires at the position in reach to which the samples led."""
        apart = np.abs(self.solver.x - self._path_end).max(axis=1)
        size = np.abs(self._path_end - self.problem.rest).max(axis=1)
        return np.asarray((apart <= SAME * size) & ~self.problem.out_of_reach(self.solver.x))

    def _rough(self) -> Mask:
        """(U,) wires whose displacement is too rough for a press."""
        moved = np.sqrt(((self.solver.x - self.problem.rest) ** 2).sum(axis=1)) / self.problem.step_limit
        return np.asarray(self.smoothness.roughness(self.solver.x) > ROUGH * moved)

    def _on_branch(self) -> Mask:
        """(U,) wires whose last solve came to a root on the branch of the rest position."""
        report = self.solver.report
        kept = report[:, wires.BRANCH] * self._rest_branch >= 0
        reached = (report[:, wires.STATUS] == op.CONVERGED) & kept
        return np.asarray(reached & ~self.problem.out_of_reach(self.solver.x))

    def _a(self, position: Float | float) -> Float:
        """(U, K) ``a`` of every wire at its position (U,), or of all at a sample."""
        if isinstance(position, float):
            return np.asarray(self._knots[int(position) + 1].copy())
        before = np.clip(np.floor(position).astype(np.int64), -1, self.samples - 2)
        share = (position - before)[:, None]
        every = np.arange(self.wires)
        first, second = self._knots[before + 1, every], self._knots[before + 2, every]
        return np.where(share == 1.0, second, first + share * (second - first))


@njit
def _secant(
    x_before: Float, a_before: Float, x: Float, a: Float, a_next: Float, reach: float, out: Float
) -> None:
    """x + share (x − x_before) of every wire into ``out`` (U, n), no coordinate by more than ``reach``; the
    share is that of the last change of a in the next. ``x`` where that is not finite."""
    for u in range(x.shape[0]):
        along, square, longest = 0.0, TINY, reach
        for k in range(a.shape[1]):
            change = a[u, k] / a_before[u, k] - 1.0
            along += change * (a_next[u, k] / a[u, k] - 1.0)
            square += change * change
        share = along / square
        for j in range(x.shape[1]):
            longest = max(longest, abs(share * (x[u, j] - x_before[u, j])))
        for j in range(x.shape[1]):
            move = share * (x[u, j] - x_before[u, j]) * (reach / longest)
            out[u, j] = x[u, j] + (move if math.isfinite(move) else 0.0)
