"""Posterior of the loads on a patch: their mean and covariance, and the significant loads of a frame.

All results use the current factors of a :class:`skinnode.solve.posterior.map_estimate.MapEstimator`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.posterior.contacts import LoadEstimate
from skinnode.solve.posterior.map_estimate import MapEstimator

LOCAL_SIGNIFICANT: Final = 4.0
"""Minimum squared significance, in squared standard deviations, for a load to be considered detected."""
LOCAL_CERTAIN: Final = 100.0
"""Minimum squared significance, in squared standard deviations, for a press to be considered certain. With a
value of 25 and high noise, the first load locations are unreliable and errors are 1 % larger. With values of
1000 and above, on layouts with low sensitivity (`aligned`), half of the expected load is still spread over
the whole patch, which increases errors by 14 %."""


class LoadPosterior:
    """Posterior of the loads on one patch, for the frame that the estimator solved last.

    Args:
        estimator: Estimator of the patch.
    """

    def __init__(self, estimator: MapEstimator) -> None:
        self._estimator, self._prior = estimator, estimator.load_prior
        loads = self._prior.response.shape[1]
        self._whitened = np.empty((estimator.equations, loads))
        self._ones = np.ones(estimator.equations)
        self._stiffness = np.empty(loads)
        self._factors = -1  # serial number of the factors from which the cached arrays were computed

    def estimate(self) -> LoadEstimate:
        """Return the loads and their covariance; the arrays are valid until the next frame."""
        rows, prior = self._whiten(), self._prior
        return LoadEstimate(self.mean(), rows, self._ones[: len(rows)], prior.share, prior.scale2)

    def mean(self) -> Float:
        """Return the mean loads (Q, 3) for the current displacement, in units of the prior's loads."""
        return self._prior.loads(self._estimator.free_displacement())

    def expected(self, least: float) -> Float:
        """Return the load variances (Q,) in pitch² that the loads of the frame imply, at least ``least``.

        Without its own prior, a load has the estimate q / (s² k) and the variance 1/k − s², where k is the
        increase in χ² per unit of the load (Tipping and Faul, Fast marginal likelihood maximisation for
        sparse Bayesian models, 2003).
        """
        prior = self._prior
        found = np.empty(len(prior.share))
        self._whiten()
        own = prior.scale2 * prior.share
        most = _found(self.mean(), own, self._stiffness, LOCAL_SIGNIFICANT, found)
        return prior.expected(found, least, certain=most > LOCAL_CERTAIN)

    def _whiten(self) -> Float:
        """Return L⁻¹ J G (m, 3Q) for the current factors, and update k of each load."""
        rows = self._whitened[: self._estimator.factored_rows]
        if self._factors != self._estimator.factors:
            self._factors = self._estimator.factors
            self._estimator.whiten(self._prior.response, rows)
            self._stiffness[:] = np.maximum(np.einsum("mq,mq->q", rows, rows), 1e-300)
        return rows


@njit
def _found(q: Float, own: Float, stiffness: Float, significant: float, found: Float) -> float:
    """Write the largest squared load of each cell, estimated without its own prior, into ``found`` (Q,).

    For loads below the significance threshold, 0 is written. ``q`` (Q, 3) contains the loads, ``own`` (Q,)
    their prior variances and ``stiffness`` (3Q,) their k. Returns the largest ratio of a squared load to its
    noise variance.
    """
    most = 0.0
    for cell in range(found.size):
        found[cell] = 0.0
        for i in range(3):
            k = stiffness[3 * cell + i]
            alone = q[cell, i] / (own[cell] * k)
            noise = max(1.0 / k - own[cell], 0.0)
            if alone * alone > significant * noise:
                found[cell] = max(found[cell], alone * alone - noise)
                most = max(most, alone * alone / noise if noise > 0.0 else math.inf)
    return most
