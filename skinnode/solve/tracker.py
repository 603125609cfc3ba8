"""The tracker of a live stream: one frame in, one field out, by the method that suits the patch.

``exact`` inverts each wire on its own, as the paper does; ``posterior`` estimates the whole patch with its
elastic prior. ``auto`` takes the exact inverse where the converter's noise leaves it accurate.

What the exact inverse cannot solve (too few resistances, a root on another branch, a jump too far), and a
large displacement too rough for a press, is put to the posterior, which knows the neighbouring wires. Where
a layout has folds within the reach of a press, every frame is: F = b then has roots nearby that the inverse
alone cannot tell apart.
"""

from __future__ import annotations

import dataclasses
import math
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.elastic import Rubber
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve import roots
from skinnode.solve.cramer_rao import patch_std
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.inputs import CodeMap
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.smoothness import Smoothness
from skinnode.solve.wires.problem import PatchProblem
from skinnode.solve.wires.root_check import SOME_ROUGH, SOME_SUSPECT, RootCheck, check_roots

METHODS: Final = ("auto", "exact", "posterior")
EXACT_STD: Final = 0.0025
"""Deviation of the exact inverse at rest, in clearances, up to which ``auto`` takes it: 2.5 % of a press of a
tenth of the layer. 16-bit codes leave 0.0005 on staggered, h = 0.5, and 0.05 on aligned."""
PAUSE: Final = 16
"""Frames in which the posterior is not asked again, after it did not answer by the deadline: to ask in vain
with every frame takes 2 ms of the time of patches that wait for the same thread."""


class Tracker:
    """Follows one patch, frame by frame. One owner; the compiled part holds no GIL.

    Args:
        layout: the patch.
        method: ``exact``, ``posterior`` or ``auto``; :attr:`method` and :attr:`reason` say what came of it.
        operator, stiffness_n_per_m, active_only: see :class:`ExactTracker`; of no use to the posterior, whose
            forces come from ``rubber``.
        relative_noise, baseline_ohm, hold, normal_only: see either.
        deadline_us: an update returns after this time and at most one more step. What got no turn is
            DEADLINE, holds its last trusted position and has an infinite deviation.
        rubber, estimate_noise, drift, drift_std, model_error: see :class:`Posterior`. ``auto`` takes it where
            one of the last four asks for what only the posterior can give.
        codes: what the codes given to :meth:`update_codes` mean.

    Compiles its kernels on construction. Raises ValueError for arguments of the wrong shape or range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        *,
        method: str = "auto",
        operator: str = "levenberg_marquardt",
        relative_noise: ArrayLike = 1e-5,
        baseline_ohm: ArrayLike | None = None,
        stiffness_n_per_m: float | None = None,
        hold: bool = True,
        deadline_us: float | None = None,
        normal_only: bool = False,
        active_only: bool = False,
        rubber: Rubber | None = None,
        estimate_noise: bool = False,
        drift: str = "none",
        drift_std: float = 0.02,
        model_error: float = 0.0,
        codes: CodeMap | None = None,
    ) -> None:
        if method not in METHODS:
            raise ValueError(f"method: got {method!r}, must be one of {', '.join(METHODS)}")
        self.layout = layout
        self._posterior = Posterior(
            layout,
            relative_noise=relative_noise,
            baseline_ohm=baseline_ohm,
            rubber=rubber,
            estimate_noise=estimate_noise,
            drift=drift,
            drift_std=drift_std,
            model_error=model_error,
            normal_only=normal_only,
            hold=hold,
            deadline_us=deadline_us,
        )
        nuisances = [name for name, asked in (("drift", drift != "none"), ("model_error", model_error > 0),
                                              ("estimate_noise", estimate_noise)) if asked]  # fmt: skip
        self.method, self.reason = _choose(layout, method, relative_noise, normal_only, nuisances)
        self._knows_codes = codes is not None
        if self.method == "posterior":
            self._exact = None
            return
        self._noise = relative_noise
        self._seconds = math.inf if deadline_us is None else deadline_us * 1e-6
        self._exact = ExactTracker(
            layout,
            operator=operator,
            relative_noise=relative_noise,
            baseline_ohm=baseline_ohm,
            stiffness_n_per_m=stiffness_n_per_m,
            hold=hold,
            deadline_us=deadline_us,
            normal_only=normal_only,
            active_only=active_only,
            codes=codes,
        )
        problem = PatchProblem.of(layout, baseline_ohm)
        clearance_m = float(problem.clearance.min()) * layout.pitch_m
        self._last_m = np.zeros_like(layout.upper_m)
        self._lost, self._unsure, self._rough = np.zeros((3, layout.shape[0]), np.bool_)
        self._pause = 0  # frames until the posterior is asked again
        self._confirmed: Float | None = None  # displacement at which a rough wire was last confirmed
        self._apart = np.zeros((len(problem.rest), 1, 1))  # what its confirmation left open of a wire
        self._any_apart = False
        self._blind = roots.blind_wires(layout, normal_only)
        rough_noise = roots.nonlinear_in_noise(layout, relative_noise, normal_only)
        self._folded = roots.folded_wires(layout, normal_only) | rough_noise
        its = self._exact.arrays
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
        self._doubtful()  # compiles it
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        self._posterior.reset()
        if self._exact is not None:
            self._exact.reset()
            self._confirmed = None
            self._apart[:], self._any_apart = 0.0, False
            self._last_m[:] = 0.0
            self._pause = 0

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """The displacement field of one frame.

        Args:
            frame_ohm: (U, K) resistances; whatever is not positive and finite is not used.
            valid: (U, K) bool, False where a chunk or wire is missing; default all.
            relative_noise: as in the constructor, of this frame only; what is not positive and finite makes
                its resistance unused.

        Never raises for numbers: what could not be solved holds its last trusted position, with an infinite
        deviation and a status. Raises ValueError for wrong shapes.
        """
        if self._exact is None:
            return self._posterior.update(frame_ohm, valid, relative_noise)
        start = perf_counter()
        return self._judged(self._exact.update(frame_ohm, valid, relative_noise), start)

    def update_codes(self, codes: NDArray[np.uint32]) -> tuple[FieldFrame, int]:
        """The field of a scan of (U, K) codes, as :meth:`update` makes it of the resistances and the noise
        that they stand for, in a fraction of the time; and how many of them were no measurement. Raises
        ValueError for another shape, numbers that are no uint32, a tracker that was not told what codes mean
        and one whose :attr:`method` is ``posterior``."""
        if self._exact is None or not self._knows_codes:
            lacks = "codes: got none" if self._exact is not None else "method: got 'posterior'"
            raise ValueError(f"{lacks}, must be exact and told what codes mean, to take some")
        start = perf_counter()
        field = self._judged(self._exact.update_codes(codes), start)
        return field, self._exact.invalid_codes

    def _judged(self, field: FieldFrame, start: float) -> FieldFrame:
        """The field of the exact inverse after a look at every wire that may be wrong."""
        assert self._exact is not None
        doubtful: NDArray[np.bool_] | None = None
        if self._doubtful():
            doubtful = self._lost | self._unsure
            until, anew = start + self._seconds, bool(self._unsure.any())
            if self._pause or (anew and perf_counter() + self._posterior.from_rest_s > until):
                field = self._give_up(field, doubtful)
            else:
                if anew:
                    self._posterior.reset()  # annealed anew: what follows a wrong root would confirm it
                its = self._exact.arrays
                self._posterior.stop_at(until)
                noise = np.maximum(its.noise, roots.REFEREE_NOISE)
                guide = self._posterior.update(its.ohm.copy(), its.valid.copy(), noise)
                if Status.DEADLINE in guide.status:
                    self._pause = PAUSE
                field = self._refer(field, doubtful, guide)
        self._pause = max(0, self._pause - 1)
        if self._any_apart:
            field = self._keep_apart(
                field, np.ones(len(self._apart), np.bool_) if doubtful is None else ~doubtful
            )
        self._last_m[:] = field.displacement_m
        return field

    def _doubtful(self) -> bool:
        """Whether there is any wire without a root (``_lost``), or one whose root may not be the right one
        (``_unsure``): where the layout has folds all that were solved, elsewhere those that jumped and the
        rough ones."""
        assert self._exact is not None
        found = check_roots(self._root_check.table)
        if found & SOME_ROUGH:
            if self._confirmed is not None:  # what was confirmed a moment ago is not asked again
                self._rough &= ~roots.still_confirmed(self._exact.arrays.outcome_m[0], self._confirmed)
            self._unsure |= self._rough
        return found & SOME_SUSPECT != 0 or bool(found & SOME_ROUGH and self._rough.any())

    def _keep_apart(self, field: FieldFrame, unasked: NDArray[np.bool_]) -> FieldFrame:
        """A wire that is held is no better known than when the posterior confirmed it."""
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

    def _give_up(self, field: FieldFrame, doubtful: NDArray[np.bool_]) -> FieldFrame:
        """The field where nobody is asked about the doubtful wires, for want of time."""
        assert self._exact is not None
        status = list(field.status)
        for u in np.flatnonzero(doubtful).tolist():
            if status[u] is Status.CONVERGED:
                status[u] = Status.ILL_CONDITIONED
        std = field.displacement_std_m.copy()
        std[doubtful] = np.inf
        self._apart[doubtful] = 0.0
        self._exact.distrust(doubtful)
        return dataclasses.replace(
            field,
            displacement_std_m=std,
            core_std_m=std,
            status=tuple(status),
            by_prior=np.zeros_like(doubtful),
        )

    def _refer(self, field: FieldFrame, doubtful: NDArray[np.bool_], guide: FieldFrame) -> FieldFrame:
        """The field with the posterior's word on the doubtful wires: confirmed, replaced, or given up."""
        assert self._exact is not None
        known = np.array(guide.status) == Status.CONVERGED
        converged = np.array(field.status) == Status.CONVERGED
        spread = np.hypot(field.displacement_std_m, guide.displacement_std_m)
        gap = np.abs(field.displacement_m - guide.displacement_m)
        agreed = ~self._blind & doubtful & converged & known & roots.agrees(gap, roots.AGREE * spread)
        if agreed.any():
            if self._confirmed is None:
                self._confirmed = np.full_like(field.displacement_m, np.inf)
            self._confirmed[agreed] = field.displacement_m[agreed]
        replaced = ~self._blind & doubtful & ~agreed & known
        status = list(field.status)
        for u in np.flatnonzero(doubtful & ~agreed).tolist():
            if replaced[u]:
                status[u] = Status.CONVERGED
            elif converged[u]:
                status[u] = Status.ILL_CONDITIONED
        moved, residual = field.displacement_m.copy(), field.residual.copy()
        moved[replaced], residual[replaced] = guide.displacement_m[replaced], guide.residual[replaced]
        apart = 3.0 * gap.max(axis=(1, 2), keepdims=True)

        def judged(own: Float, guides: Float) -> Float:
            std = np.where(replaced[:, None, None], guides, own)
            std[doubtful & ~agreed & ~replaced] = np.inf
            if self._folded.any():  # two roots may lie closer than the posterior can tell
                std[replaced & self._folded] *= 2.0
                std = np.where((agreed & self._folded)[:, None, None], np.hypot(std, apart), std)
            return std

        self._apart[doubtful] = 0.0
        self._apart[agreed & self._folded] = apart[agreed & self._folded]
        self._any_apart = True  # perhaps

        assert guide.core_std_m is not None
        self._exact.adopt(replaced, moved)
        self._exact.distrust(doubtful & ~agreed & ~replaced)
        stats = dataclasses.replace(
            field.stats,
            evaluations=field.stats.evaluations + guide.stats.evaluations,
            jacobians=field.stats.jacobians + guide.stats.jacobians,
            steps=field.stats.steps + guide.stats.steps,
            time_s=field.stats.time_s + guide.stats.time_s,
        )
        force = field.force_n
        if force is not None and self._exact.stiffness_n_per_m is not None:
            force = self._exact.stiffness_n_per_m * moved
        return dataclasses.replace(
            field,
            displacement_m=moved,
            displacement_std_m=judged(field.displacement_std_m, guide.displacement_std_m),
            core_std_m=judged(field.displacement_std_m, guide.core_std_m),
            status=tuple(status),
            residual=residual,
            stats=stats,
            force_n=force,
            by_prior=replaced,
        )


def _choose(
    layout: PatchLayout, method: str, relative_noise: ArrayLike, normal_only: bool, nuisances: list[str]
) -> tuple[str, str]:
    """The method and why."""
    if method != "auto":
        if method == "exact" and nuisances:
            raise ValueError(f"method: got 'exact' with {nuisances[0]}, must be posterior or auto")
        return method, "asked for"
    if nuisances:
        return "posterior", f"{' and '.join(nuisances)} asked for"
    unknowns = layout.unknowns // 3 if normal_only else layout.unknowns
    if layout.shape[1] < unknowns:
        return "posterior", f"{layout.shape[1]} lower wires for {unknowns} unknowns an upper wire"
    share = patch_std(layout, relative_noise, normal_only)
    chosen = "exact" if share <= EXACT_STD else "posterior"
    return chosen, (
        f"the noise leaves the exact inverse a deviation of {100 * share:.2g} % of the clearance between the "
        f"layers at rest, where {100 * EXACT_STD:g} % is the limit"
    )
