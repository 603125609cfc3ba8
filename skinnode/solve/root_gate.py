"""Checks the roots found by the exact inverse; the posterior confirms, replaces or rejects them.

A root is doubtful in three cases: an electrode moved too far since the previous frame, the displacement is
too rough for a press, or a press can move the wire across a fold, where two roots of F = b merge. Near a
fold, the exact inverse cannot tell which of two roots is correct. A wire without a root is also doubtful. The
posterior, which estimates the positions from all wires of the patch, decides on each doubtful root.
:mod:`skinnode.solve.roots` defines the thresholds.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve import roots
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.options import TrackerOptions
from skinnode.solve.posterior.frame_estimator import FrameEstimator
from skinnode.solve.smoothness import Smoothness
from skinnode.solve.wires.problem import PatchProblem
from skinnode.solve.wires.root_check import SOME_ROUGH, SOME_SUSPECT, RootCheck, check_roots

PAUSE: Final = 16
"""Number of frames until the next posterior solve, after a posterior solve that missed its deadline.

Without this pause, a posterior that misses every deadline would delay the other patches on the same thread by
2 ms per frame.
"""
APART: Final = 3.0
"""Factor applied to the distance between a confirmed root and the posterior estimate, for wires that a press
can move across a fold.

The product is added in quadrature to the standard deviation of the root, because the posterior cannot
distinguish two roots that are very close to each other.
"""
NEAR_FOLD: Final = 2.0
"""Factor applied to the standard deviation of a posterior estimate that replaces a root, for wires that a
press can move across a fold."""

Mask = NDArray[np.bool_]


class RootGate:
    """Checks the fields of an exact tracker against the posterior estimate of the same patch.

    Each exact tracker needs its own gate.

    Args:
        exact: Tracker whose fields are checked.
        posterior: Posterior estimator of the same patch.
        options: Options of the exact tracker and of the posterior estimator.
    """

    def __init__(self, exact: ExactTracker, posterior: FrameEstimator, options: TrackerOptions) -> None:
        layout = exact.layout
        problem = PatchProblem.of(layout, options.baseline_ohm)
        self._exact, self._posterior = exact, posterior
        self._seconds = options.deadline_s
        clearance_m = float(problem.clearance.min()) * layout.pitch_m
        self._last_m = np.zeros_like(layout.upper_m)
        self._lost, self._unsure, self._rough = np.zeros((3, layout.shape[0]), np.bool_)
        self._pause = 0  # frames left until the next posterior solve
        self.hurried = False
        """Whether the last call to :meth:`check` had too little time to check all doubtful roots."""
        self._confirmed: Float | None = None  # each wire's last displacement confirmed by the posterior, in m
        self._apart = np.zeros((len(problem.rest), 1, 1))  # added to the standard deviation, in m; see APART
        self._any_apart = False
        self._blind = roots.blind_wires(layout, options.normal_only)
        self._options = options
        self._folded = self._folded_with(1.0)
        its = exact.arrays
        whitening = np.array(Smoothness(problem).whitening, order="C")
        self._root_check = RootCheck(
            moved_m=its.outcome_m[0],
            last_m=self._last_m,
            status=its.status,
            held=its.held,
            folded=self._folded.copy(),
            whitening=whitening,
            lost=self._lost,
            unsure=self._unsure,
            rough=self._rough,
            jump_m=roots.JUMP * clearance_m,
            far_m=roots.LARGE * clearance_m,
            pitch_m=layout.pitch_m,
            rough_limit=roots.ROUGH_IN_STREAM / problem.step_limit,
        )
        self._doubtful()  # compiles the kernel before a stream starts

    def _folded_with(self, noise_factor: float) -> Mask:
        """Return a mask (U,) of the wires to check in every frame.

        Args:
            noise_factor: Ratio of the actual to the stated noise.
        """
        layout, normal_only = self._exact.layout, self._options.normal_only
        noise = np.multiply(noise_factor, self._options.relative_noise)
        if roots.nonlinear_in_noise(layout, noise, normal_only):
            return np.ones(layout.shape[0], np.bool_)
        return roots.folded_wires(layout, normal_only)

    def set_noise(self, factor: float) -> None:
        """Set the factor that scales the stated noise; it takes effect in the next frame."""
        self._folded[:] = self._folded_with(factor)
        self._root_check.folded[:] = self._folded

    def reset(self) -> None:
        """Discard the state of the stream."""
        self._confirmed = None
        self._apart[:], self._any_apart = 0.0, False
        self._last_m[:] = 0.0
        self._pause = 0

    def check(self, field: FieldFrame, start: float, *, again: bool = False) -> FieldFrame:
        """Return the field with the root of each doubtful wire confirmed, replaced or rejected.

        Args:
            field: Field of the exact tracker.
            start: Start time of the tracker's update, in s, on the clock
                :func:`skinnode.process.clock.perf_counter`.
            again: True if this frame has already been checked and was then solved again without some
                readings.
        """
        doubtful: Mask | None = None
        self.hurried = False
        if self._doubtful():
            doubtful = self._lost | self._unsure
            until, anew = start + self._seconds, bool(self._unsure.any())
            if self._pause or (anew and perf_counter() + self._posterior.from_rest_s > until):
                field, self.hurried = self._give_up(field, doubtful), True
            else:
                if anew:
                    self._posterior.reset()  # the last estimate may belong to a wrong root
                its = self._exact.arrays
                self._posterior.stop_at(until)
                # Noise that is not positive marks unusable resistances and stays unchanged.
                noise = np.where(its.noise > 0.0, np.maximum(its.noise, roots.REFEREE_NOISE), its.noise)
                estimate = self._posterior.estimate(its.ohm.copy(), its.valid.copy(), noise)
                if Status.DEADLINE in estimate.status:
                    self._pause, self.hurried = PAUSE, True
                field = self._select(field, doubtful, estimate)
        if not again:
            self._pause = max(0, self._pause - 1)
        if self._any_apart:
            every = np.ones(len(self._apart), np.bool_)
            field = self._keep_apart(field, every if doubtful is None else ~doubtful)
        self._last_m[:] = field.displacement_m
        return field

    def _doubtful(self) -> bool:
        """Find the wires that have a doubtful root or no root; return whether there are any."""
        found = check_roots(self._root_check.table)
        if found & SOME_ROUGH:
            if self._confirmed is not None:
                self._rough &= ~roots.still_confirmed(self._exact.arrays.outcome_m[0], self._confirmed)
            self._unsure |= self._rough
        return found & SOME_SUSPECT != 0 or bool(found & SOME_ROUGH and self._rough.any())

    def _keep_apart(self, field: FieldFrame, unasked: Mask) -> FieldFrame:
        """Enlarge the standard deviations of held wires by the terms found when their roots were confirmed.

        Args:
            field: Field to amend.
            unasked: (U,) mask of the wires that were not checked in this frame.
        """
        if field.held is None:
            return field
        self._apart[unasked & ~field.held] = 0.0
        apart_now = self._apart[:, 0, 0] > 0.0
        self._any_apart = bool(apart_now.any())
        still = unasked & field.held & apart_now
        if not still.any():
            return field
        apart = np.where(still[:, None, None], self._apart, 0.0)
        core = field.core_std_m
        return dataclasses.replace(
            field,
            displacement_std_m=np.hypot(field.displacement_std_m, apart),
            core_std_m=None if core is None else np.hypot(core, apart),
        )

    def _give_up(self, field: FieldFrame, doubtful: Mask) -> FieldFrame:
        """Reject all doubtful roots, because there is no time for a posterior solve."""
        std = field.displacement_std_m.copy()
        std[doubtful] = np.inf
        self._apart[doubtful] = 0.0
        self._exact.distrust(doubtful)
        return dataclasses.replace(
            field,
            displacement_std_m=std,
            core_std_m=std,
            status=_selected(field.status, doubtful, np.zeros_like(doubtful)),
            by_prior=np.zeros_like(doubtful),
        )

    def _select(self, field: FieldFrame, doubtful: Mask, estimate: FieldFrame) -> FieldFrame:
        """Confirm, replace or reject the doubtful roots, given the posterior estimate."""
        known = np.array(estimate.status) == Status.CONVERGED
        converged = np.array(field.status) == Status.CONVERGED
        spread = np.hypot(field.displacement_std_m, estimate.displacement_std_m)
        gap = np.abs(field.displacement_m - estimate.displacement_m)
        asked = ~self._blind & doubtful & known
        agreed = asked & converged & roots.agrees(gap, roots.AGREE * spread)
        if agreed.any():
            if self._confirmed is None:
                self._confirmed = np.full_like(field.displacement_m, np.inf)
            self._confirmed[agreed] = field.displacement_m[agreed]
        replaced = asked & ~agreed
        refused = doubtful & ~agreed & ~replaced
        moved, residual = field.displacement_m.copy(), field.residual.copy()
        moved[replaced], residual[replaced] = estimate.displacement_m[replaced], estimate.residual[replaced]
        apart = APART * gap.max(axis=(1, 2), keepdims=True)

        def widened(own: Float, posterior: Float) -> Float:
            std = np.where(replaced[:, None, None], posterior, own)
            std[refused] = np.inf
            if self._folded.any():
                std[replaced & self._folded] *= NEAR_FOLD
                std = np.where((agreed & self._folded)[:, None, None], np.hypot(std, apart), std)
            return std

        self._apart[doubtful] = 0.0
        self._apart[agreed & self._folded] = apart[agreed & self._folded]
        self._any_apart = True  # updated by the next call to _keep_apart

        assert estimate.core_std_m is not None
        self._exact.adopt(replaced, moved)
        self._exact.distrust(refused)
        force = field.force_n
        if force is not None and self._exact.stiffness_n_per_m is not None:
            force = self._exact.stiffness_n_per_m * moved
        own, other = field.stats, estimate.stats
        return dataclasses.replace(
            field,
            displacement_m=moved,
            displacement_std_m=widened(field.displacement_std_m, estimate.displacement_std_m),
            core_std_m=widened(field.displacement_std_m, estimate.core_std_m),
            status=_selected(field.status, doubtful & ~agreed, replaced),
            residual=residual,
            stats=dataclasses.replace(
                own,
                evaluations=own.evaluations + other.evaluations,
                jacobians=own.jacobians + other.jacobians,
                steps=own.steps + other.steps,
                time_s=own.time_s + other.time_s,
            ),
            force_n=force,
            by_prior=replaced,
            data_share=_mixed_share(estimate, replaced),
        )


def _mixed_share(estimate: FieldFrame, replaced: Mask) -> Float | None:
    """Return the data share: the value in ``estimate`` for the ``replaced`` wires (U,), 1 for all others."""
    if estimate.data_share is None or not replaced.any():
        return None
    return np.where(replaced[:, None, None], estimate.data_share, 1.0)


def _selected(status: tuple[Status, ...], changed: Mask, replaced: Mask) -> tuple[Status, ...]:
    """Return the statuses after the roots of the ``changed`` wires (U,) were replaced or rejected."""
    found = list(status)
    for u in np.flatnonzero(changed).tolist():
        if replaced[u]:
            found[u] = Status.CONVERGED
        elif found[u] is Status.CONVERGED:
            found[u] = Status.ILL_CONDITIONED
    return tuple(found)
