"""Posterior of a patch for each frame of a stream, without a search for wrong readings.

Each frame passes through these steps:

- Gate: select the wires whose resistances differ from those at rest by more than the noise. Only the
  equations of these wires are used.
- Hold: if the last field explains the whole frame to within the noise, keep it.
- Track: starting from the last field, solve by chord or Gauss-Newton steps. If this fails, anneal from rest
  (``map_estimate``).
- Adapt: estimate the prior scale, the expected load locations and, if requested, the noise.
- Reject: if no deformation explains the residual of a wire, mark the wire as INCONSISTENT and solve again
  without it.
"""

from __future__ import annotations

import math
import weakref
from typing import Final, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.forward import potential_per_m
from skinnode.model.frames import Contact, FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.model.status import Status, as_statuses
from skinnode.model.tolerances import EXACT
from skinnode.process.clock import perf_counter
from skinnode.solve import roots
from skinnode.solve.inputs import NOISE_MAX, broadcast_noise, checked_mask, checked_noise
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.noise_estimate import NoiseEstimate
from skinnode.solve.options import PosteriorArguments, PosteriorOptions, merged
from skinnode.solve.posterior.contacts import ContactFinder
from skinnode.solve.posterior.data_share import data_share
from skinnode.solve.posterior.elastic_prior import LAYER_SHARE, ElasticPrior, bonded_response
from skinnode.solve.posterior.gating import Fit, Gate
from skinnode.solve.posterior.hyperparameters import Hyperparameters
from skinnode.solve.posterior.local.disc_search import DiscPrior
from skinnode.solve.posterior.map_estimate import MapEstimator
from skinnode.solve.posterior.observation import Observation, ObservationModel, Readings
from skinnode.solve.wires.decode import A_MAX, A_MIN
from skinnode.solve.wires.problem import PatchProblem

DISCS_FROM: Final = 0.9e-4
"""Noise of the readings from which the prior ``auto`` consists of discs; slightly less than 1e-4. At 1e-4,
discs reduce the median error by a quarter to a third; at 1e-3, by half (docs/methods.md)."""
NOISE_LEAST: Final = 1e-6
"""Minimum relative noise assumed in a solve; also accounts for errors in the forward model. With less noise,
every solve would end at a root of F = b, which can be the wrong root. On layouts with folds (det J = 0),
wrong roots occur even at a noise of 1e-5."""
LEFT_OUT: Final = 3
"""Maximum number of inconsistent wires left out of a frame. If there are more, all wires of the frame are
INCONSISTENT."""
LEAST_STEPS: Final = 3.0
"""Minimum duration of a solve from rest, relative to the time taken to factorise the equations of all wires
and compute their standard deviations. Measured solves of presses on 1 to 10 wires took 11 to 20 times as long
as this computation."""

Mask = NDArray[np.bool_]

_WARM: Final[weakref.WeakKeyDictionary[PatchLayout, set[tuple[object, ...]]]] = weakref.WeakKeyDictionary()
"""Options for which the kernels have been compiled, by layout."""


def expects_discs(options: PosteriorOptions, noise: float) -> bool:
    """Return whether a posterior with these options expects the loads in discs, given its relative noise."""
    if options.prior == "auto":
        return noise >= DISCS_FROM and options.model_error == 0.0 and options.scale_m is None
    return options.prior == "discs"


class FrameEstimator:
    """Estimates the displacement, loads and contacts of one patch, frame by frame.

    This class uses all available readings; :class:`skinnode.Posterior` also detects wrong readings. Each
    stream needs its own instance. The kernels release the GIL; :meth:`warm_up` compiles them.

    Args:
        layout: The patch, with any number of lower wires.
        options: Estimation options; :class:`skinnode.solve.options.PosteriorOptions()` by default.
        **arguments: Options by name; these take precedence over ``options``.

    Attributes:
        layout: The patch.
        options: Options in effect.
        from_rest_s: Minimum time to solve a touched frame from rest, in s; 0 before :meth:`warm_up` or if no
            deadline is set.
        noise_estimate: Estimate of the stream's noise, used to scale the stated noise; None if the stated
            noise is used unchanged.

    Raises:
        ValueError: If an option has the wrong shape or is out of range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        options: PosteriorOptions | None = None,
        **arguments: Unpack[PosteriorArguments],
    ) -> None:
        self.options = options = merged(PosteriorOptions, options, arguments)
        self.layout = layout
        self._problem = PatchProblem.of(layout, options.baseline_ohm)
        self._noise = checked_noise(options.relative_noise, layout)
        wires, electrodes = layout.upper_m.shape[:2]
        self._free = np.arange(2, 3 * electrodes, 3) if options.normal_only else np.arange(3 * electrodes)
        elastic = ElasticPrior.of(layout, options.rubber)
        self._seconds = options.deadline_s
        self._until = math.inf
        made = options.tolerances or EXACT
        self._model = ObservationModel(
            self._problem, options.drift, options.drift_std, options.model_error, made
        )
        self._estimator = MapEstimator(self._problem, elastic, self._free, self._model.fixed, made)
        self._contacts: ContactFinder | None = None
        if options.contacts:
            self._contacts = ContactFinder(
                elastic,
                layout,
                options.rubber,
                calibrated=options.force_calibrated,
                thickness=made.thickness,
            )
        self._gate = Gate(wires, layout.shape[1])
        self._folded = float(roots.folded_wires(layout, options.normal_only).mean()) > 0.5
        self._noise_least = roots.REFEREE_NOISE if self._folded else NOISE_LEAST
        self._far = roots.FAR * float(self._problem.clearance.min())
        scale2 = None if options.scale_m is None else (options.scale_m / layout.pitch_m) ** 2
        height = float(np.median(self._problem.clearance))
        discs = None
        if expects_discs(options, float(np.median(self._noise))):
            every = (np.arange(wires)[:, None] * layout.unknowns + self._free).ravel()
            layer = np.ascontiguousarray(bonded_response(layout)[every] / LAYER_SHARE)
            discs = DiscPrior(self._estimator, elastic.shape, height, layer)
        self._hyper = Hyperparameters(self._estimator, height, scale2, options.estimate_noise, discs)
        self.noise_estimate: NoiseEstimate | None = None
        self._forget()
        self.from_rest_s = 0.0
        if options.follow_noise and not options.estimate_noise:
            self.noise_estimate = NoiseEstimate(layout.shape)

    def warm_up(self) -> None:
        """Compile the kernels by solving a touched frame, so that the first touch in a stream is not delayed.

        A second patch with the same layout and options uses the same kernels and needs no solve. If a
        deadline is set, this method also measures :attr:`from_rest_s`.
        """
        warm = _WARM.setdefault(self.layout, set())
        kernels = *self.options.kernels, self._hyper.discs is None
        if kernels in warm and self._seconds == math.inf:
            return
        touched = self.layout.upper_m.copy()
        touched[0, 0, 2] -= 0.1 * self._problem.clearance[0, 0] * self.layout.pitch_m
        potential = potential_per_m(self.layout, touched) * self.layout.pitch_m
        seconds, self._seconds = self._seconds, math.inf  # with a deadline, some kernels might not run
        a = 1.0 / (potential * self._problem.gain)
        self.estimate(a, np.ones(self.layout.shape, bool), 1e-4)
        self._seconds = seconds
        self._estimator.gamma()  # compile the kernel
        self._hyper.loads.expected(1.0)  # with discs, used only if the loads are not local
        if self._contacts is not None:
            self._contacts.warm_up(self._hyper.loads.estimate())
        self._forget()
        if seconds < math.inf:
            a = self._problem.a_rest
            at_rest = self._observe(Readings(a, np.ones_like(a), np.ones_like(a, bool)))
            self.from_rest_s = LEAST_STEPS * self._estimator.step_s(at_rest)
            self._forget()
        warm.add(kernels)

    def reset(self) -> None:
        """Discard the state of the stream; the next frame is solved from rest."""
        self._forget()

    def _forget(self) -> None:
        wires = self.layout.shape[0]
        if self.noise_estimate is not None:
            self.noise_estimate.reset()
        self._hyper.reset()
        self._gate.reset()
        self._members: Index = np.arange(0)
        self._share = np.zeros_like(self._estimator.moved)
        self._trusted = np.zeros_like(self._estimator.moved)  # displacement of the last accepted field
        self._trusted_g = np.zeros_like(self._estimator.g)
        if self._contacts is not None:
            self._contacts.reset()
        self._contacts_found: tuple[Contact, ...] = ()
        self._force = np.zeros((*self.layout.upper_m.shape,))
        self._compared = np.zeros_like(self._trusted)  # last field that was compared with an annealed field
        self._annealed = False  # whether the current field was annealed from rest
        self._known = False  # whether the estimator's factors belong to the trusted field
        self._wires = np.arange(wires)
        self._overlooked = np.zeros_like(self._estimator.std)
        self._seen = np.zeros(self.layout.shape, bool)  # resistances used for the trusted field

    def estimate(self, frame_ohm: ArrayLike, valid: ArrayLike, relative_noise: ArrayLike) -> FieldFrame:
        """Estimate the field of one frame like :meth:`skinnode.Posterior.update`, but without the data check.

        Args:
            frame_ohm: (U, K) resistances, in ohms. Values that are not positive and finite are ignored.
            valid: (U, K) bool: False where a reading is missing.
            relative_noise: Relative noise of this frame, a number or (U, K).

        Returns:
            The field, with one status per wire.

        Raises:
            ValueError: If an array has the wrong shape.
        """
        start = perf_counter()
        return self._estimate(self._readings(frame_ohm, valid, relative_noise, None), start)

    def _estimate(self, readings: Readings, start: float, alone: Readings | None = None) -> FieldFrame:
        """Estimate the field of one frame.

        Args:
            readings: The frame.
            start: Time at which the update began, in s.
            alone: The unfiltered frame, which determines the minimum prior scale; None if ``readings`` is
                unfiltered. Changes hidden by the noise of a single frame may not have reached the filtered
                readings yet.
        """
        estimator = self._estimator
        estimator.evaluations = estimator.factorisations = 0
        estimator.until = min(start + self._seconds, self._until)
        estimator.moved[:], estimator.g[:] = self._trusted, self._trusted_g
        observation = self._observe(readings)
        self._hyper.set_least(observation if alone is None else self._observe(alone))
        try:
            if self._is_quiet(observation):
                held = np.ones(len(self._wires), bool)
                status = np.full(len(self._wires), Status.CONVERGED)
            else:
                status, held = self._solve(observation, readings)
                observation = self._observe(readings)
        except TimeoutError:
            known = self._known
            status, held = self._give_up(Status.DEADLINE)
            field = self._field(self._observe(readings), status, held, start)
            self._known = known  # the trusted field is still a valid start for the next frame
            return field
        return self._field(observation, status, held, start)

    def stop_at(self, until: float) -> None:
        """Set the deadline of subsequent updates.

        Args:
            until: Deadline on the clock :func:`skinnode.process.clock.perf_counter`, in s; inf for no
                deadline.
        """
        self._until = until

    def covariance_m2(self) -> Float:
        """Return the posterior covariance of the last frame's displacement.

        The standard deviations of the field include an allowance for an inaccurate prior (``PRIOR_DOUBT``);
        this covariance does not.

        Returns:
            (3UN, 3UN) covariance, in m²; 0 for coordinates that are not free.

        Raises:
            RuntimeError: If the last frame was not solved.
        """
        if not np.isfinite(self._estimator.std).all():
            raise RuntimeError("covariance_m2: the last frame was not solved")
        wires, coordinates = self._estimator.moved.shape
        every = (self._wires[:, None] * coordinates + self._free).ravel()
        full = np.zeros((wires * coordinates, wires * coordinates))
        full[np.ix_(every, every)] = self._estimator.covariance() * self.layout.pitch_m**2
        return full

    def energy(self, moved: Float) -> float:
        """Return uᵀ (s² C)⁻¹ u for a displacement u, with the prior of the last frame.

        The result is −2 log of the prior density, up to a constant.

        Args:
            moved: (U, 3N) displacement u, in pitches.
        """
        return self._estimator.roughness(moved) / self._estimator.load_prior.scale2

    # -- one frame -------------------------------------------------------------------------------------

    def _readings(
        self,
        frame_ohm: ArrayLike,
        valid: ArrayLike | None,
        relative_noise: ArrayLike | None,
        rounding_ohm: Float | None,
    ) -> Readings:
        frame = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
        noise = self._noise if relative_noise is None else broadcast_noise(relative_noise, self.layout)
        mask = None if valid is None else checked_mask(valid, self.layout)
        self.see_noise(frame, noise, rounding_ohm, mask)
        if self.noise_estimate is not None and self.noise_estimate.factor != 1.0:
            noise = self.noise_estimate.factor * noise
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            a = frame * self._problem.gain
            if rounding_ohm is not None:
                noise = np.hypot(noise, rounding_ohm / frame)
        known = (noise > 0) & (noise < NOISE_MAX)
        noise = np.where(known, np.maximum(noise, self._noise_least), 1.0)
        usable = known & (a > A_MIN) & (a < A_MAX)
        if mask is not None:
            usable &= mask
        return Readings(np.where(usable, a, self._problem.a_rest), noise, usable)

    def see_noise(self, ohm: Float, noise: Float, rounding_ohm: Float | None, valid: Mask | None) -> None:
        """Pass a frame to the noise estimate; see :meth:`NoiseEstimate.see` for the arguments."""
        if self.noise_estimate is not None and self.noise_estimate.see(ohm, noise, rounding_ohm, valid):
            self._seen = np.zeros_like(self._seen)  # the trusted field assumed a different noise level

    def _observe(self, readings: Readings) -> Observation:
        return self._model.observe(readings, self._hyper.noise_factor)

    def _beyond_prior(self, observation: Observation, deviations: float) -> bool:
        # the lower limit is not applied to geometry errors, because one in a hundred exceeds it by chance
        count = self._model.fixed if deviations < roots.BELIEVABLE else observation.d.size
        return roots.beyond_prior(self._estimator.g[:count], observation.d[:count], deviations)

    def _is_quiet(self, observation: Observation) -> bool:
        """Return whether the last field explains the frame to within the noise.

        For wires that were used to compute the last field, the noise variance is doubled, because the field
        carries the noise of its own frame.
        """
        seen_before = self._known and np.array_equal(observation.weight > 0, self._seen)
        if not (self.options.hold and seen_before):
            return False  # the standard deviations depend on which resistances are usable
        if self._beyond_prior(observation, roots.SUSPICIOUS):
            return False
        noises = np.ones(len(self._wires))
        noises[self._members] = 2.0
        fit = self._estimator.fit(observation, self._trusted)
        self._overlooked = fit.move
        return not self._gate.moved(fit, observation.count, noises).any()

    def _solve(self, observation: Observation, readings: Readings) -> tuple[NDArray[np.int64], Mask]:
        """Solve a frame, and return the statuses (U,) and a mask (U,) of the held wires.

        If the solve succeeds, the solution becomes the trusted field.
        """
        if not readings.usable.any():
            return self._give_up(Status.ILL_CONDITIONED)
        status = np.full(len(self._wires), int(Status.CONVERGED))
        self._gate.next_frame()
        at_rest = self._estimator.fit(observation, None)
        touched = self._gate.touched(at_rest, observation.count, self._members)
        # if no wire seems touched, use all wires to be sure
        wanted = touched if self.options.hold and touched.size else self._wires
        seen = readings.usable
        for attempt in range(LEFT_OUT + 4):
            members = wanted[observation.count[wanted] > 0]
            if not self._converge(observation, members):
                lost = [u for u in members.tolist() if not self._converge(observation, np.array([u]))]
                if not lost or len(lost) > min(LEFT_OUT, len(status) - 1):
                    return self._give_up(Status.MAX_STEPS)
                status[lost], readings = Status.MAX_STEPS, readings.without(lost)
                observation = self._observe(readings)
                continue
            early = self._joining_early(observation, wanted) if attempt == 0 else self._wires[:0]
            if early.size:
                wanted = np.union1d(wanted, early)
                continue
            observation = self._refine(observation, readings, members, local=touched.size > 0)
            if not np.isfinite(self._estimator.moved).all():
                return self._give_up(Status.NON_FINITE)
            fit = self._estimator.fit(observation, self._estimator.moved)
            joining = self._joining(fit, observation, wanted)
            if joining.size:
                wanted = np.union1d(wanted, joining)
                continue
            if self._beyond_prior(observation, roots.BELIEVABLE):
                return self._give_up(Status.INCONSISTENT)
            excess = self._gate.excess(fit, observation.count)
            if (excess <= 1.0).all():
                return self._accept(status, members, seen)
            worst = int(np.argmax(excess))
            status[worst], readings = Status.INCONSISTENT, readings.without([worst])
            observation = self._observe(readings)
        return self._give_up(Status.INCONSISTENT)

    def _joining(self, fit: Fit, observation: Observation, wanted: Index) -> Index:
        """Return the wires outside ``wanted`` that contradict the field, and add them to later estimates."""
        joining = np.setdiff1d(np.flatnonzero(self._gate.moved(fit, observation.count)), wanted)
        self._gate.keep(joining)
        return joining

    def _joining_early(self, observation: Observation, wanted: Index) -> Index:
        """Return the wires outside ``wanted`` that contradict an annealed field, if discs are fitted to it.

        If these wires joined only after the discs had been fitted, the discs would have to be fitted again.
        """
        if not self._annealed or self._hyper.discs is None:
            return self._wires[:0]
        fit = self._estimator.fit(observation, self._estimator.moved)
        return np.setdiff1d(np.flatnonzero(self._gate.moved(fit, observation.count)), wanted)

    def _accept(
        self, status: NDArray[np.int64], members: Index, seen: Mask
    ) -> tuple[NDArray[np.int64], Mask]:
        """Make the current field the trusted field, unless an electrode is out of reach."""
        estimator = self._estimator
        if self._problem.out_of_reach(self._problem.rest + estimator.moved).any():
            return self._give_up(Status.ILL_CONDITIONED)
        self._trusted[:] = estimator.moved
        self._trusted_g[:] = estimator.g
        self._members, self._known, self._seen = members, True, seen
        held = np.ones(len(status), bool)
        held[members] = False
        held &= seen.any(axis=1)  # a wire without resistances may have moved
        return status, held

    def _give_up(self, status: Status) -> tuple[NDArray[np.int64], Mask]:
        self._known = False
        self._seen = np.zeros_like(self._seen)
        self._estimator.forget_factors()
        return np.full(len(self._wires), int(status)), np.zeros(len(self._wires), bool)

    # -- finding the maximum ---------------------------------------------------------------------------

    def _converge(self, observation: Observation, members: Index) -> bool:
        """Solve by tracking from the trusted field or, if tracking fails, by annealing from rest."""
        estimator = self._estimator
        estimator.moved[:] = self._trusted
        estimator.g[:] = self._trusted_g
        self._annealed = False
        hurry = self._seconds < math.inf  # annealing takes as long as several normal solves
        core = estimator.core.copy()

        def is_near_enough() -> bool:
            step = float(np.abs(estimator.moved - self._trusted).max())
            return step < self._far and self._hyper.is_outdated(core)

        if (self._known or hurry) and estimator.track(observation, members, is_near_enough):
            gone = float(np.abs(estimator.moved - self._compared).max())
            far = gone >= self._far or self._beyond_prior(observation, roots.SUSPICIOUS)
            if not far or hurry or self._anneal_and_compare(observation, members):
                return True
        self._hyper.spread(observation, members)
        self._annealed = True
        return estimator.anneal(observation, members)

    def _anneal_and_compare(self, observation: Observation, members: Index) -> bool:
        """Anneal from rest, and keep the tracked or the annealed field, whichever is more likely.

        This method is called after a large movement, because tracking can then end at a wrong maximum. The
        annealed field is based on equal expected loads over the whole patch. With discs, it is therefore
        compared with the maximum near the tracked field under the same prior. Unless the annealed field is
        clearly more likely, the discs stay in use and are fitted to data linearised at that maximum.
        """
        estimator = self._estimator
        self._compared[:] = estimator.moved
        tracked = estimator.moved.copy(), estimator.g.copy()
        discs = self._hyper.spread_as_seen(observation, members)
        annealed = estimator.anneal(observation, members)
        least = estimator.objective(observation)
        if annealed and discs is not None:
            other = estimator.moved.copy(), estimator.g.copy()
            estimator.moved[:], estimator.g[:] = tracked
            near = estimator.track(observation, members)
            if near and estimator.objective(observation) <= least + roots.LIKELIER:
                self._hyper.return_to(discs)
                return True
            estimator.moved[:], estimator.g[:] = other
            self._annealed = estimator.track(observation, members)
            return self._annealed
        self._annealed = annealed and least <= estimator.objective(observation, *tracked)
        if self._annealed:
            return True
        estimator.moved[:], estimator.g[:] = tracked
        return estimator.track(observation, members)

    def _refine(
        self, observation: Observation, readings: Readings, members: Index, *, local: bool
    ) -> Observation:
        """Adapt the hyperparameters; on a layout with folds, also choose between two maxima.

        Annealing with a prior that expects loads everywhere can lead to a wrong maximum. On layouts with
        folds, an annealed frame is therefore annealed again, with loads expected where they were found. The
        second field is kept if its −2 log posterior is lower by more than
        :data:`skinnode.solve.roots.LIKELIER`.
        """

        def observe(noise_factor: float) -> Observation:
            return self._model.observe(readings, noise_factor)

        estimator = self._estimator
        observation = self._hyper.adapt(observation, observe, members, local=local)
        if not (self._folded and self._annealed and local and self._seconds == math.inf):
            return observation
        first, before = (estimator.moved.copy(), estimator.g.copy()), estimator.objective(observation)
        annealed = estimator.anneal(observation, members)
        if annealed and estimator.objective(observation) < before - roots.LIKELIER:
            return self._hyper.adapt(observation, observe, members, local=True)
        estimator.moved[:], estimator.g[:] = first
        estimator.track(observation, members)
        return observation

    # -- the field -------------------------------------------------------------------------------------

    def _data_share(self) -> Float:
        """Return the data share (U, 3N) of each coordinate; 0 for coordinates that are not free."""
        prior, share = self._estimator.load_prior, np.zeros_like(self._trusted)
        share[:, self._free] = data_share(self._estimator.std, self._estimator.core, prior)
        return share

    def _field(
        self, observation: Observation, status: NDArray[np.int64], held: Mask, start: float
    ) -> FieldFrame:
        estimator, problem, pitch = self._estimator, self._problem, self.layout.pitch_m
        displacement = problem.displacement_m(problem.rest + self._trusted)
        std, core = np.zeros_like(self._trusted), np.zeros_like(self._trusted)
        std[:, self._free], core[:, self._free] = self._hyper.with_discs(estimator.std, estimator.core)
        if held.all():  # account for displacements too small for the gate to detect
            for each in (std, core):
                each[:, self._free] = np.maximum(each[:, self._free], 0.5 * self._overlooked)
        if self._contacts is not None and self._known and not held.all():
            self._force, self._contacts_found = self._contacts.find(
                self._hyper.loads.estimate(),
                displacement,
                (std * pitch).reshape(displacement.shape),
                *self._hyper.groups(),
            )
        std[:, self._free] = self._hyper.with_undetected(std[:, self._free])
        if not held.all():
            self._share = self._data_share()
        used = observation.weight > 0
        r = estimator.residuals(observation, self._trusted) / np.where(used, observation.weight, np.inf)
        rms = np.sqrt((r**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1))
        gains = self._trusted_g[: self._model.gains]
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
            data_share=self._share.reshape(displacement.shape),
            contacts=self._contacts_found if self._known else (),
            gain=np.broadcast_to(gains, len(held)).copy() if self._model.gains else None,
            noise_factor=self._hyper.noise_factor
            if self.noise_estimate is None
            else self.noise_estimate.factor,
        )
