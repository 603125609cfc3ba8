"""Joint distribution of the readings of a layout, linearised at rest.

A displacement u of the electrodes changes the logarithms of the readings by J u, in units of their noise σ.
The elastic prior is u ~ N(0, s² C). The changes z are therefore distributed as N(0, S), with S = I + κ² J C
Jᵀ and κ = s / σ. One eigendecomposition of J C Jᵀ yields the evidence of a frame at every κ. The leave-out
tests use the precision P = S⁻¹. With α = P z, the χ² of a group G of readings, given all others, is α_Gᵀ
P_GG⁻¹ α_G (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2).

The responses to loads are computed for two models of the rubber. One is the half-space of the elastic prior,
with three loads per cell. The other is a thin bonded layer, with one normal load per cell. With the
half-space alone, correct readings of a thin layer appear to contradict each other: 91 of the 210 fields in
``tests/solve/test_trust_on_a_thin_layer.py`` were not trusted. With both models, only one field was not
trusted, and no faults were reported.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.forward import jacobian, potential_per_m
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.checks.wire_tests import WireTables, wire_blocks
from skinnode.solve.linalg.cholesky import multiply, multiply_vector
from skinnode.solve.posterior.elastic_prior import SLACK, ElasticPrior, bonded_response

USUAL: Final = (-25, -3)
"""Range of log2 s for which load tables are computed in advance, where s is the prior scale in pitches. The
smallest scales are used in the search for explanations of light touches at low noise."""
MOST_USUAL: Final = 9
"""Number of prior scales prepared for a large patch: the largest scales in :data:`USUAL`."""
STORED: Final = 180_000_000
"""Maximum size of all stored tables, in bytes. Computing the tables during a stream would delay the first
touched frame by up to 0.1 s. The tables of the reference patch take 176 MB. For larger patches, products with
the loads are computed when they are needed."""
OCTAVES: Final = (-7, 21)
"""Range of log2 κ; covers noise from 1e-6 to 1e-2 and prior scales from 1e-4 to 1 pitch."""


@dataclass(frozen=True, eq=False)
class Level:
    """Distribution of the m = U K readings at one κ."""

    precision: Float
    """(m, m) precision P of the readings."""
    wires: WireTables
    """Cholesky factors of each wire's blocks of P and S."""


@dataclass(frozen=True, eq=False)
class LoadTables:
    """Products, at one κ, of the precision P and the readings' responses B to the loads on Q cells."""

    diagonal: Float
    """(m + 4Q,) diagonal of P, followed by the diagonal of Bᵀ P B."""
    moved_t: Float
    """(4Q, m) Bᵀ P. ``moved_t`` and ``gram`` are empty if the tables are too large to store
    (:data:`STORED`)."""
    gram: Float
    """(4Q, 4Q) Bᵀ P B."""


class ReadingModel:
    """Joint distribution of the readings of one layout.

    A model is immutable apart from its cached tables, and is shared by all patches with the same layout.

    Args:
        layout: The patch.

    Attributes:
        jacobian: (U, K, 3N) ∂(ln F)/∂x at rest, 1/pitch.
        response: (m, 4Q) matrix B, the responses of the readings to unit loads.
        response_t: (4Q, m) Bᵀ.
        kappa: (L,) values of κ.
        log_det: (L,) ln det S at each κ.
        shrink: (L, m) 1 / (1 + κ² λ) for the eigenvalues λ of J C Jᵀ.
        diagonals: (L, m) diagonal of the precision P at each κ.
        vectors_t: (m, m) eigenvectors of J C Jᵀ, as rows.
    """

    def __init__(self, layout: PatchLayout) -> None:
        upper, lower = layout.shape
        slopes = jacobian(layout, layout.upper_m) / potential_per_m(layout, layout.upper_m)[..., None, None]
        self.shape = layout.shape
        self.jacobian = np.ascontiguousarray((slopes * layout.pitch_m).reshape(upper, lower, -1))
        by_loads = np.concatenate([ElasticPrior.of(layout).response, bonded_response(layout)], axis=1)
        free = self.jacobian.shape[2]
        of_wires = [self.jacobian[u] @ by_loads[u * free : (u + 1) * free] for u in range(upper)]
        self.response = np.ascontiguousarray(np.concatenate(of_wires))
        self.response_t = np.ascontiguousarray(self.response.T)
        covariance = np.empty((upper * lower, upper * lower))
        multiply(self.response, self.response_t, covariance)
        for u in range(upper):  # the slack term of the elastic prior
            rows = slice(u * lower, (u + 1) * lower)
            covariance[rows, rows] += SLACK**2 * (self.jacobian[u] @ self.jacobian[u].T)
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        values = np.maximum(values, 0.0)
        self.vectors_t = np.ascontiguousarray(vectors.T)
        self.kappa = 2.0 ** np.arange(*OCTAVES)
        spread = self.kappa[:, None] ** 2 * values
        self.shrink = 1.0 / (1.0 + spread)
        self.log_det = np.log1p(spread).sum(axis=1)
        self.diagonals = np.empty_like(self.shrink)
        multiply(self.shrink, self.vectors_t**2, self.diagonals)
        self._levels: dict[int, Level] = {}
        self._loads: dict[int, LoadTables] = {}
        m, loads = self.response.shape
        usual = USUAL[1] - USUAL[0] + 1
        self._stores = 8 * (len(self.kappa) * m**2 + usual * loads * (m + loads)) <= STORED

    @classmethod
    def of(cls, layout: PatchLayout) -> ReadingModel:
        """Return the cached model of ``layout``, created on first use."""
        return _model(layout)

    def level(self, number: int) -> Level:
        """Return the distribution at ``kappa[number]``, computed on first use."""
        found = self._levels.get(number)
        if found is None:
            found = self._levels[number] = self._compute(number)
        return found

    def loads(self, number: int) -> LoadTables:
        """Return the load tables at ``kappa[number]``, computed on first use."""
        found = self._loads.get(number)
        if found is None:
            found = self._loads[number] = self._load_tables(number)
        return found

    def prepare(self, sigma: float) -> None:
        """Compute the tables that a stream with the relative noise ``sigma`` usually needs.

        Other tables are computed on first use. For the reference patch, this method takes 0.4 s.
        """
        octaves = np.log2(self.kappa * sigma)
        usual: list[int] = np.flatnonzero((octaves >= USUAL[0]) & (octaves <= USUAL[1])).tolist()
        for number in range(len(self.kappa)) if self._stores else usual[-MOST_USUAL:]:
            self.level(number)
        for number in usual if self._stores else ():
            self.loads(number)

    def _load_tables(self, number: int) -> LoadTables:
        precision, (m, loads) = self.level(number).precision, self.response.shape
        moved, gram = np.empty((m, loads)), np.empty((0, 0))
        multiply(precision, self.response, moved)
        stiffness = np.einsum("mj,mj->j", self.response, moved)
        diagonal = np.concatenate([self.diagonals[number], stiffness])
        if not self._stores:
            return LoadTables(diagonal, gram, gram)
        gram = np.empty((loads, loads))
        multiply(self.response_t, moved, gram)
        return LoadTables(diagonal, np.ascontiguousarray(moved.T), gram)

    def _compute(self, number: int) -> Level:
        upper, lower = self.shape
        m = upper * lower
        precision, weighted = np.empty((2, m, m))
        covariance = np.full((m, m), np.nan)  # only the wires' blocks are needed
        vectors = np.ascontiguousarray(self.vectors_t.T)
        np.divide(self.vectors_t, self.shrink[number][:, None], out=weighted)
        of_upper, of_lower = wire_blocks(covariance, self.shape)
        for wires, first, step in ((of_upper, lower, 1), (of_lower, 1, lower)):
            block = np.empty(wires.shape[1:])
            for wire, each in enumerate(wires):
                rows = slice(wire * first, wire * first + len(block) * step, step)
                multiply(np.ascontiguousarray(vectors[rows]), np.ascontiguousarray(weighted[:, rows]), block)
                each[...] = block
        np.multiply(self.vectors_t, self.shrink[number][:, None], out=weighted)
        multiply(vectors, weighted, precision)
        return Level(
            precision=precision,
            wires=WireTables.of(precision, covariance, self.shape),
        )


@functools.lru_cache(maxsize=8)
def _model(layout: PatchLayout) -> ReadingModel:
    return ReadingModel(layout)


@njit
def changes(jacobian_: Float, moved: Float, sigma: float, z: Float) -> None:
    """Write J u / σ into ``z`` (U, K), for the displacement u = ``moved`` (U, 3N), in pitches."""
    for u in range(z.shape[0]):
        multiply_vector(jacobian_[u], moved[u], z[u])
        for k in range(z.shape[1]):
            z[u, k] /= sigma


@njit
def evidences(  # noqa: PLR0913 - a kernel: arrays by name
    vectors_t: Float, shrink: Float, log_det: Float, z: Float, c: Float, out: Float
) -> int:
    """Write the log evidence of ``z`` (m,) at every κ into ``out`` (L,); return the index of the maximum.

    The constant −½ m ln 2π is omitted. Writes the components of ``z`` along the eigenvectors, and their
    squares, into ``c`` (2, m).
    """
    parts, squares = c[0], c[1]
    multiply_vector(vectors_t, z, parts)
    for i in range(parts.size):
        squares[i] = parts[i] * parts[i]
    multiply_vector(shrink, squares, out)
    best = 0
    for j in range(out.size):
        out[j] = -0.5 * (out[j] + log_det[j])
        if out[j] > out[best]:
            best = j
    return best
