"""The whole patch as one maximum a posteriori estimate, followed through a stream of frames.

touched   the wires whose resistances differ from those at rest by more than noise give the equations
hold      where all of them are explained by the last field within noise, nothing is solved
track     chord or Gauss-Newton steps from the last field; a jump is annealed from rest (``estimate``)
scale     the prior's scale s, and if wanted the noise, follow the evidence (MacKay)
judge     a wire whose residual no deformation explains is left out, named, and the rest solved again
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.elastic import Rubber
from skinnode.model.forward import potential_per_m
from skinnode.model.frames import Contact, FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status, as_statuses
from skinnode.solve import roots
from skinnode.solve.inputs import NOISE_MAX, broadcast_noise, checked_mask, checked_noise
from skinnode.solve.posterior.contacts import ContactFinder
from skinnode.solve.posterior.estimate import Data, Estimator, Index
from skinnode.solve.posterior.prior import ElasticPrior
from skinnode.solve.wires.decode import A_MAX, A_MIN
from skinnode.solve.wires.problem import PatchProblem

DRIFTS: Final = ("none", "patch", "wire")

QUIET_CHANCE: Final = 0.005
"""A wire at rest, or unmoved, is taken for moved with this chance a frame: χ² test."""
QUIET_DEVIATIONS: Final = 3.7
"""Or where a single coordinate would have to move by more than this: one in 15 unmoved frames of 300
coordinates."""
NOISE_LEAST: Final = 1e-6
"""Least relative noise: a fifth of a 16-bit code. Less forces the field onto a root of F = b, and there are
wrong ones, on layouts with folds from ten times as much on; and the forward model is no better than that."""
LEFT_OUT: Final = 3
"""Most wires left out one after the other before the whole frame is called INCONSISTENT."""

SCALE_WORTH: Final = 2.0
"""The prior of s² counts as much as 2 of a hundred or two directions that the data determine."""
SCALE_REST: Final = 0.005
"""Scale, in clearances, that this prior expects: where presses of a tenth of the layer come out."""
SCALE_MOST: Final = 1.0
"""Greatest scale, in clearances: beyond, the surface would lie below the lower layer."""
SCALE_STEP: Final = math.log(1.25)
"""The scale is set anew when the evidence moves it by a quarter: the deviations change by less than that."""
SCALE_LEAST: Final = 1.0
"""Smallest scale: a field of it moves the resistances by their noise on the average. Less would go unnoticed,
and must not be denied by the deviations of an untouched patch."""
ADAPTIONS: Final = 5
"""Most times a frame sets the prior or the noise anew."""
REFINEMENTS: Final = 3
"""Most times a frame refines where loads are expected; each costs as much as two solves."""
KEPT: Final = 50
"""Frames for which a wire that moved against what the others said has its equations used."""
NOISE_WORTH: Final = 20.0
"""The noise given counts as much as 20 resistances when it is estimated."""
NOISE_STEP: Final = math.log(1.1)

LEAST_STEPS: Final = 3.0
"""An answer from rest takes as long as so many factorisations of all wires with their deviations, at the very
least: 11 to 20 were measured for presses on 1 to 10 wires."""


class Posterior:
    """Estimates one patch, frame by frame. One owner; the compiled parts hold no GIL.

    Args:
        layout: the patch; any number of lower wires.
        relative_noise: standard deviation of R relative to R, a number or (U, K).
        baseline_ohm: (U, K) resistances measured at rest; the resistivity and the gain then cancel.
        rubber: of the skin. Displacement does not depend on its modulus, forces are proportional to it.
        scale_m: RMS normal displacement that the prior expects; by default it is set from the data.
        estimate_noise: set a factor on ``relative_noise`` from the data as well.
        drift: ``patch``: all resistances may be off by one common gain, ``wire``: by one an upper wire, with
            a prior deviation of ``drift_std``; ``none``.
        model_error: share of the change of each resistance that the forward model may get wrong (thickness,
            size of the electrodes, conductivity under strain): in common, and 0.7 of it each on its own.
        normal_only: electrodes move along z only, which asks a third of the unknowns.
        hold: solve only wires that were touched, and nothing where nothing moved.
        contacts: give forces and contacts too.
        deadline_us: an update returns after this time and at most one more factorisation; what could not be
            solved by then is DEADLINE.

    Compiles its kernels on construction. Raises ValueError for arguments of the wrong shape or range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        *,
        relative_noise: ArrayLike = 1e-5,
        baseline_ohm: ArrayLike | None = None,
        rubber: Rubber | None = None,
        scale_m: float | None = None,
        estimate_noise: bool = False,
        drift: str = "none",
        drift_std: float = 0.02,
        model_error: float = 0.0,
        normal_only: bool = False,
        hold: bool = True,
        contacts: bool = True,
        deadline_us: float | None = None,
    ) -> None:
        if drift not in DRIFTS:
            raise ValueError(f"drift: got {drift!r}, must be one of {', '.join(DRIFTS)}")
        if not (math.isfinite(drift_std) and drift_std > 0):
            raise ValueError(f"drift_std: got {drift_std}, must be positive and finite")
        if not (math.isfinite(model_error) and model_error >= 0):
            raise ValueError(f"model_error: got {model_error}, must be finite and at least 0")
        if deadline_us is not None and not (math.isfinite(deadline_us) and deadline_us > 0):
            raise ValueError(f"deadline_us: got {deadline_us}, must be positive and finite")
        if scale_m is not None and not (math.isfinite(scale_m) and scale_m > 0):
            raise ValueError(f"scale_m: got {scale_m}, must be positive and finite")
        self.layout = layout
        self._problem = PatchProblem.of(layout, baseline_ohm)
        self._noise = checked_noise(relative_noise, layout)
        self._fixed_scale = None if scale_m is None else (scale_m / layout.pitch_m) ** 2
        self._estimate_noise, self._drift, self._model_error = estimate_noise, drift, model_error
        self._hold = hold
        wires, electrodes = layout.upper_m.shape[:2]
        self._free = np.arange(2, 3 * electrodes, 3) if normal_only else np.arange(3 * electrodes)
        self._prior = ElasticPrior.of(layout, rubber)
        self._seconds = math.inf if deadline_us is None else deadline_us * 1e-6
        self._until = math.inf
        self._gains = {"none": 0, "patch": 1, "wire": wires}[drift]
        self._d = np.full(self._gains + (model_error > 0), drift_std**2)
        if model_error > 0:
            self._d[-1] = model_error**2
        self._estimator = Estimator(self._problem, self._prior, self._free, self._d.size)
        self._contacts = ContactFinder(self._prior, layout) if contacts else None
        self._quiet, self._impossible = (
            chi_square_limits(layout.shape[1], chance) for chance in (QUIET_CHANCE, roots.IMPOSSIBLE_CHANCE)
        )
        self._folded = float(roots.folded_wires(layout, normal_only).mean()) > 0.5
        self._noise_least = roots.REFEREE_NOISE if self._folded else NOISE_LEAST
        self._far = roots.FAR * float(self._problem.clearance.min())
        height = float(np.median(self._problem.clearance))
        self._scale_rest, self._scale_most = (SCALE_REST * height) ** 2, (SCALE_MOST * height) ** 2
        self._signal = self._estimator.signal()
        self.reset()
        self._warm_up()
        self.reset()
        self.from_rest_s = 0.0
        """A touched frame does not take less from rest on; 0 where there is no deadline."""
        if deadline_us is not None:
            a = self._problem.a_rest
            at_rest = self._data(a, np.ones_like(a), np.ones_like(a, bool))
            self.from_rest_s = LEAST_STEPS * self._estimator.step_s(at_rest)
            self.reset()

    def _warm_up(self) -> None:
        """Solve a touched frame, lest the first touch of a stream wait for the compiler."""
        touched = self.layout.upper_m.copy()
        touched[0, 0, 2] -= 0.1 * self._problem.clearance[0, 0] * self.layout.pitch_m
        potential = potential_per_m(self.layout, touched) * self.layout.pitch_m
        seconds, self._seconds = self._seconds, math.inf  # a deadline would leave kernels uncompiled
        self.update(1.0 / (potential * self._problem.gain), relative_noise=1e-4)
        self._seconds = seconds
        self._estimator.gamma()  # asked for where nothing touches
        if self._contacts is not None:
            self._contacts.warm_up(self._estimator)

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        wires = self.layout.shape[0]
        self._estimator.reset(self._fixed_scale or self._scale_rest)
        self._factor = 1.0  # estimated noise over the noise given
        self._scale_least = self._scale_rest
        self._members: Index = np.arange(0)
        self._kept = np.zeros(wires, np.int64)
        self._trusted = np.zeros_like(self._estimator.moved)  # last field that passed, its nuisances
        self._trusted_g = np.zeros_like(self._estimator.g)
        self._contacts_found: tuple[Contact, ...] = ()
        self._force = np.zeros((*self.layout.upper_m.shape,))
        self._compared = np.zeros_like(self._trusted)  # field when it was last held against the annealed
        self._annealed = False  # whether the field at hand came from rest
        self._known = False  # whether the estimator's factors belong to the trusted field
        self._wires = np.arange(wires)
        self._overlooked = np.zeros_like(self._estimator.std)
        self._seen = np.zeros(self.layout.shape, bool)  # resistances that the trusted field had

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """The displacement field of one frame, its loads and contacts.

        Args:
            frame_ohm: (U, K) resistances; whatever is not positive and finite is not used.
            valid: (U, K) bool, False where a chunk or wire is missing; default all.
            relative_noise: as in the constructor, of this frame only; what is not positive and finite makes
                its resistance unused.

        Never raises for numbers. A wire without usable resistances is estimated from its neighbours, and its
        deviation says so. A wire that no deformation explains is INCONSISTENT and left out of the estimate,
        and so is one that no steps lead to a deformation of, not even on its own: MAX_STEPS.
        Where the whole frame cannot be solved, the last trusted field is held with an infinite deviation.
        Raises ValueError for wrong shapes.
        """
        start = perf_counter()
        frame = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
        noise = self._noise if relative_noise is None else broadcast_noise(relative_noise, self.layout)
        with np.errstate(over="ignore", invalid="ignore"):
            a = frame * self._problem.gain
        known = (noise > 0) & (noise < NOISE_MAX)
        noise = np.where(known, np.maximum(noise, self._noise_least), 1.0)
        usable = known & (a > A_MIN) & (a < A_MAX)
        if valid is not None:
            usable &= checked_mask(valid, self.layout)
        a = np.where(usable, a, self._problem.a_rest)
        estimator = self._estimator
        estimator.evaluations = estimator.factorisations = 0
        estimator.until = min(start + self._seconds, self._until)
        estimator.moved[:], estimator.g[:] = self._trusted, self._trusted_g
        data = self._data(a, noise, usable)
        self._set_least(data)
        if self._is_quiet(data):
            held = np.ones(len(a), bool)
            status = np.full(len(a), Status.CONVERGED)
        else:
            try:
                status, held = self._solve(data, a, noise, usable)
            except TimeoutError:
                start_known = self._known
                status, held = self._give_up(Status.DEADLINE)
                self._known = start_known  # the next frame starts where this one did
            data = self._data(a, noise, usable)
        return self._field(data, status, held, start)

    def covariance_m2(self) -> Float:
        """(3UN, 3UN) covariance of the displacement of the last frame as the factors have it, without the
        allowance for what the prior itself may get wrong (``PRIOR_DOUBT``); 0 for coordinates that are not
        free.

        Raises RuntimeError where that frame was not solved.
        """
        if not np.isfinite(self._estimator.std).all():
            raise RuntimeError("covariance_m2: the last frame was not solved")
        wires, coordinates = self._estimator.moved.shape
        every = (self._wires[:, None] * coordinates + self._free).ravel()
        full = np.zeros((wires * coordinates, wires * coordinates))
        full[np.ix_(every, every)] = self._estimator.covariance() * self.layout.pitch_m**2
        return full

    def energy(self, moved: Float) -> float:
        """uᵀ (s² C)⁻¹ u of a displacement (U, 3N) in pitches, −2 log of its prior density to a constant, with
        the prior as the last frame left it."""
        return self._estimator.roughness(moved) / self._estimator.scale2

    def _data(self, a: Float, noise: Float, usable: NDArray[np.bool_]) -> Data:
        change = a / self._problem.a_rest - 1.0
        variance = (self._factor * noise) ** 2 + 0.5 * (self._model_error * change) ** 2
        weight = np.where(usable, 1.0 / np.sqrt(variance), 0.0)
        h = np.zeros((*a.shape, self._d.size))
        if self._drift == "patch":
            h[..., 0] = weight
        elif self._drift == "wire":
            h[self._wires, :, self._wires] = weight
        if self._model_error > 0:
            h[..., -1] = weight * change
        return Data(a, weight, h, self._d)

    def stop_at(self, until: float) -> None:
        """Let the next updates end at this time of :func:`time.perf_counter`, inf for never."""
        self._until = until

    def _set_least(self, data: Data) -> None:
        """The smallest scale at the noise of the frame."""
        power = float((data.weight**2 * self._signal).sum())
        count = np.count_nonzero(data.weight)
        least = SCALE_LEAST**2 * count / power if power > 0 else math.inf
        self._scale_least = min(least, self._scale_most)

    def _is_quiet(self, data: Data) -> bool:
        """Whether the last field explains the frame within noise. A member's residual is the difference of
        two noises, its own and the one that was solved into the field."""
        if not (self._hold and self._known and np.array_equal(data.weight > 0, self._seen)):
            return False  # fewer resistances know less of the field, more know more
        if self._strained(data, roots.SUSPICIOUS):
            return False
        noises = np.ones(len(self._wires))
        noises[self._members] = 2.0
        stirred, self._overlooked, _ = self._stirred(data, self._trusted, noises)
        return not stirred.any()

    def _stirred(
        self, data: Data, moved: Float | None, noises: float | Float = 1.0
    ) -> tuple[NDArray[np.bool_], Float, Float]:
        """(U,) wires whose residuals, at rest for None, are beyond noise of variance ``noises``; (U, f) how
        far each coordinate seems to have moved, were it the only one; (U,) χ²."""
        total, sharpest, move = self._estimator.surprise(data, moved)
        limit = self._quiet[data.count]
        stirred = (total > noises * limit) | (sharpest > QUIET_DEVIATIONS * np.sqrt(noises))
        return stirred, move, total

    def _touched(self, data: Data) -> Index:
        """Wires whose resistances are not those at rest; one in the last solve stays a little longer."""
        touched, _, total = self._stirred(data, None)
        stay = np.zeros(len(total), bool)
        stay[self._members] = True
        touched |= stay & (total > data.count)
        if touched.any():
            touched |= self._kept > 0
        return np.flatnonzero(touched)

    def _solve(
        self, data: Data, a: Float, noise: Float, usable: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """(U,) statuses and wires not solved. Moves the estimator, and on success the trusted field."""
        if not usable.any():
            return self._give_up(Status.ILL_CONDITIONED)
        estimator = self._estimator
        status = np.full(len(a), int(Status.CONVERGED))
        self._kept -= self._kept > 0
        touched = self._touched(data)
        # it takes all wires to say that nothing is there
        wanted = touched if self._hold and touched.size else self._wires
        seen, usable = usable, usable.copy()
        for _ in range(LEFT_OUT + 3):
            members = wanted[data.count[wanted] > 0]
            if not self._converge(data, members):
                lost = [u for u in members.tolist() if not self._converge(data, np.array([u]))]
                if not lost or len(lost) > min(LEFT_OUT, len(a) - 1):
                    return self._give_up(Status.MAX_STEPS)
                status[lost], usable[lost] = Status.MAX_STEPS, False
                data = self._data(a, noise, usable)
                continue
            data = self._adapt(data, a, noise, usable, members, local=touched.size > 0)
            if self._folded and self._annealed and touched.size and self._seconds == math.inf:
                data = self._anneal_again(data, a, noise, usable, members)
            if not np.isfinite(estimator.moved).all():
                return self._give_up(Status.NON_FINITE)
            stirred, _, total = self._stirred(data, estimator.moved)
            stirred[wanted] = False
            surprised = np.flatnonzero(stirred)
            if surprised.size:  # moved, and not as the others say, or stayed where they say it moved
                self._kept[surprised] = KEPT
                wanted = np.union1d(wanted, surprised)
                continue
            if self._strained(data, roots.BELIEVABLE):
                return self._give_up(Status.INCONSISTENT)
            excess = total / self._impossible[data.count]
            if (excess <= 1.0).all():
                break
            worst = int(np.argmax(excess))
            status[worst] = Status.INCONSISTENT
            usable[worst] = False
            data = self._data(a, noise, usable)
        else:
            return self._give_up(Status.INCONSISTENT)
        if self._problem.out_of_reach(self._problem.rest + estimator.moved).any():
            return self._give_up(Status.ILL_CONDITIONED)
        self._trusted[:] = estimator.moved
        self._trusted_g[:] = estimator.g
        self._members, self._known, self._seen = members, True, seen
        held = np.ones(len(a), bool)
        held[members] = False
        held &= seen.any(axis=1)  # of a wire without resistances the frame says nothing
        return status, held

    def _converge(self, data: Data, members: Index) -> bool:
        """From the last trusted field, else from rest by annealing."""
        estimator = self._estimator
        estimator.moved[:] = self._trusted
        estimator.g[:] = self._trusted_g
        self._annealed = False
        hurry = self._seconds < math.inf  # annealing takes several frames' worth of time
        if (self._known or hurry) and estimator.track(data, members):
            gone = float(np.abs(estimator.moved - self._compared).max())
            far = gone >= self._far or self._strained(data, roots.SUSPICIOUS)
            if not far or hurry or self._anneal_and_compare(data, members):
                return True
        estimator.spread(self._fixed_scale or self._scale_rest)
        if self._fixed_scale is None:
            estimator.scale2 = self._bounded(estimator.guess_scale(data, members))
        self._annealed = True
        return estimator.anneal(data, members)

    def _strained(self, data: Data, deviations: float) -> bool:
        """Whether a nuisance is beyond so many of its prior deviations: it then stands in for something
        else."""
        return roots.beyond_prior(self._estimator.g, data.d, deviations)

    def _anneal_and_compare(self, data: Data, members: Index) -> bool:
        """Far from where that was last asked, the next maximum need not be the right one: the better of it
        and the annealed."""
        estimator = self._estimator
        self._compared[:] = estimator.moved
        tracked = estimator.moved.copy(), estimator.g.copy()
        estimator.spread(self._fixed_scale or self._bounded(estimator.guess_scale(data, members)))
        annealed = estimator.anneal(data, members)
        self._annealed = annealed and estimator.objective(data) <= estimator.objective(data, *tracked)
        if self._annealed:
            return True
        estimator.moved[:], estimator.g[:] = tracked
        return estimator.track(data, members)

    def _anneal_again(
        self, data: Data, a: Float, noise: Float, usable: NDArray[np.bool_], members: Index
    ) -> Data:
        """With folds, loads expected all over the patch may have led to a wrong maximum: the better of that
        and the one annealed with the loads expected where they were found."""
        estimator = self._estimator
        first, before = (estimator.moved.copy(), estimator.g.copy()), estimator.objective(data)
        if estimator.anneal(data, members) and estimator.objective(data) < before - roots.LIKELIER:
            return self._adapt(data, a, noise, usable, members, local=True)
        estimator.moved[:], estimator.g[:] = first
        estimator.track(data, members)
        return data

    def _bounded(self, scale2: float) -> float:
        return min(max(scale2, self._scale_least), self._scale_most)

    def _adapt(
        self, data: Data, a: Float, noise: Float, usable: NDArray[np.bool_], members: Index, *, local: bool
    ) -> Data:
        """The field at the noise, the scale and, if ``local``, the places of the loads that it speaks for."""
        estimator = self._estimator
        if not local and self._fixed_scale is None and (estimator.share != 1.0).any():
            estimator.spread(self._scale_rest)
            estimator.track(data, members)
        refinements = REFINEMENTS if local else 0
        for _ in range(ADAPTIONS):
            moved, g, scale2 = estimator.moved.copy(), estimator.g.copy(), estimator.scale2
            share, factor, before = estimator.share.copy(), self._factor, data
            changed = False
            if self._fixed_scale is None:
                if local:
                    variance = np.minimum(estimator.expected(self._scale_least), self._scale_most)
                    wanted = self._bounded(float(variance.mean()))
                    changed = refinements > 0 and estimator.localise(variance)
                    refinements -= 1
                else:
                    wanted = self._bounded(estimator.evidence_scale(SCALE_WORTH, self._scale_rest))
                if not changed and abs(math.log(wanted / estimator.scale2)) > 2.0 * SCALE_STEP:
                    estimator.scale2 = wanted
                    changed = True
            if self._estimate_noise:
                factor = self._noise_factor(data, members)
                if abs(math.log(factor / self._factor)) > NOISE_STEP:
                    self._factor = factor
                    data = self._data(a, noise, usable)
                    changed = True
            if not changed:
                break
            if not (estimator.track(data, members) or estimator.anneal(data, members)):
                # not from there: back to the field that was found, and the prior it was found with
                estimator.moved[:], estimator.g[:], self._factor, data = moved, g, factor, before
                if not estimator.localise(scale2 * share):
                    estimator.scale2 = scale2
                estimator.track(data, members)
                break
        return data

    def _noise_factor(self, data: Data, members: Index) -> float:
        """The factor on the noise at which the residuals are what they should be (MacKay)."""
        total = float((self._estimator.residuals(data)[members] ** 2).sum())
        count = float(np.count_nonzero(data.weight[members]))
        left = max(count - self._estimator.gamma(), 0.0)
        return math.sqrt((self._factor**2 * total + NOISE_WORTH) / (left + NOISE_WORTH))

    def _give_up(self, status: Status) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        self._known = False
        self._seen[:] = False
        self._estimator.forget_factors()
        return np.full(len(self._wires), int(status)), np.zeros(len(self._wires), bool)

    def _field(
        self, data: Data, status: NDArray[np.int64], held: NDArray[np.bool_], start: float
    ) -> FieldFrame:
        estimator, problem, pitch = self._estimator, self._problem, self.layout.pitch_m
        displacement = problem.displacement_m(problem.rest + self._trusted)
        std, core = np.zeros_like(self._trusted), np.zeros_like(self._trusted)
        std[:, self._free], core[:, self._free] = estimator.std, estimator.core
        if held.all():  # half of what it may overlook
            for each in (std, core):
                each[:, self._free] = np.maximum(each[:, self._free], 0.5 * self._overlooked)
        if self._contacts is not None and self._known and not held.all():
            self._force, self._contacts_found = self._contacts.find(estimator)
        used = data.weight > 0
        r = estimator.residuals(data, self._trusted) / np.where(used, data.weight, np.inf)
        rms = np.sqrt((r**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1))
        gains = self._trusted_g[: self._gains]
        return FieldFrame(
            displacement_m=displacement,
            displacement_std_m=(std * pitch).reshape(displacement.shape),
            core_std_m=(core * pitch).reshape(displacement.shape),
            status=as_statuses(status.tolist()),
            residual=np.where(used.any(axis=1), rms, np.inf),
            stats=SolveStats(
                estimator.evaluations, estimator.evaluations, estimator.factorisations, perf_counter() - start
            ),
            force_n=None if self._contacts is None else self._force,
            held=held,
            method="posterior",
            by_prior=np.asarray(~used.any(axis=1)),
            contacts=self._contacts_found if self._known else (),
            gain=np.broadcast_to(gains, len(held)).copy() if self._gains else None,
            noise_factor=self._factor,
        )


def chi_square_limits(most: int, chance: float) -> Float:
    """(most + 1,) χ² of 0, 1, … degrees of freedom that is exceeded with ``chance``; tiny for none."""
    from scipy.special import chdtri

    return np.concatenate([[1e-300], chdtri(np.arange(1.0, most + 1.0), chance)])
