"""Joint distribution of the readings of one layout, linearised at rest.

A displacement u of the electrodes changes the logarithm of the readings by J u, in units of their noise σ.
With the elastic prior u ~ N(0, s² C), the changes z are N(0, S) with S = I + κ² J C Jᵀ and κ = s / σ. One
eigendecomposition of J C Jᵀ gives the evidence of a frame at every κ. The precision P = S⁻¹ gives the
leave-out tests: with α = P z, the error in predicting a group of readings from all others has the χ²
α_Gᵀ P_GG⁻¹ α_G (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.forward import jacobian, potential_per_m
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.checks.wire_tests import WireTables
from skinnode.solve.linalg.cholesky import multiply, multiply_vector
from skinnode.solve.posterior.elastic_prior import ElasticPrior

OCTAVES: Final = (-7, 21)
"""Range of log2 κ: noise from 1e-6 to 1e-2 and prior scales from 1e-4 to 1 pitch."""


@dataclass(frozen=True, eq=False)
class Level:
    """Distribution of the readings at one κ, with m = U K readings and Q cells of loads."""

    precision: Float
    """(m, m) P."""
    stiffness: Float
    """(3Q,) bᵀ P b for the response b of the readings to each load."""
    wires: WireTables
    """Factors of the wires' blocks of P and S."""


class ReadingModel:
    """Distribution of the readings of one layout. Shared by all patches with the layout; immutable.

    Args:
        layout: The patch.

    Attributes:
        jacobian: (U, K, 3N) ∂(ln F)/∂x at rest, 1/pitch.
        response: (m, 3Q) change of the readings per load of the elastic prior.
        kappa: (L,) values of κ.
        log_det: (L,) ln det S.
        shrink: (L, m) 1 / (1 + κ² λ) for each eigenvalue λ.
        vectors_t: (m, m) eigenvectors of J C Jᵀ as rows.
    """

    def __init__(self, layout: PatchLayout) -> None:
        upper, lower = layout.shape
        slopes = jacobian(layout, layout.upper_m) / potential_per_m(layout, layout.upper_m)[..., None, None]
        self.shape = layout.shape
        self.jacobian = np.ascontiguousarray((slopes * layout.pitch_m).reshape(upper, lower, -1))
        prior = ElasticPrior.of(layout)
        free = self.jacobian.shape[2]
        by_load = [self.jacobian[u] @ prior.response[u * free : (u + 1) * free] for u in range(upper)]
        self.response = np.ascontiguousarray(np.concatenate(by_load))
        covariance = np.empty((upper * lower, upper * lower))
        for u in range(upper):
            for v in range(upper):
                block = prior.covariance[u * free : (u + 1) * free, v * free : (v + 1) * free]
                covariance[u * lower : (u + 1) * lower, v * lower : (v + 1) * lower] = (
                    self.jacobian[u] @ block @ self.jacobian[v].T
                )
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        values = np.maximum(values, 0.0)
        self.vectors_t = np.ascontiguousarray(vectors.T)
        self.kappa = 2.0 ** np.arange(*OCTAVES)
        spread = self.kappa[:, None] ** 2 * values
        self.shrink = 1.0 / (1.0 + spread)
        self.log_det = np.log1p(spread).sum(axis=1)
        self._levels: dict[int, Level] = {}

    @classmethod
    def of(cls, layout: PatchLayout) -> ReadingModel:
        """Return the model of ``layout`` from a cache."""
        return _model(layout)

    def level(self, number: int) -> Level:
        """Return the distribution at ``kappa[number]``, computed on first use."""
        found = self._levels.get(number)
        if found is None:
            found = self._levels[number] = self._compute(number)
        return found

    def _compute(self, number: int) -> Level:
        upper, lower = self.shape
        m = upper * lower
        precision, covariance, weighted = np.empty((3, m, m))
        vectors = np.ascontiguousarray(self.vectors_t.T)
        np.divide(self.vectors_t, self.shrink[number][:, None], out=weighted)
        multiply(vectors, weighted, covariance)
        np.multiply(self.vectors_t, self.shrink[number][:, None], out=weighted)
        multiply(vectors, weighted, precision)
        moved = np.empty_like(self.response)
        multiply(precision, self.response, moved)
        return Level(
            precision=precision,
            stiffness=np.einsum("mj,mj->j", self.response, moved),
            wires=WireTables.of(precision, covariance, self.shape),
        )


@functools.lru_cache(maxsize=16)
def _model(layout: PatchLayout) -> ReadingModel:
    return ReadingModel(layout)


@njit
def changes(jacobian_: Float, moved: Float, sigma: float, z: Float) -> None:
    """Write J u / σ into ``z`` (U, K) for displacements ``moved`` (U, 3N), pitches."""
    for u in range(z.shape[0]):
        multiply_vector(jacobian_[u], moved[u], z[u])
        for k in range(z.shape[1]):
            z[u, k] /= sigma


@njit
def evidences(  # noqa: PLR0913 - a kernel: arrays by name
    vectors_t: Float, shrink: Float, log_det: Float, z: Float, c: Float, out: Float
) -> int:
    """Write the log evidence of ``z`` (m,) at every κ into ``out`` (L,); return the index of the largest.

    The constant −½ m ln 2π is left out. ``c`` (m,) is scratch.
    """
    multiply_vector(vectors_t, z, c)
    for i in range(c.size):
        c[i] *= c[i]
    best = 0
    for j in range(out.size):
        row, square = shrink[j], 0.0
        for i in range(c.size):
            square += c[i] * row[i]
        out[j] = -0.5 * (square + log_det[j])
        if out[j] > out[best]:
            best = j
    return best
