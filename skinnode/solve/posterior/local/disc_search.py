"""Fits soft load discs to a frame.

The data are linearised at the current displacement, and whitened with the covariance expected on an
untouched skin, whose loads are equally small everywhere. The first disc is placed where a load, on a half-
space or on a thin bonded layer, matches the whitened data best, and is then fitted
(:mod:`skinnode.solve.posterior.local.discs`). Further discs are added where a load matches the remaining
data best, as long as the gain in evidence outweighs the additional parameters. In a stream, the search
starts at the discs of the last frame.

No disc is used if equal loads over the whole patch explain the frame better than the discs, or if the loads
require many or large discs.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import multiply
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.load_cells import MARGIN
from skinnode.solve.posterior.local import discs as kernels
from skinnode.solve.posterior.local.discs import LOADS, PARAMETERS, STEPS, Effects
from skinnode.solve.posterior.map_estimate import MapEstimator
from skinnode.solve.posterior.observation import Observation

EXPECTED: Final = 0.1
"""Expected amplitude a of a disc, in clearances per unit load."""
AMPLITUDE_MOST: Final = 1.6
"""Maximum ln a, relative to the expected value. A much larger load outside the patch could imitate a plate
over the whole patch."""
LAYER_RANGE: Final = (0.02, 5.0)
"""Minimum and maximum layer share β."""
BEYOND: Final = 1
"""Maximum distance of a disc's centre beyond the outermost electrodes, in cells."""
AMPLITUDES: Final = (-2.0, -1.0, 0.0, 1.0)
"""Values of ln a, relative to the expected value, at which the search for a new disc starts."""
SHAPES: Final = ((kernels.RADIUS, kernels.LAYER), (0.6, 4.0))
"""Radius R in cells and layer share β at which the search for a new disc starts: a contact on a half-space,
and one on a thin bonded layer, which moves the skin only near the body."""
REACH: Final = 4.5
"""Radius around the start of a search within which the effects of loads are computed, in cells."""
MOST: Final = 4
"""Number of discs at which the search is abandoned. Loads that require this many discs are not local."""
WIDE: Final = 3.0
"""Disc radius above which the search is abandoned, in cells. For large contacts and plates, the standard
deviations from discs would be too small."""
PAYS: Final = 2.0
"""Minimum gain in log evidence for adding another disc, in excess of the logarithm of the number of
parameters."""
NOTICED: Final = 8.0
"""Minimum squared match between a load and the remaining data at which another disc is tried, in noise
variances."""
NEAR: Final = 1.0
"""Radius of the discs that are matched to the data to find a starting point, in cells."""


class DiscPrior:
    """Discs that model the expected loads on one patch. Each stream needs its own instance.

    Args:
        estimator: MAP estimator of the patch.
        shape: Numbers of cells across and along the wires.
        clearance: Median clearance, in pitches.
        layer: (U f, Q) displacement per unit load on a bonded layer, in pitches.

    Attributes:
        discs: (D, 5) row, column, ln R, ln a and ln β of each disc.
        spread: (U f,) variance of the displacement due to the uncertainty of the discs, in pitch².
    """

    def __init__(
        self, estimator: MapEstimator, shape: tuple[int, int], clearance: float, layer: Float
    ) -> None:
        self._estimator, self._prior = estimator, estimator.load_prior
        self._place = np.ascontiguousarray(np.indices(shape).reshape(2, -1).T, np.float64)
        self._amplitude = math.log(EXPECTED * clearance)
        low, high = np.log(kernels.RADIUS_RANGE)
        first, last = MARGIN - BEYOND, np.array(shape) - 1 - MARGIN + BEYOND
        self._bounds = np.array(
            [
                [first, first, low, -math.inf, math.log(LAYER_RANGE[0])],
                [*last, high, self._amplitude + AMPLITUDE_MOST, math.log(LAYER_RANGE[1])],
            ]
        )
        self._inside = ((self._place >= self._bounds[0, :2]) & (self._place <= self._bounds[1, :2])).all(
            axis=1
        )
        gap = np.linalg.norm(self._place[:, None] - self._place, axis=-1)
        self._near = np.asarray(
            1.0 / (1.0 + np.exp(np.minimum((gap - NEAR - kernels.SOFT) / kernels.SOFT, 40.0)))
        )
        self._scratch = kernels.make_scratch(len(self._place))
        self.layer = layer
        own = self._prior.response.reshape(len(layer), -1, 3)
        self._response = np.concatenate([own, layer[..., None]], axis=2).reshape(len(layer), -1)
        self._response_t = np.ascontiguousarray(self._response.T)
        self.discs: Float = np.empty((0, PARAMETERS))
        self.spread = np.zeros(len(self._prior.response))

    def reset(self) -> None:
        """Discard the discs."""
        self.discs = np.empty((0, PARAMETERS))
        self.spread[:] = 0.0

    def fit(
        self,
        observation: Observation,
        members: Index,
        untouched2: float,
        uniform2: float,
        *,
        spread: bool,
    ) -> Float | None:
        """Fit the discs to a frame, and return the load variances (2, Q), in pitch².

        The estimator's factors are overwritten.

        Args:
            observation: The frame.
            members: Wires whose equations are used.
            untouched2: s² of the loads on untouched skin, in pitch².
            uniform2: s² of equal loads over the whole patch, in pitch².
            spread: Whether to compute :attr:`spread` as well.

        Returns:
            The variances; None if the loads are not local.
        """
        estimator = self._estimator
        estimator.linearise(observation, members)
        least = estimator.factorise_uniform(observation, uniform2) if not len(self.discs) else -math.inf
        own = estimator.factorise_uniform(observation, untouched2)
        data = estimator.whitened_data()
        search = _Search(self, data)
        discs = search.start(self.discs)
        rejected: tuple[Float, float] | None = None
        while True:
            places = search.places_of_next(discs)
            if not len(places):
                break
            more, gain = search.with_disc_at(places, discs)
            excess = gain - PAYS - math.log(PARAMETERS * len(more))
            if not excess > 0.0:
                rejected = more, excess
                break
            discs = more
        wide = len(discs) == MOST or bool((discs[:, 2] > math.log(WIDE)).any())
        if own + search.evidence < least or not len(discs) or wide:
            self.reset()
            return None
        self.discs = discs
        self.spread[:] = 0.0
        if spread:
            search.measure_spread(discs)
        if spread and rejected is not None:
            search.add_spread_of_rejected(discs, *rejected)
        variance = np.empty((2, len(self._place)))
        kernels.add_variance(discs, self._place, variance)
        return variance


class _Search:
    """Search for the discs of one frame, using the estimator's current whitened data."""

    def __init__(self, prior: DiscPrior, data: Float) -> None:
        self._p, self._data = prior, data
        self._estimator = prior._estimator
        self._cells: Index = np.arange(0)
        self._rows = np.empty((len(data), 0))
        self._effects = Effects(np.empty((0, 2)), np.empty((0, 0)), np.empty(0))
        self._match = self._estimator.match(data, prior._response_t)
        self._unit = np.zeros(2)
        self.evidence = 0.0

    def start(self, discs: Float) -> Float:
        """Return the discs of the last frame, refitted to this frame."""
        if not len(discs):
            return discs
        self._include(discs[:, :2])
        return self._climb(discs, 0)

    def places_of_next(self, discs: Float) -> Float:
        """Return the cells (P, 2) where another disc may be needed; none if no disc is needed.

        In one of these cells, a load on a half-space matches the remaining data best; in the other, a load on
        a bonded layer does.
        """
        if len(discs) == MOST:
            return np.empty((0, 2))
        left = self._match
        if len(discs):
            q = np.empty(self._effects.match.size)
            kernels.mean_loads(discs, self._effects, self._p._scratch, q)
            left = self._estimator.match(self._data - self._rows @ q, self._p._response_t)
        matches = np.abs([self._p._near @ left[2::LOADS], left[3::LOADS]])
        best = np.argmax(np.where(self._p._inside, matches, 0.0), axis=1)
        if len(discs):
            noticed = matches[[0, 1], best] ** 2 >= NOTICED * self._unit
            best = best[noticed]
        return np.asarray(self._p._place[np.unique(best)])

    def with_disc_at(self, places: Float, discs: Float) -> tuple[Float, float]:
        """Return ``discs`` with another disc near one of ``places``, and the resulting gain in evidence."""
        p, before = self._p, self.evidence
        self._include(places)
        if not len(discs):
            near = p._near[np.argmin(((p._place - places[0]) ** 2).sum(axis=1))][self._cells]
            gram = self._effects.gram
            self._unit[:] = near @ gram[2::LOADS, 2::LOADS] @ near, gram.diagonal()[3::LOADS].max()
        trials = [
            np.vstack([discs, [*place, math.log(radius), p._amplitude + more, math.log(layer)]])
            for place in places
            for radius, layer in SHAPES
            for more in AMPLITUDES
        ]
        first = max(trials, key=lambda trial: kernels.evidence(trial, self._effects, p._scratch))
        found = self._climb(first, len(discs))
        gain = self.evidence - before
        if len(discs) and gain > PAYS + math.log(PARAMETERS * len(found)):
            found = self._climb(found, 0)
            gain = self.evidence - before
        if not gain > PAYS + math.log(PARAMETERS * len(found)):
            self.evidence = before
        return found, gain

    def _climb(self, discs: Float, first: int) -> Float:
        p, found = self._p, discs.copy()
        self.evidence = kernels.climb(
            found, first, self._effects, p._amplitude, p._bounds, found.copy(), p._scratch
        )
        return found

    def _include(self, places: Float) -> None:
        """Compute the effects of loads on the cells near ``places`` (P, 2)."""
        p = self._p
        gap = np.linalg.norm(p._place[:, None] - places, axis=-1).min(axis=1)
        fresh = np.setdiff1d(np.flatnonzero(gap <= REACH), self._cells)
        if not fresh.size:
            return
        self._cells = np.concatenate([self._cells, fresh])
        columns = (LOADS * fresh[:, None] + np.arange(LOADS)).ravel()
        rows = np.empty((len(self._data), columns.size))
        self._estimator.whiten(np.ascontiguousarray(p._response[:, columns]), rows)
        self._rows = np.hstack([self._rows, rows])
        gram = np.empty((self._rows.shape[1], self._rows.shape[1]))
        multiply(np.ascontiguousarray(self._rows.T), self._rows, gram)
        every = (LOADS * self._cells[:, None] + np.arange(LOADS)).ravel()
        self._effects = Effects(
            np.ascontiguousarray(p._place[self._cells]), gram, np.ascontiguousarray(self._match[every])
        )

    def add_spread_of_rejected(self, discs: Float, more: Float, excess: float) -> None:
        """Add the variance due to a rejected disc that may nevertheless exist."""
        p, effects = self._p, self._effects
        own, other = np.empty((2, effects.match.size))
        kernels.mean_loads(discs, effects, p._scratch, own)
        kernels.mean_loads(more, effects, p._scratch, other)
        columns = (LOADS * self._cells[:, None] + np.arange(LOADS)).ravel()
        chance = 1.0 / (1.0 + math.exp(-excess))
        p.spread += chance * (1.0 - chance) * (p._response[:, columns] @ (other - own)) ** 2

    def measure_spread(self, discs: Float) -> None:
        """Add the variance of the displacement due to the uncertainty of each disc parameter."""
        p, effects = self._p, self._effects
        own, other = np.empty((2, effects.match.size))
        columns = (LOADS * self._cells[:, None] + np.arange(LOADS)).ravel()
        response = p._response[:, columns]
        best = kernels.mean_loads(discs, effects, p._scratch, own)
        best += kernels.log_prior(discs, p._amplitude)
        for d in range(len(discs)):
            for parameter in range(PARAMETERS):
                weights, shifts = [1.0], [np.zeros(len(response))]
                for sign in (1.0, -1.0):
                    trial = discs.copy()
                    trial[d, parameter] += sign * STEPS[parameter]
                    found = kernels.mean_loads(trial, effects, p._scratch, other)
                    found += kernels.log_prior(trial, p._amplitude)
                    weights.append(math.exp(min(found - best, 0.0)))
                    shifts.append(response @ (other - own))
                weight, shift = np.array(weights) / sum(weights), np.array(shifts)
                p.spread += weight @ (shift - weight @ shift) ** 2
