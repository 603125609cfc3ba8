"""The path of the paper run for ever: a live stream of frames, each solved from the one before.

rest       a wire whose resistances have not changed beyond their noise keeps its position (see ``follow``)
predict    x + (∂x/∂R) ΔR with the J⁻¹ of an earlier frame, which its covariance needed anyway
follow     simplified Newton steps with the same J⁻¹, while it is still nearly that of the position
correct    the operator, where it is not, to a tolerance far below any noise
bridge     a wire that fails: its R interpolated from the last trusted frame to the new one
restart    the same from the rest position
give up    a wire that still fails keeps its last trusted position, with an infinite deviation and a status

A root counts only on the branch the skin can reach: the determinant of J keeps the sign it has at rest, and
no electrode moves farther than its clearance from the lower layer. A system with more equations than unknowns
has no determinant; there χ² of the residual must be one that noise can cause.

Two switches leave unknowns out. ``normal_only``: x and y of every electrode stay at rest. ``active_only``:
the electrodes that no contact moves stay at rest. A wire starts with none that moves; when χ² says that this
does not explain the frame, the electrode that explains most of the residual joins with its neighbours, until
χ² is content, or more than half have joined and the rest follow. All are at rest again when that explains
the frame. The deviation of a coordinate so left out is the move at which χ² would have noticed its electrode,
were it the only one, in first order at rest: √(quantile − degrees of freedom) σ / ‖its column of J outside
the range of the unknowns and of the electrode's other columns‖.

Both are claims about the skin, and the deviations of the unknowns are those given the claim. Of active_only
χ² sees to it. Of normal_only it sees less: a smooth shear looks like a slope of z. On staggered h = 0.5,
noise 1e-5, a Hertzian press with a shear of 0.3 of its depth is refused where it is strong; where not, z is
off by up to 16 of its small deviations, 0.2 % of h. To allow for it would cost more than to solve for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.forward import jacobian
from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import as_statuses
from skinnode.solve import operators as op
from skinnode.solve import patch_solver as stage
from skinnode.solve import wires
from skinnode.solve.follow import Z_HOLD, chi2_quantile
from skinnode.solve.frame import DEADLINE, STALE, FrameArrays
from skinnode.solve.inputs import CodeMap, broadcast_noise, checked_codes, checked_mask, checked_noise
from skinnode.solve.patch_solver import PatchSolver
from skinnode.solve.problem import PatchProblem
from skinnode.solve.system import operator_code

TOLERANCE: Final = 1e-9
"""Of r and, in pitches, of x: four orders below a 24-bit converter, and one Newton step from 1e-5."""
BRIDGE_TOLERANCE: Final = 1e-6
"""Of the substeps of a bridge, the paper's intermediate tolerance."""
FRAME_STEPS: Final = 12
"""Most steps of a solve: quadratic convergence from within the trust region takes 3 to 6."""
UNIT_S: Final = 10e-6
"""An evaluation of F and J and the step from there take no longer. As many wires as fit for sure into what is
left of a deadline are solved in one call: ten calls in place of one cost as much as the ten wires."""
WIRE_UNITS: Final = FRAME_STEPS + 1 + wires.COVARIANCE_UNITS
"""Most evaluations a wire may take for a frame."""
BRIDGES: Final = (3, 5, 10)
"""Substeps of the bridges tried in turn. On staggered, h = 0.5, from rest: 3 bring every wire through
a 50 % press between two frames, 5 all but one of 24 through 70 %. Steps halved and doubled, and held to the
trusted branch, do worse: the straight line crosses singular points that the press does not."""
BRIDGE_STEPS: Final = 20
"""Most steps of a substep."""
RECOVERY_STEPS: Final = 300
"""Most steps all bridges of a frame may take together, about 15 ms: a broken frame must
not stop the stream."""
Z_WIDEN: Final = 3.719
"""Normal deviate of the quantile, 1 − 1e-4, of χ² at which electrodes join: a long press at 100 frames/s
gains one by chance in 100 s."""
TINY: Final = 1e-200
"""Far below any square of a slope, and nothing overflows that is divided by it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame in the units of the problem, and until when it may be solved (s, inf for ever)."""

    a: Float
    weight: Float
    used: Float
    """The weight, 0 also where ``a`` is no resistance."""
    sigma: float
    until: float

    @property
    def expired(self) -> bool:
        return self.until < math.inf and perf_counter() >= self.until


class ExactTracker:
    """Follows one patch by the exact inverse of each wire, frame by frame.

    One owner; the compiled part holds no GIL.

    Args:
        layout: the patch, K ≥ 3N, or K ≥ N where ``normal_only``.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``.
        relative_noise: standard deviation of R relative to R, a number or (U, K).
        baseline_ohm: (U, K) resistances measured at rest; the resistivity and the gain then cancel.
        stiffness_n_per_m: k of the paper's law F = k Δs; forces are given where it is.
        hold: leave a wire alone whose resistances have not changed beyond their noise.
        deadline_us: an update returns after this time and at most one more solve of a wire. A wire that had
            no turn is DEADLINE with an infinite deviation; it is first in the next frame.
        normal_only: only z is unknown.
        active_only: only the electrodes that contacts move are unknown.
        codes: what the codes given to :meth:`update_codes` mean.

    Compiles its kernels on construction. Raises ValueError for arguments of the wrong shape or range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        *,
        operator: str = "levenberg_marquardt",
        relative_noise: ArrayLike = 1e-5,
        baseline_ohm: ArrayLike | None = None,
        stiffness_n_per_m: float | None = None,
        hold: bool = True,
        deadline_us: float | None = None,
        normal_only: bool = False,
        active_only: bool = False,
        codes: CodeMap | None = None,
    ) -> None:
        for name, value in (("stiffness_n_per_m", stiffness_n_per_m), ("deadline_us", deadline_us)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: got {value}, must be positive and finite")
        unknowns = layout.unknowns // 3 if normal_only else layout.unknowns
        if layout.shape[1] < unknowns:
            raise ValueError(
                f"layout: got {layout.shape[1]} lower wires for {unknowns} unknowns an upper wire, "
                "must be at least as many"
            )
        self.layout = layout
        self._problem = PatchProblem.of(layout, baseline_ohm)
        self.stiffness_n_per_m = stiffness_n_per_m
        self._noise = checked_noise(relative_noise, layout)
        self._sigma = float(self._noise.min())
        self._first = wires.HOLD if hold else wires.PREDICT  # where a wire can be predicted
        self._seconds = math.inf if deadline_us is None else deadline_us * 1e-6
        self._active_only = active_only
        self._in_order = np.arange(layout.shape[0])
        self._leaves_out = active_only or normal_only
        self._todo = np.empty(layout.shape[0], np.uint8)
        self._all_converged = as_statuses([op.CONVERGED] * layout.shape[0])
        self._solver = PatchSolver(self._problem, operator_code(operator), normal_only)
        self._rest_branch = self._solver.solve_rest()
        self._rest_known = self._solver.report[:, wires.STATUS] == op.CONVERGED
        self._rest_inverse = self._solver.inverse.copy()
        self.arrays = FrameArrays(self._problem, self._rest_branch, self._solver.each * self._solver.free)
        """Of the stream and the frame at hand."""
        if codes is not None:
            self.arrays.set_codes(codes)
        self.invalid_codes = 0
        """Of the last scan of codes, how many were no measurement."""
        # ∂r/∂x at rest of every coordinate, (U, 3N, K), and what an unknown left out may move by unnoticed
        slopes = jacobian(layout, layout.upper_m).reshape(*layout.shape, -1) * layout.pitch_m**2
        self._slopes = np.ascontiguousarray((slopes * self._problem.a_rest[:, :, None]).transpose(0, 2, 1))
        self._unnoticed = np.zeros((layout.shape[0], layout.unknowns))
        # limits of χ² by degrees of freedom
        self._chi2_hold, self._chi2_widen, self._chi2_refuse = (
            np.array([chi2_quantile(max(dof, 1), z) for dof in range(layout.shape[1] + 1)])
            for z in (Z_HOLD, Z_WIDEN, wires.Z_REFUSE)
        )
        self.reset()
        self.update(self._problem.a_rest / self._problem.gain)  # compiles what has not been, before a stream
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        its = self.arrays
        its.x[:], its.a_solved[:] = self._problem.rest, self._problem.a_rest
        self._solver.inverse[:] = self._rest_inverse
        self._solver.turn = 0
        self._solver.a_solved[:] = self._problem.a_rest
        self._solver.noise[:] = 0.0
        its.weight_solved[:] = 1.0
        self._unnoticed_weight = np.zeros(self.layout.shape)  # for which self._unnoticed was made
        its.predictable[:] = self._rest_known
        self._order = self._in_order  # whose turn it is, where there is a deadline
        if self._active_only:
            for u in self._in_order.tolist():
                self._set_electrodes(u, np.arange(0))
            its.predictable[:] = True

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """The displacement field of one frame.

        Args:
            frame_ohm: (U, K) resistances; whatever is not positive and finite is not used.
            valid: (U, K) bool, False where a chunk or wire is missing; default all.
            relative_noise: as in the constructor, of this frame only; what is not positive and finite makes
                its resistance unused.

        Never raises for numbers. A wire with fewer usable resistances than unknowns is ILL_CONDITIONED, or
        NON_FINITE where resistances not marked as missing were unusable. Such a wire, and one that no solve
        brings to a root, holds its last trusted position with an infinite deviation; its residual is taken
        there, and inf where the deadline left no time to. Raises ValueError for wrong shapes.
        """
        start = perf_counter()
        its = self.arrays
        # copies, for the kernel has the addresses of these
        its.ohm[:] = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
        its.noise[:] = self._noise if relative_noise is None else broadcast_noise(relative_noise, self.layout)
        its.valid[:] = True if valid is None else checked_mask(valid, self.layout)
        return self._advance(stage.TAKE, start)

    def update_codes(self, codes: NDArray[np.uint32]) -> FieldFrame:
        """The field of a scan of (U, K) codes, as :meth:`update` makes it of the resistances and the noise
        that they stand for. Afterwards :attr:`arrays` has those, and :attr:`invalid_codes` counts what was
        none. Raises ValueError for another shape, or numbers that are no uint32."""
        start = perf_counter()
        self.arrays.codes[:] = checked_codes(codes, self.layout)
        return self._advance(stage.DECODE | stage.TAKE, start)

    def _advance(self, stages: int, start: float) -> FieldFrame:
        """The field of the frame that :attr:`arrays` has, after the ``stages`` that come before its solve."""
        solver, its = self._solver, self.arrays
        solver.turn += 1
        sigma, until, units = self._sigma, start + self._seconds, math.inf
        if self._leaves_out:
            sigma, _ = self._call_stages(stages, sigma, units)
            self._leave_out(sigma)
            stages = 0
        if until < math.inf:
            units = max(WIRE_UNITS, (until - perf_counter()) / UNIT_S)
        stages |= stage.CHOOSE
        if not self._active_only:  # all wires have as many unknowns
            stages |= stage.SOLVE | stage.REACH | stage.FINISH
        sigma, found = self._call_stages(stages, sigma, units)
        easy = found & stage.ALL_GOOD != 0
        if easy:
            self._order = self._in_order
            residual = solver.measure[:, wires.RESIDUAL].copy()
        else:
            frame = _Frame(its.a, its.weight, its.used, sigma, until)
            if self._active_only:
                self._solve(self._todo, frame)
            elif until < math.inf:
                self._solve_rest_of(self._todo, frame)
            residual = self._rescue(frame)
            _, found = self._call_stages(stage.FINISH, sigma, math.inf)
        if found & stage.INCOMPLETE:
            self._complete()
        displacement, std = its.outcome_m.copy()
        evaluations, jacobians, steps = solver.tally.tolist()
        return FieldFrame(
            displacement_m=displacement,
            displacement_std_m=std,
            status=self._all_converged if easy else as_statuses(its.status.tolist()),
            residual=residual,
            stats=SolveStats(evaluations, jacobians, steps, perf_counter() - start),
            force_n=None if self.stiffness_n_per_m is None else self.stiffness_n_per_m * displacement,
            held=its.held.copy(),
        )

    def _call_stages(self, stages: int, sigma: float, units: float) -> tuple[float, int]:
        """As :meth:`PatchSolver.advance` does them for a frame: σ, and what came of it."""
        sigma, invalid, found = self._solver.advance(
            stages,
            self.arrays,
            self._first,
            self._todo,
            wires.COVARIANCE | wires.REUSE,
            TOLERANCE,
            FRAME_STEPS,
            sigma,
            self._order,
            units,
        )
        if stages & stage.DECODE:
            self.invalid_codes = invalid
        return sigma, found

    def _rescue(self, frame: _Frame) -> Float:
        """Try what is left to try on wires that were not brought to a root: their status and whether they are
        good, and (U,) residuals."""
        solver, good, status = self._solver, self.arrays.good, self.arrays.status
        turns = solver.report[:, wires.TURN] == 1
        exhausted = np.zeros_like(turns)  # whatever could be tried has been
        if self._active_only:
            unexplained = turns & ~self._explained()
            for u in [u for u in self._order.tolist() if unexplained[u]]:
                turns[u] = not frame.expired
                self._widen(u, frame)
                exhausted[u] = True
        good[:], status[:] = self._roots(), solver.report[:, wires.STATUS]
        if not good.all():
            status[(status == op.CONVERGED) & ~good] = op.ILL_CONDITIONED
            lost = ~good & (status != DEADLINE) & self._solvable(frame)
            for u in [u for u in self._order.tolist() if lost[u] and not exhausted[u]]:
                if frame.expired:
                    turns[u], status[u] = False, DEADLINE
                    continue
                good[u] = self._recover(u, frame)
                ended = int(solver.report[u, wires.STATUS])
                status[u] = op.ILL_CONDITIONED if ended == op.CONVERGED and not good[u] else ended
            solver.std[~good] = np.inf
            self.arrays.predictable &= ~(lost | exhausted)  # what was not tried keeps its inverse
        residual = solver.measure[:, wires.RESIDUAL].copy()
        for u in np.flatnonzero(~good).tolist():
            known = status[u] != DEADLINE and not frame.expired
            residual[u] = self._held_residual(u, frame) if known else math.inf
        # who waits comes first, in the order of waiting
        self._order = (
            self._in_order if turns.all() else self._order[np.argsort(turns[self._order], kind="stable")]
        )
        return residual

    def _complete(self) -> None:
        """The ``a`` of equations that solved wires did not have: what they would have been."""
        its = self.arrays
        solved = its.good & (self._solver.report[:, wires.HELD] == 0)
        for u in np.flatnonzero(solved & (its.used == 0).any(axis=1)).tolist():
            missing = its.used[u] == 0
            its.a_solved[u, missing] = 1.0 / (
                1.0 + self._relative_residual(its.x[u], np.ones(len(missing)))[missing]
            )

    def adopt(self, wires_: NDArray[np.bool_], displacement_m: Float) -> None:
        """Go on from these displacements (U, N, 3) on the wires (U,), as if they had been solved."""
        its = self.arrays
        moved = (displacement_m / self.layout.pitch_m).reshape(self.arrays.x.shape)
        if self._active_only:  # with every electrode an unknown again, as the displacement has them all
            for u in np.flatnonzero(wires_).tolist():
                self._set_electrodes(u, np.arange(self.layout.unknowns // 3))
        for u in np.flatnonzero(wires_).tolist():
            its.x[u] = self._problem.rest[u] + moved[u]
            its.a_solved[u] = 1.0 / (1.0 + self._relative_residual(its.x[u], np.ones(self.layout.shape[1])))
            its.predictable[u] = False

    def distrust(self, wires_: NDArray[np.bool_]) -> None:
        """Solve these wires (U,) from rest in the next frame, whatever they came to in this one."""
        its = self.arrays
        its.x[wires_], its.a_solved[wires_] = self._problem.rest[wires_], self._problem.a_rest[wires_]
        its.predictable[wires_] = False

    def _solve(self, todo: NDArray[np.uint8], frame: _Frame) -> None:
        """Solve the wires in ``todo`` for the frame, in turn where there is a deadline: one at least, lest
        the stream stand still."""
        units = math.inf
        if frame.until < math.inf:
            units = max(WIRE_UNITS, (frame.until - perf_counter()) / UNIT_S)
        self._call(todo, frame, units=units)
        if units < math.inf:
            self._solve_rest_of(todo, frame)

    def _solve_rest_of(self, todo: NDArray[np.uint8], frame: _Frame) -> None:
        """The wires in ``todo`` that had no turn, while there is time."""
        while True:
            todo[self._solver.report[:, wires.TURN] == 1] = wires.LEAVE
            if not todo.any() or frame.expired:
                return
            self._call(todo, frame, units=max(WIRE_UNITS, (frame.until - perf_counter()) / UNIT_S))

    def _call(
        self, todo: NDArray[np.uint8], frame: _Frame, a: Float | None = None, last: bool = True,
        most: int = FRAME_STEPS, method: int | None = None, units: float = math.inf,
    ) -> None:  # fmt: skip
        """One call of the solver; other ``a`` and not ``last`` for the substeps of a bridge."""
        self._solver.solve(
            todo,
            frame.a if a is None else a,
            frame.weight,
            wires.COVARIANCE | wires.REUSE if last else 0,
            TOLERANCE if last else BRIDGE_TOLERANCE,
            TOLERANCE if last else BRIDGE_TOLERANCE,
            most,
            frame.sigma,
            method,
            self._order,
            units,
        )

    def _only(self, u: int, task: int) -> NDArray[np.uint8]:
        todo = np.full(self.layout.shape[0], wires.LEAVE, np.uint8)
        todo[u] = task
        return todo

    def _roots(self) -> NDArray[np.bool_]:
        """(U,) wires that the solver brought to a root on the branch of the rest position, within reach."""
        solver = self._solver
        converged = solver.report[:, wires.STATUS] == op.CONVERGED
        same_branch = solver.report[:, wires.BRANCH] * self._rest_branch >= 0
        return np.asarray(converged & same_branch & ~self._problem.out_of_reach(solver.x))

    @property
    def _unknowns(self) -> NDArray[np.int64]:
        """(U,) unknowns of each wire."""
        return np.asarray(self._solver.each * self._solver.free)

    def _solvable(self, frame: _Frame) -> NDArray[np.bool_]:
        """(U,) wires with enough usable resistances for their unknowns."""
        count = np.count_nonzero(frame.used, axis=1)
        return np.asarray((count > 0) & (count >= self._unknowns))

    def _leave_out(self, sigma: float) -> None:
        """Put wires to rest where that explains the frame; what χ² may miss of all that is no unknown."""
        solver, layout, its = self._solver, self.layout, self.arrays
        if self._active_only:
            usable = np.where(its.used > 0, its.a, 1.0)
            square = (its.used * (usable / self._problem.a_rest - 1.0)) ** 2
            chi2 = square.sum(axis=1) / (sigma**2 + TOLERANCE**2)
            count = np.count_nonzero(its.used, axis=1)
            known = (chi2 <= self._chi2_hold[count]) & (count >= solver.each * layout.unknowns // 3)
            for u in np.flatnonzero(known & (solver.free > 0)).tolist():
                self._set_electrodes(u, np.arange(0))
                self._unnoticed_weight[u] = 0.0  # to be measured below
        its.unknowns[:] = self._unknowns
        if solver.each * solver.free.min() < layout.unknowns:
            for u in np.flatnonzero(_changed(its.used, self._unnoticed_weight)).tolist():
                self._measure_unnoticed(u, its.used[u])
            solver.still_std[:] = sigma * self._unnoticed

    def _set_electrodes(self, u: int, electrodes: NDArray[np.int64]) -> None:
        """Give unknowns to these electrodes of wire u only."""
        solver, its = self._solver, self.arrays
        solver.set_electrodes(u, electrodes)
        its.predictable[u] = len(electrodes) == 0
        if its.predictable[u]:  # then rest is known to be the solution, without noise
            its.x[u], its.a_solved[u] = self._problem.rest[u], self._problem.a_rest[u]
            solver.a_solved[u], solver.noise[u] = its.a_solved[u], 0.0

    def _measure_unnoticed(self, u: int, weight: Float) -> None:
        """How far each coordinate that is no unknown moves before χ² notices, pitches a unit of σ."""
        solver, (_, lower) = self._solver, self.layout.shape
        self._unnoticed_weight[u] = weight
        unnoticed = self._unnoticed[u].reshape(-1, 3)
        unnoticed[:] = 0.0
        moving = solver.electrodes(u)
        resting = np.ones(len(unnoticed), bool)
        resting[moving] = False
        slopes = (self._slopes[u] * weight).reshape(-1, 3, lower)
        unknown = slopes[moving, 3 - solver.each :].reshape(-1, lower)
        spare = np.count_nonzero(weight) - len(unknown)
        limit = self._chi2_refuse
        if resting.any():
            limit = self._chi2_widen if len(moving) else self._chi2_hold
        least = math.inf if spare <= 0 else math.sqrt(limit[spare] - spare)
        for group, most in ((moving, 3 - solver.each), (resting, 3)):
            if most:
                seen = _outside(slopes[group, :most].reshape(-1, lower), unknown).reshape(-1, most, lower)
                power, direction = np.linalg.eigh(seen @ seen.transpose(0, 2, 1))
                power = np.maximum(power, op.EPS * power[:, -1:] + TINY)  # rounding is no knowledge
                unnoticed[group, :most] = least * np.sqrt((direction**2 / power[:, None]).sum(axis=2))

    def _explained(self) -> NDArray[np.bool_]:
        """(U,) wires at a root or minimum whose χ² noise can cause, and those with no electrode to add."""
        solver = self._solver
        spare = solver.report[:, wires.SPARE]
        limit = np.where(solver.free > 0, self._chi2_widen[spare], self._chi2_hold[spare])
        content = (solver.report[:, wires.HELD] == 1) | (solver.measure[:, wires.CHI2] <= limit)
        whole = 3 * solver.free == self.layout.unknowns
        return np.asarray(whole | (self._roots() & content))

    def _widen(self, u: int, frame: _Frame) -> None:
        """Let electrodes of wire u join until they explain the frame; undone where not even all do."""
        solver, most = self._solver, self.layout.unknowns // 3
        before = solver.electrodes(u).copy()
        while self._solvable(frame)[u] and not self._explained()[u]:
            if frame.expired:
                solver.report[u, wires.STATUS] = DEADLINE
                break
            electrodes = np.arange(most)
            near = not self._problem.out_of_reach(solver.x)[u]
            if near and solver.measure[u, wires.CHI2] < np.inf:  # a minimum, if not low enough
                joined = np.union1d(solver.electrodes(u), self._suspects(u, frame))
                electrodes = electrodes if 2 * len(joined) > most else joined
            self._set_electrodes(u, electrodes)
            solver.x[u] = self.arrays.x[u]
            self._call(self._only(u, wires.SOLVE), frame)
            if len(electrodes) == most and not self._roots()[u] and self._solvable(frame)[u]:
                self._recover(u, frame)
        if len(solver.electrodes(u)) > len(before) and not self._roots()[u]:
            self._set_electrodes(u, before)
        if len(solver.electrodes(u)) > len(before):
            self._measure_unnoticed(u, frame.used[u])
            left_out = self._unnoticed[u] > 0
            solver.std[u, left_out] = frame.sigma * self._unnoticed[u, left_out]

    def _suspects(self, u: int, frame: _Frame) -> NDArray[np.int64]:
        """The electrode at rest that explains most of the residual of wire u, and its neighbours."""
        each, (_, lower), most = self._solver.each, self.layout.shape, self.layout.unknowns // 3
        slopes = (self._slopes[u] * frame.used[u]).reshape(most, 3, lower)[:, 3 - each :]
        moving = self._solver.electrodes(u)
        rest = np.setdiff1d(np.arange(most), moving)
        outside = _outside(slopes[rest].reshape(-1, lower), slopes[moving].reshape(each * len(moving), lower))
        directions = np.linalg.qr(outside.reshape(-1, each, lower).transpose(0, 2, 1))[0]
        residual = frame.used[u] * self._relative_residual(self._solver.x[u], frame.a[u])
        explained = ((directions * residual[:, None]).sum(axis=1) ** 2).sum(axis=1)
        best = int(rest[np.argmax(explained)])
        return np.arange(max(best - 1, 0), min(best + 2, most))

    def _recover(self, u: int, frame: _Frame) -> bool:
        """Bridge wire u from its last trusted position, then from rest; whether that brought it to a root."""
        starts = [(self.arrays.x[u].copy(), self.arrays.a_solved[u].copy())]
        rest = self._problem.rest[u], self._problem.a_rest[u]
        if not np.array_equal(starts[0][0], rest[0]):
            starts.append(rest)
        for substeps in BRIDGES:
            for x_from, a_from in starts:
                if self._solver.tally[2] >= RECOVERY_STEPS:
                    return False
                if not self._bridge(u, x_from, a_from, frame, substeps):
                    self._solver.report[u, wires.STATUS] = DEADLINE
                    return False
                if self._roots()[u]:
                    return True
        return False

    def _bridge(self, u: int, x_from: Float, a_from: Float, frame: _Frame, substeps: int) -> bool:
        """Solve wire u along the straight line of its resistances from ``a_from`` to those of the frame.

        Only the last point counts: the line is no deformation of rubber, so the points between may lie on any
        branch. The outcome is the solver's report of the wire. False where the deadline cut it short.
        """
        todo = self._only(u, wires.SOLVE)
        between = frame.a.copy()
        self._solver.x[u] = x_from
        for part in range(1, substeps + 1):
            if frame.expired:
                return False
            last = part == substeps
            between[u] = frame.a[u] if last else a_from + part / substeps * (frame.a[u] - a_from)
            # the sturdiest across a gap, whatever follows the stream
            self._call(todo, frame, between, last, BRIDGE_STEPS, op.LEVENBERG_MARQUARDT)
        return True

    def _relative_residual(self, x: Float, a: Float) -> Float:
        """(K,) a F − 1 of a wire at ``x``."""
        gaps = x.reshape(-1, 1, 3, 1) - self._problem.lower.transpose(1, 0, 2)[None]
        return np.asarray(a * (1.0 / np.sqrt((gaps**2).sum(axis=2))).sum(axis=(0, 1)) - 1.0)

    def _held_residual(self, u: int, frame: _Frame) -> float:
        """RMS of F/b − 1 of wire u at its held position over the usable resistances; inf if there is none."""
        used = frame.used[u] > 0
        if not used.any():
            return math.inf
        return float(np.sqrt(np.mean(self._relative_residual(self.arrays.x[u], frame.a[u])[used] ** 2)))


def _changed(weight: Float, before: Float) -> NDArray[np.bool_]:
    """(U,) wires with an equation that counts for over ``STALE`` times as much, or as little, as before."""
    return np.asarray(((weight > STALE * before) | (before > STALE * weight)).any(axis=1))


def _outside(rows: Float, others: Float) -> Float:
    """``rows`` (n, K) less what the rows ``others`` (m, K) span."""
    q = np.linalg.qr(others.T)[0]
    return np.asarray(rows - (rows @ q) @ q.T)
