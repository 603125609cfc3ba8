"""Fits soft load discs to a frame.

The data are linearised at the current displacement, and whitened with the covariance expected for untouched
skin, where all loads are equally small. The first disc is placed where a load, on a half-space or on a thin
bonded layer, matches the whitened data best, and is then fitted
(:mod:`skinnode.solve.posterior.local.discs`). Further discs are added where a load matches the remaining data
best, as long as the gain in evidence outweighs the additional parameters. A wide disc is replaced by two
smaller ones if these explain the data better. In a stream, the search starts from the discs of the last
frame.

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
from skinnode.solve.posterior.local.load_effects import LoadEffects, Room
from skinnode.solve.posterior.map_estimate import MapEstimator
from skinnode.solve.posterior.observation import Observation

EXPECTED: Final = 0.1
"""Expected amplitude a of a disc, in clearances per unit load."""
AMPLITUDE_MOST: Final = 1.6
"""Maximum ln a, relative to the expected value. A much larger load outside the patch could mimic a plate that
covers the whole patch."""
LAYER_RANGE: Final = (0.02, 5.0)
"""Minimum and maximum layer share β."""
BEYOND: Final = 1
"""Maximum distance of a disc's centre beyond the outermost electrodes, in cells."""
AMPLITUDES: Final = (-2.0, -1.0, 0.0, 1.0)
"""Values of ln a, relative to the expected value, at which the search for a new disc starts."""
SHAPES: Final = ((kernels.RADIUS, kernels.LAYER), (0.6, 4.0))
"""Radius R in cells and layer share β at which the search for a new disc starts: a contact on a half-space,
and one on a thin bonded layer, which moves the skin only near the body."""
REACH: Final = 1.7
"""Distance beyond a disc's radius up to which the effects of loads are computed, in cells. This leaves room
for a step in position or radius."""
EDGE: Final = 0.8
"""Distance beyond a disc's radius at which the load variance is a tenth of its value at the centre, in cells.
If the effects of any loads within this distance are missing, they are computed, and the search continues."""
EXTENSIONS: Final = 3
"""Maximum number of times that a search continues with more cells."""
ROUNDS: Final = 2
"""Maximum number of times that each of several discs is improved in a search."""
MOST: Final = 4
"""Number of discs at which the search is abandoned. Loads that require this many discs are not local."""
WIDE: Final = 3.0
"""Disc radius above which the search is abandoned, in cells. For large contacts and plates, the standard
deviations from discs would be too small."""
PAYS: Final = 2.0
"""Minimum gain in log evidence for adding another disc, in excess of the logarithm of the number of
parameters."""
YIELDS: Final = 1.0
"""Further gain expected when the other discs adapt to a new one. If the gain falls short of the minimum by no
more than this, it is recomputed with all discs refitted."""
NOTICED: Final = 8.0
"""Minimum squared match between a load and the remaining data at which another disc is tried, in noise
variances."""
SPLIT_RADIUS: Final = 0.7
"""Disc radius above which the search tries to replace the disc by two, in cells. If there are two bodies, the
first disc usually lies between them and covers both."""
SPLIT_RADII: Final = (0.4, 0.8)
"""Radii of the two discs at which this search starts, in cells."""
SPLIT_AMPLITUDES: Final = (0.4, 0.8, 1.2)
"""Their values of ln a, relative to that of the wide disc."""
SPLIT_LEAST: Final = 0.8
"""Minimum initial distance of the two discs from the centre of the loads of the wide disc, in cells."""
GROUP_LEAST: Final = 0.05
"""Minimum load variance of a disc in a group, summed over the disc's area, relative to the strongest disc."""
GROUP_GAP: Final = 1.0
"""Maximum gap between the discs of a group, in cells."""
GROUP_REACH: Final = 1.5
"""Maximum distance of a cell from the rim of its disc, in cells."""
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
        response_t: (4Q, U f) displacement per unit load: the four loads of each cell, in pitches.
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
        near = 1.0 / (1.0 + np.exp(np.minimum((gap - NEAR - kernels.SOFT) / kernels.SOFT, 40.0)))
        self._near = np.asarray(near)
        self._scratch = kernels.make_scratch(len(self._place))
        self._room = Room.of(len(self._place), estimator.equations)
        own = self._prior.response.reshape(len(layer), -1, 3)
        response = np.concatenate([own, layer[..., None]], axis=2).reshape(len(layer), -1)
        self.response_t = np.ascontiguousarray(response.T)
        self._probes = np.concatenate(
            [near[self._inside] @ self.response_t[2::LOADS], self.response_t[3::LOADS][self._inside]]
        )  # responses to the loads that are matched to the data
        self.discs: Float = np.empty((0, PARAMETERS))
        self._group: Index = np.empty(0, np.int64)  # number of the group of each disc; 0 if it is in none
        self._gain = np.empty(0)  # gain in log evidence due to each group, in nats
        self.spread = np.zeros(len(self._prior.response))

    def reset(self) -> None:
        """Discard the discs."""
        self.discs, self._gain = np.empty((0, PARAMETERS)), np.empty(0)
        self.spread[:] = 0.0

    def groups(self) -> tuple[Index, Float]:
        """Return the groups of discs, each of which may be a contact.

        Returns:
            (Q,) number of the group that contains each cell; 0 for other cells, and for all cells if there is
            only one disc. (G + 1,) gain in log evidence due to each group, in nats; the first value is the
            largest gain.
        """
        found = np.zeros(len(self._place), np.int64)
        if not len(self._gain):
            return found, np.zeros(1)
        gain = np.concatenate([[self._gain.max()], self._gain])
        if len(self._gain) > 1:
            beyond = np.linalg.norm(self._place[:, None] - self.discs[:, :2], axis=-1) - np.exp(
                self.discs[:, 2]
            )
            beyond[:, self._group == 0] = np.inf
            found = np.where(beyond.min(axis=1) < GROUP_REACH, self._group[beyond.argmin(axis=1)], 0)
        return found, gain

    def fit(
        self,
        observation: Observation,
        members: Index,
        untouched2: float,
        uniform2: float,
        *,
        everywhere: bool,
    ) -> Float | None:
        """Fit the discs to a frame, and return the load variances (2, Q), in pitch².

        The estimator's factors are overwritten. The first discs of a touch have no :attr:`spread`, because
        they are fitted again.

        Args:
            observation: The frame.
            members: Wires whose equations are used.
            untouched2: s² of the loads on untouched skin, in pitch².
            uniform2: s² of equal loads over the whole patch, in pitch².
            everywhere: Whether the discs are new. If so, another disc is tried wherever a load matches the
                remaining data best. Otherwise, discs beyond the current ones are tried only if the match
                exceeds :data:`NOTICED`.

        Returns:
            The variances; None if the loads are not local.
        """
        estimator, first = self._estimator, not len(self.discs)
        estimator.linearise(observation, members)
        least = estimator.factorise_uniform(observation, uniform2) if first else -math.inf
        own = estimator.factorise_uniform(observation, untouched2)
        data = estimator.whitened_data()
        search = _Search(self, data, everywhere=everywhere)
        discs = search.start(self.discs)
        rejected: tuple[Float, float] | None = None
        while True:
            places, beyond = search.places_of_next(discs)
            if not len(places):
                break
            more, gain = search.with_disc_at(places, discs, beyond=beyond)
            excess = gain - PAYS - math.log(PARAMETERS * len(more))
            if not excess > 0.0:
                rejected = more, excess
                break
            discs = more
            if len(discs) > 1 and _all_wide(discs):
                break
        if own + search.evidence >= least:
            discs = search.with_wide_discs_split(discs)
        wide = len(discs) == MOST or bool((discs[:, 2] > math.log(WIDE)).any())
        if own + search.evidence < least or not len(discs) or wide:
            self.reset()
            return None
        self.discs = discs
        self._group, self._gain = search.grouped(discs)
        self.spread[:] = 0.0
        if not first:
            search.measure_spread(discs)
        if rejected is not None and not first:
            search.add_spread_of_rejected(discs, *rejected)
        variance = np.empty((2, len(self._place)))
        kernels.add_variance(discs, self._place, variance)
        return variance


def _all_wide(discs: Float) -> bool:
    """Return whether every disc is too wide to be used, so that a further search would be futile."""
    return bool((discs[:, 2] > math.log(WIDE)).all())


class _Search:
    """Search for the discs of one frame, using the estimator's current whitened data."""

    def __init__(self, prior: DiscPrior, data: Float, *, everywhere: bool) -> None:
        self._p, self._data, self._everywhere = prior, data, everywhere
        self._loads = LoadEffects(prior._estimator, prior._place, prior.response_t, data, prior._room)
        self._unit = np.zeros(2)
        self.evidence = 0.0

    def start(self, discs: Float) -> Float:
        """Return the discs of the last frame, refitted to this frame."""
        if len(discs):
            discs = self._fitted(discs)
            if not self._everywhere:
                self._set_unit(discs[0, :2])
        return discs

    def places_of_next(self, discs: Float) -> tuple[Float, bool]:
        """Return cells (P, 2) where another disc may be needed, and whether they are beyond the discs.

        There are none if no disc is needed. If there are two cells, a load on a half-space matches the
        remaining data best in one of them, and a load on a bonded layer in the other. If no match is noticed,
        but the discs are from an earlier field, the cells are inside the discs, whose loads may have become
        unequal.
        """
        p = self._p
        if len(discs) == MOST:
            return np.empty((0, 2)), False
        left = self._data
        if len(discs):
            left = left - self._loads.mean(discs, p._scratch)[0] @ self._loads.rows_t
        matches, places = np.abs(p._estimator.match(left, p._probes)).reshape(2, -1), p._place[p._inside]
        best, beyond = np.argmax(matches, axis=1), True
        if len(discs):
            noticed = matches[[0, 1], best] ** 2 >= NOTICED * self._unit
            beyond = self._everywhere or bool(noticed.any())
            best = best[noticed]
        if not beyond:
            square = ((places[:, None] - discs[:, :2]) ** 2).sum(axis=-1)
            within = (square <= np.exp(2.0 * discs[:, 2])).any(axis=1)
            best = np.argmax(np.where(within, matches, 0.0), axis=1)
        return places[np.unique(best)], beyond

    def with_disc_at(self, places: Float, discs: Float, *, beyond: bool) -> tuple[Float, float]:
        """Return ``discs`` with another disc near one of ``places``, and the resulting gain in evidence.

        The other discs are refitted only if the new disc might be worthwhile. If ``places`` are not
        ``beyond`` the discs, no further cells are used.
        """
        p, before = self._p, self.evidence
        own = self._loads.near(places, np.full(len(places), kernels.RADIUS + REACH), include=beyond)
        if not len(discs):
            self._set_unit(places[0])
        effects = self._loads.given(discs, own, p._scratch) if len(discs) else self._loads.effects
        trials = [
            np.array([[*place, math.log(radius), p._amplitude + more, math.log(layer)]])
            for place in places
            for radius, layer in SHAPES
            for more in AMPLITUDES
        ]
        first = max(trials, key=lambda trial: kernels.evidence(trial, effects, p._scratch))
        if not len(discs):
            found = self._fitted(first)
            gain = self.evidence - before
        else:
            more, gain = self._climb(first, effects)
            found = np.vstack([discs, more])
            if gain > PAYS + math.log(PARAMETERS * len(found)) - YIELDS and not _all_wide(found):
                found = self._fitted(found)
                gain = self.evidence - before
        if not gain > PAYS + math.log(PARAMETERS * len(found)):
            self.evidence = before
        return found, gain

    def with_wide_discs_split(self, discs: Float) -> Float:
        """Return ``discs``, each wide one replaced by two smaller ones if this is worthwhile."""
        for disc in discs[discs[:, 2] > math.log(SPLIT_RADIUS)]:
            same = (discs == disc).all(axis=1)  # none after a split that changed this disc, too
            if len(discs) < MOST - 1 and same.any():
                found = self._split(discs, int(np.argmax(same)))
                discs = discs if found is None else found
        return discs

    def _split(self, discs: Float, d: int) -> Float | None:
        """Return the discs with disc ``d`` replaced by two; None if this is not worthwhile.

        The two discs start on the main axis of the mean loads in the wide disc.
        """
        p, loads, wide, others = self._p, self._loads, discs[d], np.delete(discs, d, axis=0)
        square = (loads.mean(discs, p._scratch)[0].reshape(-1, LOADS) ** 2).sum(axis=1)
        place = loads.effects.place
        square[((place - wide[:2]) ** 2).sum(axis=1) > (math.exp(wide[2]) + EDGE) ** 2] = 0.0
        if not square.any():
            return None
        centre = square @ place / square.sum()
        spread = (place - centre).T @ (square[:, None] * (place - centre)) / square.sum()
        values, axes = np.linalg.eigh(spread)
        away = max(math.sqrt(values[1]), SPLIT_LEAST) * axes[:, 1]
        places = np.clip([centre - away, centre + away], p._bounds[0, :2], p._bounds[1, :2])
        effects, before, alone = loads.effects, self.evidence, self.evidence
        if len(others):
            own = loads.near(wide[None, :2], np.exp(wide[None, 2]) + REACH)
            effects = loads.given(others, own, p._scratch)
            alone = kernels.evidence(wide[None], effects, p._scratch)
            alone += kernels.log_prior(wide[None], p._amplitude)
        trials = [
            np.column_stack([places, np.tile([math.log(radius), wide[3] + more, wide[4]], (2, 1))])
            for radius in SPLIT_RADII
            for more in SPLIT_AMPLITUDES
        ]
        for trial in trials:
            trial[:, 3] = np.minimum(trial[:, 3], p._bounds[1, 3])
        pair, found = self._climb(
            max(trials, key=lambda t: kernels.evidence(t, effects, p._scratch)), effects
        )
        least = PAYS + math.log(PARAMETERS * (len(discs) + 1))
        if found - alone > least - YIELDS:
            result = self._fitted(np.vstack([others, pair]))
            if self.evidence - before > least:
                return result
        self.evidence = before
        return None

    def _set_unit(self, place: Float) -> None:
        """Compute the noise variance of the match for loads like those at ``place``."""
        p, rows_t = self._p, self._loads.rows_t
        near = p._near[np.argmin(((p._place - place) ** 2).sum(axis=1))][self._loads.cells]
        self._unit[0] = ((near @ rows_t[2::LOADS]) ** 2).sum()
        self._unit[1] = (rows_t[3::LOADS] ** 2).sum(axis=1).max()

    def _fitted(self, discs: Float) -> Float:
        """Return the discs with the largest evidence near ``discs``."""
        loads = self._loads
        loads.near(discs[:, :2], np.exp(discs[:, 2]) + REACH)
        for _ in range(EXTENSIONS):
            discs = self._improved(discs)
            known = loads.cells.size
            loads.near(discs[:, :2], np.exp(discs[:, 2]) + EDGE)
            if loads.cells.size == known:
                break
        return discs

    def _improved(self, discs: Float) -> Float:
        """Return the discs after a search that uses only the cells whose effects have been computed.

        Several discs are improved in turn, each given the others.
        """
        p, loads = self._p, self._loads
        if len(discs) == 1:
            discs, self.evidence = self._climb(discs, loads.effects)
            return discs
        discs = discs.copy()
        for _ in range(ROUNDS):
            before = discs.copy()
            for d in range(len(discs)):
                own = loads.near(discs[[d], :2], np.exp(discs[[d], 2]) + REACH)
                others = np.delete(discs, d, axis=0)
                discs[[d]], _ = self._climb(discs[[d]], loads.given(others, own, p._scratch))
            if (discs == before).all():
                break
        self.evidence = kernels.evidence(discs, loads.effects, p._scratch)
        self.evidence += kernels.log_prior(discs, p._amplitude)
        return discs

    def _climb(self, discs: Float, effects: Effects) -> tuple[Float, float]:
        p, found = self._p, discs.copy()
        work = np.empty((3, *found.shape))
        evidence = kernels.climb(found, effects, p._amplitude, p._bounds, work, p._scratch)
        return found, evidence

    def grouped(self, discs: Float) -> tuple[Index, Float]:
        """Return each disc's group number (D,), and the gain (G,) in log evidence due to each group, in nats.

        Discs that nearly touch form a group. Discs that are much weaker than the strongest are in group 0.
        """
        p, loads, radius = self._p, self._loads, np.exp(discs[:, 2])
        power = np.exp(2.0 * (discs[:, 2] + discs[:, 3]))
        strong = power > GROUP_LEAST * power.max()
        gap = np.linalg.norm(discs[:, None, :2] - discs[:, :2], axis=-1)
        near = (gap < radius[:, None] + radius + GROUP_GAP) & strong & strong[:, None]
        for _ in discs:
            near = near @ near
        first = near.argmax(axis=1)  # first disc of each disc's group
        numbers = np.unique(first[strong])
        group = np.where(strong, np.searchsorted(numbers, first) + 1, 0)
        gain = np.empty(len(numbers))
        for number in range(len(numbers)):
            rest = discs[group != number + 1]
            left = kernels.evidence(rest, loads.effects, p._scratch) + kernels.log_prior(rest, p._amplitude)
            gain[number] = self.evidence - left
        return group, gain

    def add_spread_of_rejected(self, discs: Float, more: Float, excess: float) -> None:
        """Add the variance due to a rejected disc that may nevertheless exist."""
        p, loads = self._p, self._loads
        change = loads.mean(more, p._scratch)[0] - loads.mean(discs, p._scratch)[0]
        chance = 1.0 / (1.0 + math.exp(-excess))
        p.spread += chance * (1.0 - chance) * (change @ loads.response_t()) ** 2

    def measure_spread(self, discs: Float) -> None:
        """Add the variance of the displacement due to the uncertainty of each disc parameter.

        The displacement is averaged over three values of the parameter, weighted by their evidence.
        """
        p, loads = self._p, self._loads
        own, best = loads.mean(discs, p._scratch)
        best += kernels.log_prior(discs, p._amplitude)
        weight, change = np.ones((discs.size, 3)), np.empty((discs.size, 2, own.size))
        for i in range(discs.size):
            for side, sign in enumerate((1.0, -1.0)):
                trial = discs.copy()
                trial.ravel()[i] += sign * STEPS[i % PARAMETERS]
                other, found = loads.mean(trial, p._scratch)
                found += kernels.log_prior(trial, p._amplitude)
                change[i, side] = other - own
                weight[i, 1 + side] = math.exp(min(found - best, 0.0))
        weight /= weight.sum(axis=1, keepdims=True)
        moved = np.empty((2 * discs.size, len(p.spread)))
        multiply(change.reshape(len(moved), -1), loads.response_t(), moved)
        shift = np.zeros((discs.size, 3, len(p.spread)))
        shift[:, 1:] = moved.reshape(discs.size, 2, -1)
        shift -= np.einsum("pi,piu->pu", weight, shift)[:, None]
        p.spread += np.einsum("pi,piu->u", weight, shift**2)
