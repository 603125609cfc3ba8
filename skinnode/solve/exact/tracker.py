"""Exact tracker: solves each frame of a live stream, starting from the solution for the previous frame.

Each wire passes through these stages until one of them finds a root of F = b:

- hold: keep the last position if the resistances changed by no more than their noise (module ``hold``);
- predict: move the electrodes by (∂x/∂R) ΔR, with the J⁻¹ of an earlier frame;
- follow: take simplified Newton steps with the same J⁻¹ while it is accurate enough (module ``follow``);
- correct: iterate the operator to a tolerance far below any noise (module ``correct``);
- widen: make a fixed electrode an unknown if it seems to move (module ``fixed_coordinates``);
- recover: retry the wire if no root was found (module ``recover_lost_wires``).

:mod:`skinnode.solve.roots` defines which roots are acceptable.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import as_statuses
from skinnode.process.clock import perf_counter
from skinnode.solve.exact.fixed_coordinates import LeftOut
from skinnode.solve.exact.recover_lost_wires import recover_lost
from skinnode.solve.exact.stream import FRAME_STEPS, Frame, StreamState
from skinnode.solve.inputs import CodeMap, broadcast_noise, checked_codes, checked_mask, checked_noise
from skinnode.solve.noise_estimate import NoiseEstimate
from skinnode.solve.operators import codes as op
from skinnode.solve.operators.system import operator_code
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires import patch_solver as stage
from skinnode.solve.wires.arrays import NOISE
from skinnode.solve.wires.problem import PatchProblem
from skinnode.solve.wires.solve_wires import COVARIANCE_UNITS
from skinnode.solve.wires.stages import DEADLINE

UNIT_S: Final = 10e-6
"""Upper bound on the time for one solver step, including one evaluation of F and J, in seconds.

Each call to the solver processes all wires that are certain to finish before the deadline. Ten calls instead
of one would cost as much extra time as solving ten more wires.
"""
WIRE_UNITS: Final = FRAME_STEPS + 1 + COVARIANCE_UNITS
"""Maximum computing time for one wire in one frame, in units of one evaluation of F and J plus one step."""


class ExactTracker:
    """Tracker of one patch that solves each upper wire separately (exact inverse).

    Each patch needs its own tracker. The compiled code releases the GIL.

    Args:
        layout: The patch, with K ≥ 3N, or K ≥ N if ``normal_only``.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``.
        relative_noise: Relative standard deviation of R, scalar or (U, K).
        baseline_ohm: (U, K) resistances measured at rest, in ohms. If given, errors in resistivity and gain
            cancel.
        stiffness_n_per_m: Stiffness k of the paper's force law F = k Δs, in N/m. If given, each field
            contains the forces F.
        hold: Whether to keep the last position of a wire while its resistances change by no more than their
            noise.
        deadline_us: Time limit for an update, in µs; an update can exceed it by the time needed for one wire.
            Wires not processed by the deadline have the status DEADLINE and an infinite standard deviation,
            and are processed first in the next frame.
        normal_only: Whether to fix x and y at rest and solve for z only.
        active_only: Whether to fix electrodes at rest unless a contact moves them.
        codes: Mapping from the codes passed to :meth:`update_codes` to resistances.
        noise_estimate: Estimator of the stream's noise, which scales the stated noise. :meth:`reset` does not
            reset it.

    The constructor compiles the kernels. It raises ValueError if an argument has the wrong shape or is out of
    range.
    """

    def __init__(  # noqa: PLR0913 - keyword arguments of the public interface
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
        noise_estimate: NoiseEstimate | None = None,
    ) -> None:
        for name, value in (("stiffness_n_per_m", stiffness_n_per_m), ("deadline_us", deadline_us)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: got {value}, must be positive and finite")
        unknowns = layout.unknowns // 3 if normal_only else layout.unknowns
        if layout.shape[1] < unknowns:
            raise ValueError(
                f"layout: got {layout.shape[1]} lower wires for {unknowns} unknowns per upper wire, "
                "must have at least as many lower wires as unknowns"
            )
        self.layout = layout
        problem = PatchProblem.of(layout, baseline_ohm)
        self.stiffness_n_per_m = stiffness_n_per_m
        self.untouched_force_n: Float | None = None
        """(U, N, 3) forces on an untouched patch, in N; reported if no stiffness is given."""
        self._noise = checked_noise(relative_noise, layout)
        self._sigma = float(self._noise.min())
        self._seconds = math.inf if deadline_us is None else deadline_us * 1e-6
        self._active_only = active_only
        self._leaves_out = active_only or normal_only
        self._in_order = np.arange(layout.shape[0])
        self._all_converged = as_statuses([op.CONVERGED] * layout.shape[0])
        self._stream = StreamState(
            problem, operator_code(operator), normal_only, wires.HOLD if hold else wires.PREDICT
        )
        self._left_out = LeftOut(self._stream, active_only)
        self.arrays = self._stream.arrays
        """Arrays of the current frame and of the last trusted solution."""
        self._code_noise = np.zeros(layout.shape)
        if codes is not None:
            self.arrays.set_codes(codes)
            self._code_noise[:] = codes.relative_noise
        self._code_factor = 1.0  # noise factor already included in the code map
        self._noise_estimate: NoiseEstimate | None = None
        self._all_valid: NDArray[np.bool_] | None = None  # valid readings of a frame that is solved again
        self.invalid_codes = 0
        """Number of invalid codes in the last scan."""
        self.reset()
        self.update(problem.a_rest / problem.gain)  # compiles the kernels before a stream starts
        self.reset()
        self._noise_estimate = noise_estimate

    def reset(self) -> None:
        """Discard the state of the stream; the next frame is solved from the rest position."""
        self._stream.reset()
        self._left_out.reset()
        self.arrays.order[:], self._waiting = self._in_order, False

    def update(
        self,
        frame_ohm: ArrayLike,
        valid: ArrayLike | None = None,
        relative_noise: ArrayLike | None = None,
        left_out: NDArray[np.bool_] | None = None,
    ) -> FieldFrame:
        """Return the displacement field of one frame.

        Args:
            frame_ohm: (U, K) resistances, in ohms; values that are not positive and finite are ignored.
            valid: (U, K) bool, False for missing readings; default: all True.
            relative_noise: Relative standard deviation of the resistances of this frame, scalar or (U, K);
                default: as in the constructor. A resistance is ignored if its standard deviation is not
                positive and finite.
            left_out: (U, K) bool, True for valid readings that the solve ignores. The noise estimate still
                uses them.

        Invalid resistances do not raise an exception. A wire that cannot be solved keeps its last trusted
        position, with an infinite standard deviation and the residual at that position; after the deadline,
        the residual is inf. A wire with fewer usable resistances than unknowns is NON_FINITE if any valid
        resistance is out of range, otherwise ILL_CONDITIONED. Raises ValueError if a shape is wrong.
        """
        start = perf_counter()
        arrays, self._all_valid = self.arrays, None
        # The kernel stores the addresses of these arrays, so they must be modified in place.
        arrays.ohm[:] = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
        arrays.noise[:] = (
            self._noise if relative_noise is None else broadcast_noise(relative_noise, self.layout)
        )
        arrays.valid[:] = True if valid is None else checked_mask(valid, self.layout)
        estimate = self._noise_estimate
        if estimate is not None:
            estimate.see(arrays.ohm, arrays.noise, valid=None if valid is None else arrays.valid)
            if estimate.factor != 1.0:
                arrays.noise *= estimate.factor
        if left_out is not None:
            arrays.valid[left_out] = False
        return self._advance(stage.SCALE, start)

    def update_codes(self, codes: NDArray[np.uint32]) -> FieldFrame:
        """Return the displacement field of a scan, given its codes (U, K); see :meth:`update`.

        Writes the resistances to :attr:`arrays` and the number of invalid codes to :attr:`invalid_codes`.
        Raises ValueError if ``codes`` has the wrong shape or is not uint32.
        """
        start = perf_counter()
        arrays, estimate, self._all_valid = self.arrays, self._noise_estimate, None
        arrays.codes[:] = checked_codes(codes, self.layout)
        if estimate is None:
            return self._advance(stage.DECODE | stage.SCALE, start)
        if estimate.factor != self._code_factor:
            self._code_factor = estimate.factor
            arrays.code_map[NOISE] = self._code_noise[0, 0] * estimate.factor
        field = self._advance(stage.DECODE | stage.SCALE, start)
        estimate.see(arrays.ohm, self._code_noise, arrays.rounding_ohm)  # takes effect in the next frame
        return field

    def update_again(self, left_out: NDArray[np.bool_]) -> FieldFrame:
        """Return the field of the last frame, solved again without the readings ``left_out`` (U, K)."""
        start = perf_counter()
        valid = self.arrays.valid
        if self._all_valid is None:
            self._all_valid = valid.copy()
        remaining = self._all_valid & ~left_out
        self.distrust(np.asarray((remaining != valid).any(axis=1)))
        valid[:] = remaining
        return self._advance(stage.SCALE, start)

    def _advance(self, stages: int, start: float) -> FieldFrame:
        """Run ``stages`` on the frame in :attr:`arrays`, solve the frame and return its field."""
        solver, arrays = self._stream.solver, self.arrays
        sigma, until, units = self._sigma, start + self._seconds, math.inf
        if self._leaves_out:
            sigma, _ = self._call_stages(stages, sigma, units)
            self._left_out.leave_out(sigma)
            stages = 0
        if until < math.inf:
            units = max(WIRE_UNITS, (until - perf_counter()) / UNIT_S)
        stages |= stage.CHOOSE
        if not self._active_only:  # all wires have the same number of unknowns
            stages |= stage.SOLVE | stage.ACCEPT | stage.STORE
        sigma, found = self._call_stages(stages, sigma, units)
        easy = found & stage.ALL_GOOD != 0
        if easy:
            if self._waiting:
                arrays.order[:], self._waiting = self._in_order, False
            residual = solver.measure[:, wires.RESIDUAL].copy()
        else:
            frame = Frame(sigma, arrays.order, until)
            if self._active_only:
                self._solve(frame)
            elif until < math.inf:
                self._solve_remaining(frame)
            residual = self._rescue(frame)
            _, found = self._call_stages(stage.STORE, sigma, math.inf)
        if found & stage.INCOMPLETE:
            self._complete()
        displacement, std = arrays.outcome_m.copy()
        evaluations, jacobians, steps = solver.tally.tolist()
        return FieldFrame(
            displacement_m=displacement,
            displacement_std_m=std,
            status=self._all_converged if easy else as_statuses(arrays.status.tolist()),
            residual=residual,
            stats=SolveStats(evaluations, jacobians, steps, perf_counter() - start),
            force_n=(
                self.untouched_force_n
                if self.stiffness_n_per_m is None
                else self.stiffness_n_per_m * displacement
            ),
            held=arrays.held.copy(),
            noise_factor=1.0 if self._noise_estimate is None else self._noise_estimate.factor,
        )

    def _call_stages(self, stages: int, sigma: float, units: float) -> tuple[float, int]:
        """Run ``stages`` with :meth:`PatchSolver.advance`; return σ and the flags that it returns."""
        sigma, invalid, found = self._stream.solver.advance(
            stages, self.arrays, self._stream.options, sigma, units
        )
        if stages & stage.DECODE:
            self.invalid_codes = invalid
        return sigma, found

    def _rescue(self, frame: Frame) -> Float:
        """Retry the wires without an acceptable root; return the residuals (U,).

        Updates ``good`` and ``status`` in :attr:`arrays`.
        """
        solver, arrays = self._stream.solver, self.arrays
        turns = solver.report[:, wires.TURN] == 1
        exhausted = np.zeros_like(turns)  # these wires have no attempts left
        if self._active_only:
            exhausted = self._left_out.widen(frame, turns)
        recover_lost(self._stream, frame, turns, exhausted)
        residual = solver.measure[:, wires.RESIDUAL].copy()
        for u in np.flatnonzero(~arrays.good).tolist():
            known = arrays.status[u] != DEADLINE and not frame.expired
            residual[u] = self._held_residual(u) if known else math.inf
        # The next frame starts with the unprocessed wires, in the same order.
        self._waiting = not turns.all()
        order = arrays.order
        order[:] = order[np.argsort(turns[order], kind="stable")] if self._waiting else self._in_order
        return residual

    def _complete(self) -> None:
        """Write to ``a_solved`` the values of ``a`` that each solution predicts for missing readings."""
        stream, arrays = self._stream, self.arrays
        solved = arrays.good & (stream.solver.report[:, wires.HELD] == 0)
        for u in np.flatnonzero(solved & (arrays.used == 0).any(axis=1)).tolist():
            missing = arrays.used[u] == 0
            arrays.a_solved[u, missing] = stream.a_at(arrays.x[u])[missing]

    def adopt(self, wires_: NDArray[np.bool_], displacement_m: Float) -> None:
        """Use the displacements (U, N, 3), in metres, as the last solutions of the wires in the mask (U,)."""
        stream, arrays = self._stream, self.arrays
        moved = (displacement_m / self.layout.pitch_m).reshape(arrays.x.shape)
        if self._active_only:  # solve for all electrodes of these wires again
            self._left_out.take_in(wires_)
        for u in np.flatnonzero(wires_).tolist():
            arrays.x[u] = stream.problem.rest[u] + moved[u]
            arrays.a_solved[u] = stream.a_at(arrays.x[u])
            arrays.predictable[u] = False

    def distrust(self, wires_: NDArray[np.bool_]) -> None:
        """Start the wires in the mask (U,) at rest in the next frame, regardless of this frame's outcome."""
        problem, arrays = self._stream.problem, self.arrays
        arrays.x[wires_], arrays.a_solved[wires_] = problem.rest[wires_], problem.a_rest[wires_]
        arrays.predictable[wires_] = False

    def _solve(self, frame: Frame) -> None:
        """Solve at least one wire, and more wires while time remains."""
        units = math.inf
        if frame.until < math.inf:
            units = max(WIRE_UNITS, (frame.until - perf_counter()) / UNIT_S)
        self._stream.solve(self.arrays.todo, frame, units=units)
        if units < math.inf:
            self._solve_remaining(frame)

    def _solve_remaining(self, frame: Frame) -> None:
        """Solve the unprocessed wires while time remains."""
        todo, report = self.arrays.todo, self._stream.solver.report
        while True:
            todo[report[:, wires.TURN] == 1] = wires.LEAVE
            if not todo.any() or frame.expired:
                return
            units = max(WIRE_UNITS, (frame.until - perf_counter()) / UNIT_S)
            self._stream.solve(todo, frame, units=units)

    def _held_residual(self, u: int) -> float:
        """Return the RMS residual of wire u at its last trusted position; inf if no resistance is usable."""
        arrays = self.arrays
        used = arrays.used[u] > 0
        if not used.any():
            return math.inf
        return float(np.sqrt(np.mean(self._stream.relative_residual(arrays.x[u], arrays.a[u])[used] ** 2)))
