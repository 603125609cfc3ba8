"""Fixed coordinates of the exact tracker: the ``normal_only`` and ``active_only`` options.

Both options reduce the number of unknowns. The coordinates that are not unknowns are fixed at rest.

``normal_only`` fixes the x and y coordinates of all electrodes.

``active_only`` fixes the electrodes not moved by a contact. At first, all electrodes of a wire are fixed.
While the χ² test rejects the fit, the fixed electrode that explains most of the residual becomes an unknown,
together with its neighbours. If more than half of the electrodes would become unknowns, all of them do. When
the rest position explains a frame again, all electrodes are fixed again.

The standard deviation of a fixed coordinate is the smallest movement that the χ² test would detect if no
other electrode moved. To first order at rest, this is √(quantile − degrees of freedom) σ / ‖c‖, where c is
the component of the coordinate's column of J that is orthogonal to the columns of the unknowns and to the
other columns of the same electrode.

Each option makes an assumption about the skin. If the assumption is violated, the standard deviations of the
unknowns are invalid. The χ² test reliably detects violations of active_only. It is less sensitive to
violations of normal_only, because smooth shear resembles a gradient of z. For example, on the staggered
layout (h = 0.5, noise 1e-5), the test rejected a strong Hertzian press whose shear was 30 % of its depth. It
accepted a weaker press, in which the errors in z reached 16 standard deviations (0.2 % of h).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.forward import jacobian
from skinnode.model.layout import Float
from skinnode.solve.exact.recover_lost_wires import recover
from skinnode.solve.exact.stream import TOLERANCE, Frame, StreamState
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators import codes as op
from skinnode.solve.roots import Z_REFUSE
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.hold import Z_HOLD, chi2_quantile
from skinnode.solve.wires.stages import DEADLINE, STALE

Z_WIDEN: Final = 3.719
"""Quantile of the standard normal distribution for the probability 1 − 1e-4.

If χ² exceeds its quantile for the same probability, a fixed electrode becomes an unknown. During a long press
at 100 frames/s, noise alone causes this about once every 100 s.
"""
TINY: Final = 1e-200
"""Lower limit on squared slopes used as divisors. The limit is below any real squared slope, but large enough
to prevent overflow."""


class LeftOut:
    """Fixed coordinates of a stream, and the smallest detectable movements of these coordinates.

    Args:
        stream: State of the stream.
        active_only: Whether to fix electrodes at rest unless a contact moves them.
    """

    def __init__(self, stream: StreamState, active_only: bool) -> None:
        problem = stream.problem
        self._layout = layout = problem.layout
        self._stream = stream
        self._active_only = active_only
        # ∂r/∂x at rest with respect to every coordinate, (U, 3N, K)
        slopes = jacobian(layout, layout.upper_m).reshape(*layout.shape, -1) * layout.pitch_m**2
        self._slopes = np.ascontiguousarray((slopes * problem.a_rest[:, :, None]).transpose(0, 2, 1))
        # (U, 3N) smallest detectable movement of each fixed coordinate, pitches per unit of σ, and (U, K)
        # weights of the readings for which it was computed
        self._unnoticed = np.zeros((layout.shape[0], layout.unknowns))
        self._unnoticed_weight = np.zeros(layout.shape)
        # limits on χ², indexed by degrees of freedom
        self._chi2_hold, self._chi2_widen, self._chi2_refuse = (
            np.array([chi2_quantile(max(dof, 1), z) for dof in range(layout.shape[1] + 1)])
            for z in (Z_HOLD, Z_WIDEN, Z_REFUSE)
        )

    def reset(self) -> None:
        """Discard the state of the stream; with ``active_only``, fix all electrodes."""
        self._unnoticed_weight[:] = 0.0
        if self._active_only:
            for u in range(self._layout.shape[0]):
                self._set_electrodes(u, np.arange(0))

    def take_in(self, wires_: NDArray[np.bool_]) -> None:
        """Make all electrodes of the given wires (mask of shape (U,)) unknowns."""
        for u in np.flatnonzero(wires_).tolist():
            self._set_electrodes(u, np.arange(self._layout.unknowns // 3))

    def leave_out(self, sigma: float) -> None:
        """Fix wires that are at rest to within the noise; write fixed coordinates' standard deviations."""
        solver, arrays = self._stream.solver, self._stream.arrays
        if self._active_only:
            a_rest = self._stream.problem.a_rest
            usable = np.where(arrays.used > 0, arrays.a, 1.0)
            square = (arrays.used * (usable / a_rest - 1.0)) ** 2
            chi2 = square.sum(axis=1) / (sigma**2 + TOLERANCE**2)
            count = np.count_nonzero(arrays.used, axis=1)
            known = (chi2 <= self._chi2_hold[count]) & (count >= solver.each * self._layout.unknowns // 3)
            for u in np.flatnonzero(known & (solver.free > 0)).tolist():
                self._set_electrodes(u, np.arange(0))
                self._unnoticed_weight[u] = 0.0  # recomputed below
        arrays.unknowns[:] = self._stream.unknowns
        if solver.each * solver.free.min() < self._layout.unknowns:
            for u in np.flatnonzero(_changed(arrays.used, self._unnoticed_weight)).tolist():
                self._measure_unnoticed(u, arrays.used[u])
            solver.still_std[:] = sigma * self._unnoticed

    def widen(self, frame: Frame, turns: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Add unknowns to processed wires whose residual exceeds the noise; return their mask (U,).

        Args:
            frame: The current frame.
            turns: (U,) mask of the processed wires; set to False for wires that the deadline interrupts.
        """
        unexplained = turns & ~self._explained()
        for u in [u for u in frame.order.tolist() if unexplained[u]]:
            turns[u] = not frame.expired
            self._widen(u, frame)
        return unexplained

    def _set_electrodes(self, u: int, electrodes: Index) -> None:
        """Make the given electrodes of wire u its unknowns and fix its other electrodes."""
        solver, arrays, problem = self._stream.solver, self._stream.arrays, self._stream.problem
        solver.set_electrodes(u, electrodes)
        arrays.predictable[u] = len(electrodes) == 0
        if arrays.predictable[u]:  # a wire without unknowns is fixed at its rest position
            arrays.x[u], arrays.a_solved[u] = problem.rest[u], problem.a_rest[u]
            solver.a_solved[u], solver.noise[u] = arrays.a_solved[u], 0.0

    def _measure_unnoticed(self, u: int, weight: Float) -> None:
        """Compute the smallest detectable movement of each fixed coordinate of wire u, per unit of σ."""
        solver, (_, lower) = self._stream.solver, self._layout.shape
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
                power = np.maximum(power, op.EPS * power[:, -1:] + TINY)  # smaller values are rounding errors
                unnoticed[group, :most] = least * np.sqrt((direction**2 / power[:, None]).sum(axis=2))

    def _explained(self) -> NDArray[np.bool_]:
        """Return a mask (U,) of the wires that have a root within the noise or have no fixed electrode."""
        solver = self._stream.solver
        spare = solver.report[:, wires.SPARE]
        limit = np.where(solver.free > 0, self._chi2_widen[spare], self._chi2_hold[spare])
        content = (solver.report[:, wires.HELD] == 1) | (solver.measure[:, wires.CHI2] <= limit)
        whole = 3 * solver.free == self._layout.unknowns
        return np.asarray(whole | (self._stream.roots() & content))

    def _widen(self, u: int, frame: Frame) -> None:
        """Add unknowns to wire u until its residual is within the noise; remove them if it has no root."""
        stream, solver, most = self._stream, self._stream.solver, self._layout.unknowns // 3
        before = solver.electrodes(u).copy()
        while stream.solvable()[u] and not self._explained()[u]:
            if frame.expired:
                solver.report[u, wires.STATUS] = DEADLINE
                break
            electrodes = np.arange(most)
            near = not stream.problem.out_of_reach(solver.x)[u]
            # The solve found a minimum, but its χ² is too large.
            if near and solver.measure[u, wires.CHI2] < np.inf:
                joined = np.union1d(solver.electrodes(u), self._most_explaining(u))
                electrodes = electrodes if 2 * len(joined) > most else joined
            self._set_electrodes(u, electrodes)
            solver.x[u] = stream.arrays.x[u]
            stream.solve(stream.only(u), frame)
            if len(electrodes) == most and not stream.roots()[u] and stream.solvable()[u]:
                recover(stream, u, frame)
        if len(solver.electrodes(u)) > len(before) and not stream.roots()[u]:
            self._set_electrodes(u, before)
        if len(solver.electrodes(u)) > len(before):
            self._measure_unnoticed(u, stream.arrays.used[u])
            left_out = self._unnoticed[u] > 0
            solver.std[u, left_out] = frame.sigma * self._unnoticed[u, left_out]

    def _most_explaining(self, u: int) -> Index:
        """Return the fixed electrode that explains most of the residual of wire u, with its neighbours."""
        solver, arrays = self._stream.solver, self._stream.arrays
        each, (_, lower), most = solver.each, self._layout.shape, self._layout.unknowns // 3
        slopes = (self._slopes[u] * arrays.used[u]).reshape(most, 3, lower)[:, 3 - each :]
        moving = solver.electrodes(u)
        rest = np.setdiff1d(np.arange(most), moving)
        outside = _outside(slopes[rest].reshape(-1, lower), slopes[moving].reshape(each * len(moving), lower))
        directions = np.linalg.qr(outside.reshape(-1, each, lower).transpose(0, 2, 1))[0]
        residual = arrays.used[u] * self._stream.relative_residual(solver.x[u], arrays.a[u])
        explained = ((directions * residual[:, None]).sum(axis=1) ** 2).sum(axis=1)
        best = int(rest[np.argmax(explained)])
        return np.arange(max(best - 1, 0), min(best + 2, most))


def _changed(weight: Float, before: Float) -> NDArray[np.bool_]:
    """Return a mask (U,) of the wires with a weight that changed by more than a factor of ``STALE``."""
    return np.asarray(((weight > STALE * before) | (before > STALE * weight)).any(axis=1))


def _outside(rows: Float, others: Float) -> Float:
    """Return ``rows`` (n, K) minus their projection onto the span of the rows ``others`` (m, K)."""
    q = np.linalg.qr(others.T)[0]
    return np.asarray(rows - (rows @ q) @ q.T)
