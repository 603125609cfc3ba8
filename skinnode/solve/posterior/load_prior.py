"""Prior for the loads on a patch, and for the displacement that they cause.

Initially, the prior expects equal loads over the whole patch, with a single scale s². Once loads have been
found, the prior expects loads mainly in the same places: in discs (:meth:`LoadPrior.set_discs`), or in the
cells where they were found (:meth:`LoadPrior.localise`). The skin next to a contact is then estimated to move
only as far as the contact's loads require. In tests, expecting loads where they were found reduced
displacement errors by a factor of two to three.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import (
    cholesky,
    multiply,
    multiply_vector,
    solve_lower_transposed_vector,
    solve_lower_vector,
)
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.elastic_prior import SLACK, ElasticPrior

PRIOR_DOUBT: Final = 3.0
"""Factor applied to the part of the variance that depends on the prior; accounts for the uncertainty in the
expected loads. In difficult cases (first touches, dents that cannot form on a half-space), displacement
errors reached 7 standard deviations with a factor of 1, and 5.6 with a factor of 2."""
SMOOTH_SHARE: Final = 0.25
"""Factor applied to the part of the variance that depends on the prior, for the 95 % interval. The factor is
less than 1, because the loads of real bodies are smoother than the independent loads of the prior. Measured
displacement errors correspond to factors of at most 0.13 for spheres and 0.5 for Gaussian dents."""
DISC_SLACK: Final = 0.07
"""Standard deviation of the part of the displacement not explained by loads in discs, relative to the
expected displacement; independent for each electrode. With 0, an error exceeded five standard deviations in
one of ten dents; with 0.1, in none of 30."""
DISC_DOUBT: Final = 2.5
"""Value of :data:`PRIOR_DOUBT` for a prior with discs."""
DISC_SHARE: Final = 0.8
"""Value of :data:`SMOOTH_SHARE` in a solve with discs. The reported 95 % interval uses the factors of
:mod:`skinnode.solve.posterior.local.disc_claim` instead."""
DISC_FAINT: Final = 0.05
"""Load variance, relative to that of untouched skin, below which the discs' contribution to a cell is
neglected."""
LOCAL_SPREAD: Final = 0.7
"""Standard deviation of the Gaussian that spreads squared loads over neighbouring cells, in cells. A smaller
value improves the displacement estimate if the rubber behaves like a half-space; otherwise, the standard
deviations become too small. A value of 1 reduces the benefit of :meth:`LoadPrior.localise` by a quarter."""
LOCAL_FLOOR: Final = 0.05
"""Mean square load expected in cells where no load was found, relative to the mean over the patch. A positive
value accounts for light touches near a press."""
LOCAL_CHANGE: Final = 0.35
"""Fraction of the expected loads that must change location for the prior to be rebuilt. In slow presses,
displacement errors reached 6 standard deviations with a fraction of 0.5. With 0.25, the prior was rebuilt
twice as often."""
LOCAL_SURPRISE: Final = 16.0
"""Ratio of a cell's squared load to its expected squared load, above which the prior is rebuilt even if the
load locations have hardly changed. Without this limit, displacement errors reached 7 standard deviations when
the depth of a press doubled in one frame."""


@dataclass(frozen=True, eq=False)
class UniformPrior:
    """Prior of the free coordinates for equal expected loads at s = 1; shared by all patches of a layout."""

    response: Float
    """(U f, 3Q) displacement per unit load, in pitches."""
    response_t: Float
    """(3Q, U f) transposed response."""
    normal: Float
    """(U f, Q) columns of ``response`` that belong to normal loads."""
    covariance: Float
    """(U f, U f) matrix C, in pitch²."""
    root: Float
    """(U f, U f) array containing the Cholesky factor of C."""
    blur: Float
    """(Q, Q) weights of a Gaussian blur over the cells."""

    @classmethod
    def of(cls, elastic: ElasticPrior, free: Index) -> UniformPrior:
        """Return the cached prior of the coordinates ``free`` (U f,), computing it on first use."""
        return _uniform_prior(elastic, free.tobytes())


@functools.lru_cache(maxsize=16)  # for the reference patch, 4 MB
def _uniform_prior(elastic: ElasticPrior, free_bytes: bytes) -> UniformPrior:
    free = np.frombuffer(free_bytes, np.int64)
    every = free.size == len(elastic.response)
    response = elastic.response if every else np.ascontiguousarray(elastic.response[free])
    covariance = elastic.covariance if every else np.ascontiguousarray(elastic.covariance[np.ix_(free, free)])
    root = covariance.copy()
    cholesky(root, len(root))
    response_t = np.ascontiguousarray(response.T)
    normal = np.ascontiguousarray(response[:, 2::3])
    return UniformPrior(response, response_t, normal, covariance, root, _blur(elastic.shape))


class LoadPrior:
    """Prior u ~ N(0, s² C) of the free coordinates u of a patch, for loads with individual variances.

    As long as the same load is expected everywhere, the prior needs no large arrays of its own.

    Args:
        elastic: Elastic prior of the patch.
        free: (U f,) indices of the free coordinates.

    Attributes:
        scale2: s², in pitch².
        share: (Q,) load variance of each cell, relative to s²; the mean is 1.
        covariance: (U f, U f) matrix C; read-only.
        uniform: (U f, U f) matrix C for equal expected loads over the whole patch; read-only.
        response: (U f, 3Q) displacement per unit load, in pitches.
        response_t: (3Q, U f) transposed response.
        normal_response: (U f, Q) displacement per unit of normal load, in pitches.
        doubt: Factor applied to the part of the variance that depends on the prior.
        smooth_share: Value of ``doubt`` for the 95 % interval.
        version: Number of times C has been rebuilt.
    """

    def __init__(self, elastic: ElasticPrior, free: Index) -> None:
        self._of_layout = UniformPrior.of(elastic, free)
        self.response, self.uniform = self._of_layout.response, self._of_layout.covariance
        self.response_t, self.normal_response = self._of_layout.response_t, self._of_layout.normal
        self.covariance, self._root = self.uniform, self._of_layout.root
        self.doubt, self.smooth_share = PRIOR_DOUBT, SMOOTH_SHARE
        self.scale2 = 1.0
        self.share = np.ones(len(self._of_layout.blur))
        self.version = 0
        self._loads: tuple[Float, Float] | None = None  # last displacement and its mean loads

    def spread(self, scale2: float) -> None:
        """Expect equal loads over the whole patch, with the scale s² = ``scale2`` in pitch²."""
        self.scale2 = scale2
        self.doubt, self.smooth_share = PRIOR_DOUBT, SMOOTH_SHARE
        self.share[:] = 1.0
        self.covariance, self._root = self.uniform, self._of_layout.root
        self._made_anew()

    def localise(self, variance: Float) -> bool:
        """Set the variances of the loads, and rebuild the prior if they have changed enough.

        Args:
            variance: (Q,) load variance of each cell, in pitch².

        Returns:
            Whether the prior was rebuilt.
        """
        self.doubt, self.smooth_share = PRIOR_DOUBT, SMOOTH_SHARE
        mean = float(variance.mean())
        share = variance / mean
        moved = 0.5 * float(np.abs(share - self.share).mean()) > LOCAL_CHANGE
        if not moved and (variance <= LOCAL_SURPRISE * self.scale2 * self.share).all():
            return False
        self.scale2 = mean
        self.share[:] = share
        covariance = self._own_covariance()
        multiply(self.response * np.repeat(share, 3), self.response_t, covariance)
        covariance[np.diag_indices_from(covariance)] += SLACK**2
        self._factorise()
        return True

    def set_discs(self, variance: Float, response_t: Float, untouched2: float) -> None:
        """Set the load variances for a skin that is untouched except for discs on a few cells.

        Args:
            variance: (2, Q) variances that discs add to the half-space and layer loads of each cell, in
                pitch².
            response_t: (4Q, U f) displacement per unit load, in pitches: for each cell, the three loads on a
                half-space and the load on a bonded layer.
            untouched2: Variance of the half-space loads on untouched skin, in pitch².
        """
        loaded = variance[0] > DISC_FAINT * untouched2
        own = np.where(loaded, variance[0], 0.0) + untouched2
        self.scale2 = float(own.mean())
        self.share[:] = own / self.scale2
        rest = untouched2 / self.scale2
        added = np.repeat(variance, (3, 1), axis=0).T[loaded].ravel() / self.scale2
        part_t = response_t.reshape(len(own), 4, -1)[loaded].reshape(added.size, -1)
        covariance = self._own_covariance()
        multiply(np.ascontiguousarray(part_t.T), part_t * added[:, None], covariance)
        _add_untouched(covariance, self.uniform, rest, DISC_SLACK**2, (1.0 - rest) * SLACK**2)
        self.doubt, self.smooth_share = DISC_DOUBT, DISC_SHARE
        self._factorise()

    def expected(self, found: Float, least: float, *, certain: bool) -> Float:
        """Return the load variances (Q,) for the next solve, in pitch².

        Each variance moves halfway from its current value to the value indicated by the loads found. With
        full steps, the variances of neighbouring cells would oscillate. A full step is taken only if the
        expected loads are still equal and a press is certain.

        Args:
            found: (Q,) squared loads found in the frame, in pitch².
            least: Minimum variance, in pitch².
            certain: Whether a press is certain.
        """
        floor = LOCAL_FLOOR * float(found.mean()) + least
        wanted = np.empty_like(found)
        multiply_vector(self._of_layout.blur, found, wanted)
        wanted += floor
        if certain and (self.share == 1.0).all():
            return wanted
        return np.asarray(0.5 * (wanted + self.scale2 * self.share))

    def loads(self, displacement: Float) -> Float:
        """Return the mean loads for a given displacement.

        Args:
            displacement: (U f,) free coordinates, in pitches.

        Returns:
            (Q, 3) mean loads, in units of the prior's loads.
        """
        if self._loads is not None and np.array_equal(self._loads[0], displacement):
            return self._loads[1]
        z, q = displacement.copy(), np.empty(self.response.shape[1])
        solve_lower_vector(self._root, z, z.size)
        solve_lower_transposed_vector(self._root, z, z.size)
        multiply_vector(self.response_t, z, q)
        self._loads = displacement, q.reshape(-1, 3) * self.share[:, None]
        return self._loads[1]

    def roughness(self, displacement: Float) -> float:
        """Return uᵀ C⁻¹ u, in pitch², for a displacement u (U f,). The array is overwritten.

        The most likely s² for u is uᵀ C⁻¹ u divided by the number of coordinates.
        """
        solve_lower_vector(self._root, displacement, displacement.size)
        return float(displacement @ displacement)

    def _own_covariance(self) -> Float:
        """Return a private array for C; replace the shared array of the uniform prior if necessary."""
        if self.covariance is self.uniform:
            self.covariance, self._root = np.empty_like(self.uniform), np.empty_like(self.uniform)
        return self.covariance

    def _factorise(self) -> None:
        self._root[:] = self.covariance
        cholesky(self._root, len(self._root))
        self._made_anew()

    def _made_anew(self) -> None:
        self.version += 1
        self._loads = None


@njit
def _add_untouched(c: Float, uniform: Float, rest: float, near: float, slack: float) -> None:
    """Add ``rest`` times the covariance ``uniform`` to ``c``, and the independent parts to its diagonal."""
    for i in range(c.shape[0]):
        row, other = c[i], uniform[i]
        own = row[i]
        for j in range(row.size):
            row[j] += rest * other[j]
        row[i] += near * own + slack


def _blur(shape: tuple[int, int]) -> Float:
    """Return the weights (Q, Q) of a Gaussian blur over the cells; each row sums to 1."""
    cell = np.indices(shape).reshape(2, -1)
    square = ((cell[:, :, None] - cell[:, None, :]) ** 2).sum(axis=0)
    weight = np.exp(-0.5 * square / LOCAL_SPREAD**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
