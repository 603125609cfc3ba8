"""The prior of the loads on a patch, and of the displacement that they cause: where loads are expected.

At first loads are expected all over the patch alike, at one scale s². From the loads found, the prior expects
loads there and hardly any elsewhere (:meth:`LoadPrior.localise`): a contact is stiff where nothing else
touches. Compared with one scale for the whole patch that divides the error by two to three, and a narrow
contact no longer sticks out of the reported deviation.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import (
    cholesky,
    multiply,
    multiply_vector,
    solve_lower_transposed_vector,
    solve_lower_vector,
)
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.prior import SLACK, ElasticPrior

LOCAL_SPREAD: Final = 0.7
"""Standard deviation, in cells, of the Gaussian that spreads the squares of the loads found over their
neighbours. Less trusts single cells, which is better for contacts on rubber as the prior has it, and
overconfident for others; 1 loses a quarter of the gain."""
LOCAL_FLOOR: Final = 0.05
"""Mean square load expected where none was found, over the mean: for a light touch beside a press."""
LOCAL_CHANGE: Final = 0.35
"""Share of the expected loads that must have moved elsewhere before the prior is made anew: at 0.5 frames of
a slow press reach 6 standard deviations, at 0.25 twice as many frames pay for it."""
LOCAL_SURPRISE: Final = 16.0
"""Square of a load at one cell over the square expected there, above which the prior is made anew however
little moved elsewhere: after an odd motion that left little to expect, a press twice as deep as the last
frame's was 7 standard deviations off. Costs nothing: as many frames are factorised in slow presses at 16 as
without."""


class LoadPrior:
    """Prior u ~ N(0, s² C) of the free coordinates of a patch, made of loads of unequal variance.

    Args:
        elastic: Elasticity of the patch.
        free: (U f,) numbers of the coordinates that move.

    Attributes:
        scale2: s², pitch².
        share: (Q,) variance of the loads of a cell over s²; their mean is 1.
        covariance: (U f, U f) C.
        uniform: (U f, U f) C with loads expected all over the patch alike.
        response: (U f, 3Q) displacement by the loads, pitches.
        version: Counts the covariances made.
    """

    def __init__(self, elastic: ElasticPrior, free: Index) -> None:
        self.response = np.ascontiguousarray(elastic.response[free])
        self.uniform = np.ascontiguousarray(elastic.covariance[np.ix_(free, free)])
        self.covariance, self._root = self.uniform.copy(), np.empty_like(self.uniform)
        self._response_t = np.ascontiguousarray(self.response.T)
        self._blur = _blur(elastic.shape)
        self.scale2 = 1.0
        self.share = np.ones(len(self._blur))
        self.version = 0
        self._loads: tuple[Float, Float] | None = None  # displacement, loads; by the covariance at hand

    def spread(self, scale2: float) -> None:
        """Expect loads all over the patch alike, at scale s²."""
        self.scale2 = scale2
        self.share[:] = 1.0
        self.covariance[:] = self.uniform
        self._made_anew(self.uniform)

    def localise(self, variance: Float) -> bool:
        """Expect loads of these variances.

        Args:
            variance: (Q,) variance of the loads of each cell, pitch².

        Returns:
            False, and nothing done, if hardly any load would have to be expected elsewhere.
        """
        mean = float(variance.mean())
        share = variance / mean
        moved = 0.5 * float(np.abs(share - self.share).mean()) > LOCAL_CHANGE
        if not moved and (variance <= LOCAL_SURPRISE * self.scale2 * self.share).all():
            return False
        self.scale2 = mean
        self.share[:] = share
        multiply(self.response * np.repeat(share, 3), self._response_t, self.covariance)
        self.covariance[np.diag_indices_from(self.covariance)] += SLACK**2
        self._made_anew(self.covariance)
        return True

    def expected(self, found: Float, least: float, *, certain: bool) -> Float:
        """Return the variances (Q,), pitch², that the loads found speak for; at least ``least``.

        They are half of the way from those at hand, or neighbours would take turns; all of it from loads
        expected all over the patch alike, if something certainly presses.

        Args:
            found: (Q,) squares of the loads found.
            least: Least variance of a cell, pitch².
            certain: Whether a load is certain.
        """
        floor = LOCAL_FLOOR * float(found.mean()) + least
        wanted = np.empty_like(found)
        multiply_vector(self._blur, found, wanted)
        wanted += floor
        if certain and (self.share == 1.0).all():
            return wanted
        return np.asarray(0.5 * (wanted + self.scale2 * self.share))

    def loads(self, displacement: Float) -> Float:
        """Return the mean of the loads given a displacement.

        Args:
            displacement: (U f,) free coordinates, pitches.

        Returns:
            (Q, 3) loads of each cell, in units of the prior's.
        """
        if self._loads is not None and np.array_equal(self._loads[0], displacement):
            return self._loads[1]
        z, q = displacement.copy(), np.empty(self.response.shape[1])
        solve_lower_vector(self._root, z, z.size)
        solve_lower_transposed_vector(self._root, z, z.size)
        multiply_vector(self._response_t, z, q)
        self._loads = displacement, q.reshape(-1, 3) * self.share[:, None]
        return self._loads[1]

    def roughness(self, displacement: Float) -> float:
        """Return uᵀ C⁻¹ u, pitch², of a displacement (U f,), which is overwritten.

        It is the square of the scale that the displacement asks for, times the number of unknowns.
        """
        solve_lower_vector(self._root, displacement, displacement.size)
        return float(displacement @ displacement)

    def _made_anew(self, covariance: Float) -> None:
        self._root[:] = covariance
        cholesky(self._root, len(self._root))
        self.version += 1
        self._loads = None


def _blur(shape: tuple[int, int]) -> Float:
    """(Q, Q) weights of a Gaussian of :data:`LOCAL_SPREAD` cells around each cell, summing to 1."""
    cell = np.indices(shape).reshape(2, -1)
    square = ((cell[:, :, None] - cell[:, None, :]) ** 2).sum(axis=0)
    weight = np.exp(-0.5 * square / LOCAL_SPREAD**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
