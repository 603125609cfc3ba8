"""Hyperparameters of the posterior: the scale s of the prior, the expected load locations, and the noise.

All hyperparameters are estimated by maximising the marginal likelihood (evidence) of the frames (MacKay,
Neural Computation 4, 415, 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.load_posterior import LoadPosterior
from skinnode.solve.posterior.local import disc_claim
from skinnode.solve.posterior.local.disc_search import DiscPrior
from skinnode.solve.posterior.map_estimate import MapEstimator
from skinnode.solve.posterior.observation import Observation

SCALE_WORTH: Final = 2.0
"""Weight of the prior on s², as an equivalent number of parameters. The weight is small compared with the 100
to 200 parameters that the data typically determine."""
SCALE_REST: Final = 0.005
"""Expected prior scale s, in clearances. The value is typical of presses that indent the layer by a tenth of
its thickness."""
SCALE_MOST: Final = 1.0
"""Maximum prior scale s, in clearances. With a larger scale, the prior would allow the surface to be below
the lower layer."""
SCALE_STEP: Final = math.log(1.25)
"""Minimum change in ln s that triggers an update of the scale. The standard deviations change by a smaller
factor than the scale."""
SCALE_LEAST: Final = 1.0
"""Minimum prior scale, relative to the scale at which the expected changes in the resistances equal their
noise. Displacements below the noise cannot be detected, so the standard deviations must account for them."""
ADAPTIONS: Final = 5
"""Maximum number of hyperparameter updates per frame."""
DISC_FITS: Final = 2
"""Maximum number of disc fits per frame."""
DISC_REJECTIONS: Final = 2
"""Number of futile searches for discs after which a frame is solved without them. If no deformation explains
the readings, a frame is solved many times with different wires left out, and discs were searched for 24 times
in one frame."""
REFIT: Final = 0.1
"""Change in any coordinate since the last fit of the discs, relative to the largest displacement, above
which the discs are refitted."""
REFIT_NOISE: Final = 0.8
"""Noise of a frame, relative to that of the frame to which the discs were fitted, below which the discs are
refitted. The discs are also refitted if the noise increases by the reciprocal factor. As earlier frames are
included, the noise of a held touch falls; without a refit, the discs would remain those of the first, noisy
frame."""
RETRY: Final = 2.0
"""Growth of the largest displacement, in units of the noise, after which discs are tried again for a touch
whose loads were not found to be local. At the beginning of a slow press, noise hides where the loads are."""
UNTOUCHED: Final = 0.1
"""Load variance expected on untouched skin, relative to the minimum prior variance of equal loads over the
whole patch (:data:`SCALE_LEAST`)."""
FAR_LOADS: Final = 0.05
"""Standard deviation of the loads on untouched skin, relative to that of the strongest disc's loads. Far from
a contact, the skin does not move exactly like a half-space. With 0, the 95 % intervals contained 90 % of the
errors under ridges on a bonded layer; with 0.03, they contained 97 %."""
NOISY: Final = 2.0
"""Noise allowance added to the limit :data:`REFIT`, in standard deviations of the least certain
coordinate."""
MISFIT: Final = 3.0
"""Excess of a wire's χ² over its expected value, in standard deviations, above which the discs are refitted:
another body may have touched the skin where the discs expect no loads. Without this limit, the field under
such a press, 0.1 clearances deep, was wrong by 0.09 clearances (``tests/solve/test_disc_contacts.py``)."""
MISFIT_MORE: Final = 2.0
"""Minimum increase of this excess since the last fit for another fit. The excess stays large on a skin that
the layout does not describe exactly."""
REFINEMENTS: Final = 3
"""Maximum number of updates of the expected load locations per frame. Each update costs as much as two
solves."""
NOISE_WORTH: Final = 20.0
"""Weight of the configured noise in the noise estimate, as an equivalent number of resistances."""
NOISE_STEP: Final = math.log(1.1)
"""Minimum change in the logarithm of the estimated noise that triggers an update of the estimate."""

Observe = Callable[[float], Observation]
"""Function that returns the observation of a frame for a given noise factor."""


class Hyperparameters:
    """Prior scale, expected load locations and noise of one patch. Each stream needs its own instance.

    Args:
        estimator: MAP estimator of the patch.
        clearance: Median clearance, in pitches.
        scale2: Fixed s², in pitch²; None to estimate it.
        estimate_noise: Whether to estimate the noise.
        discs: Discs in which loads are expected; None to expect loads in the cells where they were found.

    Attributes:
        noise_factor: Ratio of the estimated to the configured noise.
        loads: Posterior of the loads.
    """

    def __init__(
        self,
        estimator: MapEstimator,
        clearance: float,
        scale2: float | None,
        estimate_noise: bool,
        discs: DiscPrior | None = None,
    ) -> None:
        self._estimator, self._prior = estimator, estimator.load_prior
        self.loads = LoadPosterior(estimator)
        self.discs = discs
        self._rough = False  # whether the discs were fitted only to a field estimated with the uniform prior
        self._fitted = np.zeros_like(estimator.moved)  # displacement to which the discs were fitted
        self._fitted_power = math.inf  # sum of 1/noise² over the readings to which the discs were fitted
        self._accepted: float | None = 0.0  # misfit of the first field after the last fit; None until then
        self._outdated = False  # whether the field has left the discs since it was last fitted
        self._rejected = math.inf  # largest displacement over noise when no discs were found
        self._may_retry = False  # whether this happened in an earlier frame
        self._rejections = 0  # number of times that this happened in this frame
        self._disc_loads = np.empty((2, 0)), 0.0  # load variances of the discs, and of untouched skin
        self._fixed, self._clearance = scale2, clearance
        self._estimate_noise = estimate_noise
        self._expected, self._most = (SCALE_REST * clearance) ** 2, (SCALE_MOST * clearance) ** 2
        self._signal = estimator.signal()
        self._least = self._expected
        self.noise_factor = 1.0

    def reset(self) -> None:
        """Discard the state of the stream, and reset the estimator."""
        self._estimator.reset(self._fixed or self._expected)
        self.loads.reset()
        self.noise_factor = 1.0
        self._least = self._expected
        self._forget_discs()

    def _forget_discs(self) -> None:
        self._outdated = False
        if self.discs is not None:
            self.discs.reset()

    def is_outdated(self, core: Float) -> bool:
        """Return whether the field has moved so far that :meth:`adapt` will fit the discs again.

        Args:
            core: (U, f) standard deviations of the last field for the 95 % interval, in pitches.
        """
        moved = self._estimator.moved
        change, top = float(np.abs(moved - self._fitted).max()), float(np.abs(moved).max())
        in_use = self.discs is not None and len(self.discs.discs) > 0
        self._outdated = in_use and self._has_moved(change, top, core)
        return self._outdated

    def groups(self) -> tuple[Index, Float]:
        """Return the groups of discs (:meth:`DiscPrior.groups`); without discs, there are none."""
        if self.discs is None:
            return np.zeros(self._prior.share.size, np.int64), np.zeros(1)
        return self.discs.groups()

    def with_discs(self, std: Float, core: Float) -> tuple[Float, Float]:
        """Return ``std`` and ``core`` (U, f), in pitches, including the uncertainty of the discs.

        ``std`` also accounts for an additional touch of the whole patch that is too light to detect. See
        :mod:`skinnode.solve.posterior.local.disc_claim`.
        """
        if self.discs is None or not len(self.discs.discs) or not np.isfinite(std).all():
            return std, core
        prior, estimator = self._prior, self._estimator
        spread = self.discs.spread.reshape(std.shape)
        own = estimator.noise_variance.reshape(std.shape)
        unseen = (std**2 - core**2) / (prior.doubt - prior.smooth_share)
        expected = (prior.scale2 * prior.covariance.diagonal()).reshape(std.shape)
        unknown = np.minimum(unseen / expected, 1.0)
        light = self._least * prior.uniform.diagonal().reshape(std.shape) * unknown
        share = disc_claim.prior_shares(estimator.moved, estimator.free, unknown, self.discs.discs)
        share = np.minimum(share, prior.doubt)
        return np.sqrt(std**2 + spread + light), np.sqrt(own + share * unseen + spread)

    def with_undetected(self, std: Float) -> Float:
        """Return ``std`` (U, f), in pitches, increased to account for an undetected local touch."""
        if self.discs is None:
            return std
        variance = disc_claim.undetected_variance(self._estimator.information(), self._clearance)
        return np.sqrt(std**2 + variance)

    def set_least(self, observation: Observation) -> None:
        """Begin a new frame: set the minimum prior scale from its noise."""
        self._may_retry, self._rejections = True, 0
        power = float((observation.weight**2 * self._signal).sum())
        count = np.count_nonzero(observation.weight)
        least = SCALE_LEAST**2 * count / power if power > 0 else math.inf
        self._least = min(least, self._most)

    def spread(self, observation: Observation, members: Index) -> None:
        """Expect equal loads over the whole patch, and estimate their scale from the frame."""
        self._forget_discs()
        self._prior.spread(self._fixed or self._expected)
        if self._fixed is None:
            self._prior.scale2 = self._bounded(self._estimator.guess_scale(observation, members))

    def spread_as_seen(self, observation: Observation, members: Index) -> Float | None:
        """Expect equal loads over the whole patch, at a scale estimated from the frame with the old prior.

        Returns:
            The discs in use, for :meth:`return_to`; None if there are none.
        """
        guess = self._fixed or self._bounded(self._estimator.guess_scale(observation, members))
        discs = None if self.discs is None or not len(self.discs.discs) else self.discs.discs
        self._forget_discs()
        self._prior.spread(guess)
        return discs

    def return_to(self, discs: Float) -> None:
        """Return to the prior before :meth:`spread_as_seen`.

        The next fit starts at the strongest disc alone, so that other discs are used only if they are still
        worthwhile.
        """
        assert self.discs is not None
        self.discs.discs = discs[[np.argmax(discs[:, 3])]]
        self._set_discs()
        self._rough = True

    def adapt(
        self, observation: Observation, observe: Observe, members: Index, *, local: bool
    ) -> Observation:
        """Estimate the hyperparameters from the field and solve again, until the estimates stop changing.

        Args:
            observation: The frame.
            observe: Function that returns the observation of the frame for another noise factor.
            members: Wires whose equations are used.
            local: Whether to estimate the expected load locations as well.

        Returns:
            The observation with the estimated noise.
        """
        estimator, prior = self._estimator, self._prior
        if not local and self._fixed is None and (prior.share != 1.0).any():
            self._forget_discs()
            prior.spread(self._expected)
            estimator.track(observation, members)
        refinements = REFINEMENTS if local else 0
        for _ in range(ADAPTIONS):
            moved, g, scale2 = estimator.moved.copy(), estimator.g.copy(), prior.scale2
            share, before = prior.share.copy(), observation
            changed = self._fixed is None and self._set_prior(observation, members, local, refinements)
            refinements -= 1
            found = self.noise_factor
            if self._estimate_noise:
                found = self._noise_found(observation, members)
                if abs(math.log(found / self.noise_factor)) > NOISE_STEP:
                    self.noise_factor = found
                    observation = observe(found)
                    changed = True
            if not changed:
                break
            if not (estimator.track(observation, members) or estimator.anneal(observation, members)):
                # restore the previous field and prior, but use the new noise in the next frame
                self.noise_factor = found
                estimator.moved[:], estimator.g[:], observation = moved, g, before
                if not prior.localise(scale2 * share):
                    prior.scale2 = scale2
                estimator.track(observation, members)
                break
        return observation

    def _set_prior(self, observation: Observation, members: Index, local: bool, refinements: int) -> bool:
        """Estimate the prior from the evidence; return whether it changed."""
        uniform = bool((self._prior.share == 1.0).all())
        if local and self.discs is not None and self._rejections < DISC_REJECTIONS:
            fits_left = refinements > REFINEMENTS - DISC_FITS
            cells = self._may_retry and fits_left and not (uniform or len(self.discs.discs))
            if cells and self._size(observation) > RETRY * self._rejected:
                self._prior.spread(self._prior.scale2)  # search for discs as in the first frame of a touch
                self._estimator.track(observation, members)
                uniform = True
            if uniform or len(self.discs.discs):
                return fits_left and self._fit_discs(observation, members, uniform)
        return self._set_scale(local=local, refine=refinements > 0)

    def _size(self, observation: Observation) -> float:
        """Return the largest displacement, in pitches, divided by the relative noise of all readings."""
        power = float((observation.weight**2).sum())
        return float(np.abs(self._estimator.moved).max()) * math.sqrt(power)

    def _fit_discs(self, observation: Observation, members: Index, uniform: bool) -> bool:
        """Fit the discs to the frame, unless they already fit; return whether the prior changed.

        The first discs of a touch are fitted to data linearised at a field that the uniform prior has
        blurred. They are therefore refitted to data linearised at the resulting field. If the noise has
        changed, the discs are refitted even if the field has not moved.
        """
        discs, prior, estimator = self.discs, self._prior, self._estimator
        assert discs is not None
        change = float(np.abs(estimator.moved - self._fitted).max())
        top = float(np.abs(estimator.moved).max())
        power = float((observation.weight**2).sum())
        if not power > 0.0:  # no reading is usable
            return False
        same_noise = REFIT_NOISE**2 <= power / self._fitted_power <= REFIT_NOISE**-2
        known = uniform or self._rough or self._outdated
        if same_noise and not (known or self._has_moved(change, top, estimator.core)):
            misfit = self._misfit(observation, members)
            if self._accepted is None:
                self._accepted = misfit
            if misfit <= max(MISFIT, self._accepted + MISFIT_MORE):
                return False
        self._outdated, self._accepted = False, None
        self._fitted[:], self._fitted_power = estimator.moved, power
        strongest = float(np.exp(2.0 * discs.discs[:, 3]).max()) if len(discs.discs) else 0.0
        untouched2 = max(UNTOUCHED * self._least, FAR_LOADS**2 * strongest)
        everywhere2 = prior.scale2 if uniform else self._expected
        variance = discs.fit(observation, members, untouched2, everywhere2, everywhere=uniform or self._rough)
        self._rough = uniform
        if variance is None:
            self._rejected, self._may_retry = top * math.sqrt(power), False
            self._rejections += 1
            prior.spread(everywhere2)
            estimator.track(observation, members)
            return self._set_scale(local=True, refine=True)
        self._disc_loads = np.minimum(variance, self._most), untouched2
        self._set_discs()
        return True

    def _misfit(self, observation: Observation, members: Index) -> float:
        """Return the largest excess of a wire's χ² over its expected value, in standard deviations."""
        square = (self._estimator.residuals(observation)[members] ** 2).sum(axis=1)
        count = np.count_nonzero(observation.weight[members], axis=1)
        return float(((square - count) / np.sqrt(2.0 * np.maximum(count, 1))).max())

    def _set_discs(self) -> None:
        assert self.discs is not None
        variance, untouched2 = self._disc_loads
        self._prior.set_discs(variance, self.discs.response_t, untouched2)

    def _has_moved(self, change: float, top: float, core: Float) -> bool:
        """Return whether the field has moved by more than the noise since the discs were fitted."""
        return change >= REFIT * top and change >= REFIT * top + NOISY * float(core.max())

    def _set_scale(self, *, local: bool, refine: bool) -> bool:
        """Estimate the scale and the load locations from the evidence; return whether the prior changed."""
        prior, changed = self._prior, False
        if local:
            variance = np.minimum(self.loads.expected(self._least), self._most)
            wanted = self._bounded(float(variance.mean()))
            changed = refine and prior.localise(variance)
        else:
            wanted = self._bounded(self._estimator.evidence_scale(SCALE_WORTH, self._expected))
        if not changed and abs(math.log(wanted / prior.scale2)) > 2.0 * SCALE_STEP:
            prior.scale2 = wanted
            changed = True
        return changed

    def _noise_found(self, observation: Observation, members: Index) -> float:
        """Return the noise factor for which the residuals are as large as expected (MacKay)."""
        residuals: Float = self._estimator.residuals(observation)
        total = float((residuals[members] ** 2).sum())
        count = float(np.count_nonzero(observation.weight[members]))
        left = max(count - self._estimator.gamma(), 0.0)
        return math.sqrt((self.noise_factor**2 * total + NOISE_WORTH) / (left + NOISE_WORTH))

    def _bounded(self, scale2: float) -> float:
        return min(max(scale2, self._least), self._most)
