"""Posterior of the loads on a patch: mean, covariance, and the loads that are significant in a frame.

All results refer to the current factors of a :class:`skinnode.solve.posterior.map_estimate.MapEstimator`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.contacts import LoadEstimate
from skinnode.solve.posterior.map_estimate import MapEstimator

LOCAL_SIGNIFICANT: Final = 4.0
"""Minimum ratio of a squared load to its noise variance for the load to be detected."""
LOCAL_CERTAIN: Final = 100.0
"""Minimum ratio of a squared load to its noise variance for a press to be certain. In tests, displacement
errors were 1 % larger with a value of 25 (at high noise), and 14 % larger with 1000 or more (on `aligned`
layouts)."""


class LoadPosterior:
    """Posterior of the loads on one patch in the last frame solved by the estimator.

    Args:
        estimator: Estimator of the patch.
    """

    def __init__(self, estimator: MapEstimator) -> None:
        self._estimator, self._prior = estimator, estimator.load_prior
        loads = self._prior.response.shape[1]
        self._ones = np.ones(estimator.equations)
        self._stiffness = np.empty(loads)
        self.reset()

    def reset(self) -> None:
        """Free the memory used by the last frame's covariance."""
        self._whitened = np.empty((0, self._stiffness.size))
        self._factors = -1  # serial number of the factors to which the cached columns belong
        self._known = np.zeros(self._stiffness.size, bool)  # columns that have been computed
        self._stiffness_known = False

    def estimate(self) -> LoadEstimate:
        """Return the loads and their covariance. The arrays are valid until the next frame."""
        prior, rows = self._prior, self._rows()
        if not self._known[2::3].all():
            normal = np.empty((len(rows), len(prior.share)))
            self._estimator.whiten(prior.normal_response, normal)
            rows[:, 2::3], self._known[2::3] = normal, True
        ones = self._ones[: len(rows)]
        return LoadEstimate(self.mean(), rows, ones, prior.share, prior.scale2, prior.doubt, self._add_shear)

    def mean(self) -> Float:
        """Return the mean loads (Q, 3) for the current displacement, in units of the prior's loads."""
        return self._prior.loads(self._estimator.free_displacement())

    def expected(self, least: float) -> Float:
        """Return the prior variances (Q,) of the loads for the next solve, in pitch², at least ``least``.

        Let k = Σ (L⁻¹ J G)² be the sensitivity of the data to a load with posterior mean q and prior variance
        s². Without its own prior, the estimate of the load is q / (s² k), with variance 1/k − s² (Tipping and
        Faul, Fast marginal likelihood maximisation for sparse Bayesian models, 2003).
        """
        prior = self._prior
        found = np.empty(len(prior.share))
        self._whiten()
        own = prior.scale2 * prior.share
        most = _found(self.mean(), own, self._stiffness, LOCAL_SIGNIFICANT, found)
        return prior.expected(found, least, certain=most > LOCAL_CERTAIN)

    def _whiten(self) -> Float:
        """Return L⁻¹ J G (m, 3Q) for the current factors, and update the sensitivity k to each load."""
        rows = self._rows()
        if not self._stiffness_known:
            self._estimator.whiten(self._prior.response, rows)
            self._known[:] = self._stiffness_known = True
            self._stiffness[:] = np.maximum(np.einsum("mq,mq->q", rows, rows), 1e-300)
        return rows

    def _add_shear(self, cells: Index) -> None:
        """Add the shear loads of ``cells`` to the covariance of the last :meth:`estimate`."""
        fresh = cells[~self._known[3 * cells]]
        if not fresh.size:
            return
        rows, response_t = self._rows(), self._prior.response_t
        some = response_t.reshape(-1, 3, response_t.shape[1])[fresh, :2].reshape(2 * fresh.size, -1)
        shear = np.empty((len(rows), len(some)))
        self._estimator.whiten(np.ascontiguousarray(some.T), shear)
        rows.reshape(len(rows), -1, 3)[:, fresh, :2] = shear.reshape(len(rows), -1, 2)
        self._known[3 * fresh] = self._known[3 * fresh + 1] = True

    def _rows(self) -> Float:
        """Return the array (m, 3Q) for L⁻¹ J G; its columns are invalid if the factors have changed."""
        if not self._whitened.size:
            self._whitened = np.zeros((self._estimator.equations, self._stiffness.size))
        if self._factors != self._estimator.factors:
            self._factors, self._stiffness_known = self._estimator.factors, False
            self._known[:] = False
        return self._whitened[: self._estimator.factored_rows]


@njit
def _found(q: Float, own: Float, stiffness: Float, significant: float, found: Float) -> float:
    """Write the largest significant squared load of each cell into ``found`` (Q,); 0 if none is significant.

    The loads are estimated without their own priors (see :meth:`LoadPosterior.expected`). ``q`` (Q, 3)
    contains the posterior means, ``own`` (Q,) the prior variances, and ``stiffness`` (3Q,) the sensitivities
    k. Returns the largest ratio of a squared load to its noise variance.
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
