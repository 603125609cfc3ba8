"""The path of the paper run for ever: a live stream of frames, each solved from the one before.

predict    x + (∂x/∂R) ΔR with the J⁻¹ of the last frame, which its covariance needed anyway
correct    the operator, to a tolerance far below any noise
bridge     a wire that fails: its R interpolated from the last trusted frame to the new one
restart    the same from the rest position
hold       a wire that still fails keeps its last trusted position, with an infinite deviation and a status

A root counts only on the branch the skin can reach: the determinant of J keeps the sign it has at rest, and
no electrode moves farther than its clearance from the lower layer.
"""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status
from skinnode.solve import operators as op
from skinnode.solve import wires
from skinnode.solve.problem import PatchProblem
from skinnode.solve.system import operator_code

TOLERANCE: Final = 1e-9
"""Of r and, in pitches, of x: four orders below a 24-bit converter, and one Newton step from 1e-5."""
BRIDGE_TOLERANCE: Final = 1e-6
"""Of the substeps of a bridge, the paper's intermediate tolerance."""
FRAME_STEPS: Final = 12
"""Most steps of a solve: quadratic convergence from within the trust region takes 3 to 6."""
BRIDGES: Final = (3, 5, 10)
"""Substeps of the bridges tried in turn. On staggered, h = 0.5, from rest: 3 bring every wire through
a 50 % press between two frames, 5 all but one of 24 through 70 %. Steps halved and doubled, and held to the
trusted branch, do worse: the straight line crosses singular points that the press does not."""
BRIDGE_STEPS: Final = 20
"""Most steps of a substep."""
RECOVERY_STEPS: Final = 300
"""Most steps all bridges of a frame may take together, about 15 ms: a broken frame must
not stop the stream."""


class ExactTracker:
    """Follows one patch by the exact inverse of each wire, frame by frame.

    One owner; the compiled part holds no GIL.

    Args:
        layout: the patch, K ≥ 3N.
        operator: ``levenberg_marquardt``, ``dogleg`` or ``gauss_newton``.
        relative_noise: standard deviation of R relative to R, a number or (U, K).
        baseline_ohm: (U, K) resistances measured at rest; the resistivity and the gain then cancel.
        stiffness_n_per_m: k of the paper's law F = k Δs; forces are given where it is.

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
    ) -> None:
        if stiffness_n_per_m is not None and not (math.isfinite(stiffness_n_per_m) and stiffness_n_per_m > 0):
            raise ValueError(f"stiffness_n_per_m: got {stiffness_n_per_m}, must be positive and finite")
        if layout.shape[1] < layout.unknowns:
            raise ValueError(
                f"layout: got {layout.shape[1]} lower wires for {layout.unknowns} unknowns an upper wire, "
                "must be at least as many"
            )
        self.layout = layout
        self._problem = PatchProblem.of(layout, baseline_ohm)
        self._stiffness = stiffness_n_per_m
        self._noise, self._sigma = self._checked_noise(relative_noise)
        self._tall = layout.shape[1] > layout.unknowns
        self._evaluations = self._steps = 0  # of the frame at hand
        self._solver = wires.Solver(self._problem, operator_code(operator))
        self._rest_branch = self._solver.solve_rest()
        self._rest_known = self._solver.report[:, wires.STATUS] == op.CONVERGED
        self._rest_inverse = self._solver.inverse.copy()
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        self._x = self._problem.rest.copy()  # last trusted position of each wire, and its a
        self._a = self._problem.a_rest.copy()
        self._solver.inverse[:] = self._rest_inverse
        self._solver.a_solved[:] = self._a
        self._weight = np.ones(self.layout.shape)
        self._predictable = self._rest_known.copy()  # wires whose inverse in the solver belongs to their x

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """The displacement field of one frame.

        Args:
            frame_ohm: (U, K) resistances; whatever is not positive and finite is not used.
            valid: (U, K) bool, False where a chunk or wire is missing; default all.
            relative_noise: as in the constructor, of this frame only.

        Never raises for numbers. A wire with fewer usable resistances than unknowns is ILL_CONDITIONED, or
        NON_FINITE where resistances not marked as missing were unusable. Such a wire, and one that no solve
        brings to a root, holds its last trusted position with an infinite deviation. Raises ValueError for
        wrong shapes.
        """
        start = time.perf_counter()
        frame = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
        noise, sigma = (
            (self._noise, self._sigma) if relative_noise is None else self._checked_noise(relative_noise)
        )
        weight = sigma / noise
        if valid is not None:
            weight *= self._checked_mask(valid)
        with np.errstate(over="ignore", invalid="ignore"):
            a = frame * self._problem.gain
        solver = self._solver
        solver.x[:] = self._x
        todo = np.where(self._predictable, wires.PREDICT, wires.SOLVE).astype(np.uint8)
        if self._tall and not np.array_equal(weight, self._weight):
            todo[:] = wires.SOLVE  # J⁺ was made for other weights: what it trusted may be noise by now
        self._weight = weight.copy()
        solver.solve(todo, a, weight, wires.COVARIANCE, TOLERANCE, TOLERANCE, FRAME_STEPS, sigma)
        self._evaluations, self._steps = solver.cost
        status = solver.report[:, wires.STATUS].copy()
        good = self._reached()
        if not good.all():
            status[(status == op.CONVERGED) & ~good] = op.ILL_CONDITIONED
            solvable = np.count_nonzero(weight, axis=1) >= self.layout.unknowns
            for u in np.flatnonzero(~good & solvable).tolist():
                good[u] = self._recover(u, a, weight, sigma)
                ended = int(solver.report[u, wires.STATUS])
                status[u] = op.ILL_CONDITIONED if ended == op.CONVERGED and not good[u] else ended
            solver.std[~good] = np.inf
            self._predictable &= ~solvable  # what was not tried keeps its inverse
        residual = solver.measure[:, wires.RESIDUAL].copy()
        for u in np.flatnonzero(~good).tolist():
            residual[u] = self._held_residual(u, a, weight)
        self._x[good] = solver.x[good]
        self._a[good] = solver.a_solved[good]
        self._predictable |= good
        displacement = self._problem.displacement_m(self._x)
        return FieldFrame(
            displacement_m=displacement,
            displacement_std_m=(solver.std * self.layout.pitch_m).reshape(displacement.shape),
            status=tuple(map(Status, status.tolist())),
            residual=residual,
            stats=SolveStats(self._evaluations, self._evaluations, self._steps, time.perf_counter() - start),
            force_n=None if self._stiffness is None else self._stiffness * displacement,
        )

    def _reached(self) -> NDArray[np.bool_]:
        """(U,) wires the solver brought to a root on the branch of the rest position."""
        report = self._solver.report
        on_branch = report[:, wires.BRANCH] * self._rest_branch >= 0
        reached = (report[:, wires.STATUS] == op.CONVERGED) & on_branch
        return np.asarray(reached & ~self._problem.out_of_reach(self._solver.x))

    def _recover(self, u: int, a: Float, weight: Float, sigma: float) -> bool:
        """Bridge wire u from its last trusted position, then from rest; whether that brought it to a root."""
        starts = [(self._x[u].copy(), self._a[u].copy())]
        rest = self._problem.rest[u], self._problem.a_rest[u]
        if not np.array_equal(starts[0][0], rest[0]):
            starts.append(rest)
        for substeps in BRIDGES:
            for x_from, a_from in starts:
                if self._steps >= RECOVERY_STEPS:
                    return False
                self._bridge(u, x_from, a_from, a, weight, sigma, substeps)
                if self._reached()[u]:
                    return True
        return False

    def _bridge(
        self, u: int, x_from: Float, a_from: Float, a: Float, weight: Float, sigma: float, substeps: int
    ) -> None:
        """Solve wire u along the straight line of its resistances from ``a_from`` to ``a``.

        Only the last point counts: the line is no deformation of rubber, so the points between may lie on any
        branch. The outcome is the solver's report of the wire.
        """
        solver = self._solver
        todo = np.zeros(self.layout.shape[0], np.uint8)
        todo[u] = wires.SOLVE
        between = a.copy()
        solver.x[u] = x_from
        for part in range(1, substeps + 1):
            last = part == substeps
            between[u] = a[u] if last else a_from + part / substeps * (a[u] - a_from)
            tolerance = TOLERANCE if last else BRIDGE_TOLERANCE
            tasks = wires.COVARIANCE if last else 0
            method = op.LEVENBERG_MARQUARDT  # the sturdiest across a gap, whatever follows the stream
            solver.solve(todo, between, weight, tasks, tolerance, tolerance, BRIDGE_STEPS, sigma, method)
            self._evaluations += int(solver.report[u, wires.EVALUATIONS])
            self._steps += int(solver.report[u, wires.STEPS])

    def _held_residual(self, u: int, a: Float, weight: Float) -> float:
        """RMS of F/b − 1 of wire u at its held position over the usable resistances; inf if there is none."""
        used = weight[u] > 0
        if not used.any():
            return math.inf
        gaps = self._x[u].reshape(-1, 1, 3, 1) - self._problem.lower.transpose(1, 0, 2)[None]
        potential = (1.0 / np.sqrt((gaps**2).sum(axis=2))).sum(axis=(0, 1))
        return float(np.sqrt(np.mean((a[u, used] * potential[used] - 1.0) ** 2)))

    def _checked_noise(self, relative_noise: ArrayLike) -> tuple[Float, float]:
        """(U, K) deviations and the smallest of them."""
        try:
            noise = np.broadcast_to(np.asarray(relative_noise, np.float64), self.layout.shape)
        except (TypeError, ValueError) as error:
            got = f"got shape {np.shape(relative_noise)}" if np.ndim(relative_noise) else f"{error}"
            raise ValueError(f"relative_noise: {got}, must be a number or {self.layout.shape}") from None
        if not ((noise > 0) & (noise < np.inf)).all():
            worst = noise[~((noise > 0) & (noise < np.inf))][0]
            raise ValueError(f"relative_noise: got {worst}, must be positive and finite everywhere")
        return noise, float(noise.min())

    def _checked_mask(self, valid: ArrayLike) -> NDArray[np.bool_]:
        mask = np.asarray(valid)
        if mask.dtype != np.bool_ or mask.shape != self.layout.shape:
            got = f"{mask.dtype} of shape {mask.shape}"
            raise ValueError(f"valid: got {got}, must be bool of shape {self.layout.shape}")
        return mask
