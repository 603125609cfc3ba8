"""Fits the loads of the elastic prior to a displacement field of the exact inverse.

The field u is modelled as the sum of three terms:

- G q: displacement due to the loads q ~ N(0, s²) of the elastic prior;
- slack: displacement not explained by loads, with a standard deviation of ε s;
- e ~ N(0, ν² Σ): error of the exact inverse, with the error covariance Σ at rest. The factor ν² is computed
  from the standard deviations of the field.

With the singular value decomposition

    Σ^(−1/2) [G, ε I] = U S Vᵀ,   z = Uᵀ Σ^(−1/2) u,   B = Uᵀ Σ^(−1/2) G

the covariance C = s² S² + ν² of z is diagonal for every s and ν. The matrices Uᵀ Σ^(−1/2) and B are computed
once per patch. Each frame then requires two matrix-vector products, one for z and one for q = s² Bᵀ C⁻¹ z.
The scale s maximises the evidence.

To leave out coordinates, their displacements are treated as unknown. Let Q have orthonormal columns that span
C^(−1/2) W, where W are the columns of Uᵀ Σ^(−1/2) that belong to the coordinates left out. C⁻¹ is then
replaced with C^(−1/2) (I − Q Qᵀ) C^(−1/2).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.elastic import Rubber
from skinnode.model.forward import jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.linalg.cholesky import multiply, multiply_vector, solve_positive
from skinnode.solve.linalg.qr import orthonormalise
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.options import TrackerOptions
from skinnode.solve.posterior.contacts import LoadEstimate
from skinnode.solve.posterior.elastic_prior import SLACK, ElasticPrior
from skinnode.solve.wires.problem import PatchProblem

FIRST_SCALE: Final = 1e-4
"""First estimate of s² in a stream, in pitch²."""
SCALE_STEPS: Final = 30
"""Maximum number of fixed-point iterations for s²."""
SCALE_CLOSE: Final = 0.01
"""Relative change in s² at which the iteration stops; the relative change in the loads is smaller."""
SCALE_LEAST: Final = 1e-12
"""Lower limit on s², in pitch²."""
REUSED: Final = 0.25
"""Maximum relative change in s² and in ν² for which the matrices of :class:`Remainder` are reused. Computing
them takes as long as the rest of the fit."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadFactors:
    """Matrices of one patch at one noise level; the module's docstring defines the symbols."""

    prior: ElasticPrior
    whitening: Float
    """(n, n) transpose of Uᵀ Σ^(−1/2) for the free coordinates, 1/pitch."""
    rows: Float
    """(n, 3Q) matrix B, as defined in the module's docstring."""
    gain: Float
    """(n,) squared singular values, the diagonal of S²."""
    rest_std: Float
    """(n,) standard deviations of the exact inverse at rest, in pitches."""
    free: Index
    """(n,) indices of the free coordinates, which are the unknowns of the exact inverse."""


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """Matrices for a fit with some coordinates left out, at one s² and ν²."""

    key: bytes
    """Mask of the coordinates left out."""
    scale2: float
    """s², in pitch²."""
    level: float
    """ν²."""
    root: Float
    """(n,) diagonal of C^(−1/2)."""
    basis_t: Float
    """(r, n) Qᵀ, for the r coordinates left out."""
    rows: Float
    """(n + r, 3Q) B, followed by Qᵀ C^(−1/2) B."""
    weight: Float
    """(n + r,) weights of ``rows``: C⁻¹, followed by −1 for each coordinate left out."""

    def serves(self, key: bytes, scale2: float, level: float) -> bool:
        """Return whether the matrices are accurate enough for these coordinates, s² and ν²."""
        change = max(abs(self.scale2 / scale2 - 1.0), abs(self.level / level - 1.0))
        return change <= REUSED and self.key == key


class LoadFit:
    """Fits loads to the fields of one stream; each stream needs its own instance.

    Args:
        layout: The patch.
        options: Options of the tracker.

    Attributes:
        factors: Matrices of the patch.
    """

    def __init__(self, layout: PatchLayout, options: TrackerOptions) -> None:
        noise = np.broadcast_to(np.asarray(options.relative_noise, float), layout.shape)
        level = float(np.sqrt(np.mean(noise[np.isfinite(noise)] ** 2)))
        uniform = bool((noise == noise.flat[0]).all())
        self.factors = (
            _cached_factors(layout, options.rubber, level, options.normal_only)
            if uniform
            else _factors(layout, options.rubber, np.array(noise), options.normal_only)
        )
        n, loads = self.factors.rows.shape
        self._z, self._weight, self._seen, self._unknown = np.empty((4, n))
        self._load = np.empty(loads)
        self._share = np.ones(loads // 3)
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        self._scale2 = FIRST_SCALE
        self._remainder: Remainder | None = None

    def fit(self, moved: Float, level: float) -> LoadEstimate:
        """Return the loads that explain a displacement.

        The arrays of the estimate are valid until the next call.

        Args:
            moved: (n,) displacement of the free coordinates, in pitches.
            level: ν², the variances of the field relative to those at rest.
        """
        factors = self.factors
        self._scale2 = _fit_loads(
            moved, factors.whitening, factors.gain, factors.rows, level, self._scale2,
            self._z, self._weight, self._load,
        )  # fmt: skip
        return LoadEstimate(self._load.reshape(-1, 3), factors.rows, self._weight, self._share, self._scale2)

    def fit_without(self, moved: Float, level: float, left_out: NDArray[np.bool_]) -> LoadEstimate:
        """Return the loads that explain the displacement of all coordinates except ``left_out`` (n,).

        The scale s is computed with the left-out coordinates at their most probable displacements. The other
        arguments are those of :meth:`fit`.
        """
        factors = self.factors
        columns_t = np.ascontiguousarray(factors.whitening[left_out])
        size = len(columns_t)
        self._scale2 = _fit_scale_without(
            np.where(left_out, 0.0, moved), factors.whitening, columns_t, np.ascontiguousarray(columns_t.T),
            factors.gain, level, self._scale2, self._seen, self._z, np.empty_like(columns_t),
            np.empty((size, size)), self._unknown,
        )  # fmt: skip
        known, key = self._remainder, left_out.tobytes()
        if known is None or not known.serves(key, self._scale2, level):
            self._remainder = known = self._leave_out(key, columns_t, level)
        _loads_without(
            self._seen, known.root, known.basis_t, factors.rows, known.scale2,
            self._z, self._unknown, self._load,
        )  # fmt: skip
        return LoadEstimate(self._load.reshape(-1, 3), known.rows, known.weight, self._share, known.scale2)

    def _leave_out(self, key: bytes, columns_t: Float, level: float) -> Remainder:
        """Compute the matrices of a fit without the coordinates with columns W, given as rows (r, n)."""
        factors, size = self.factors, len(columns_t)
        n, loads = factors.rows.shape
        root = 1.0 / np.sqrt(self._scale2 * factors.gain + level)
        basis_t = columns_t * root
        orthonormalise(basis_t, self._unknown)
        rows = np.empty((n + size, loads))
        rows[:n] = factors.rows
        multiply(basis_t * root, factors.rows, rows[n:])
        weight = np.concatenate([root**2, np.full(size, -1.0)])
        return Remainder(key, self._scale2, level, root, basis_t, rows, weight)


@functools.lru_cache(maxsize=32)
def _cached_factors(
    layout: PatchLayout, rubber: Rubber | None, noise: float, normal_only: bool
) -> LoadFactors:
    return _factors(layout, rubber, np.full(layout.shape, noise), normal_only)


def _factors(layout: PatchLayout, rubber: Rubber | None, noise: Float, normal_only: bool) -> LoadFactors:
    """Return the matrices of a patch whose resistances have the relative noise ``noise`` (U, K)."""
    problem, prior, pitch = PatchProblem.of(layout), ElasticPrior.of(layout, rubber), layout.pitch_m
    wires, electrodes = layout.upper_m.shape[:2]
    slopes = jacobian(layout, layout.upper_m) * pitch**2 * problem.a_rest[..., None, None]
    slopes = slopes[..., 2:] if normal_only else slopes
    weighted = slopes.reshape(*layout.shape, -1) / noise[..., None]
    every = np.arange(3 * wires * electrodes)
    free = every[2::3] if normal_only else every
    n = weighted.shape[2]
    # No electrode moves farther than the clearance, which limits the standard deviations.
    least = 1.0 / float(problem.clearance.min())
    root, std = np.zeros((free.size, free.size)), np.empty((wires, n))
    for u in range(wires):
        _, singular, turn = np.linalg.svd(weighted[u])
        singular = np.hypot(np.append(singular, np.zeros(n - singular.size)), least)
        root[u * n : (u + 1) * n, u * n : (u + 1) * n] = singular[:, None] * turn
        std[u] = np.sqrt(((turn / singular[:, None]) ** 2).sum(axis=0))
    moved = root @ prior.response[free]
    basis, gain, _ = np.linalg.svd(np.hstack([moved, SLACK * root]), full_matrices=False)
    return LoadFactors(
        prior,
        np.ascontiguousarray(root.T @ basis),
        np.ascontiguousarray(basis.T @ moved),
        gain**2,
        std.ravel(),
        free,
    )


@njit
def _fit_loads(  # noqa: PLR0913 - a kernel: field, matrices and outputs by name
    moved: Float,
    whitening: Float,
    gain: Float,
    rows: Float,
    level: float,
    scale2: float,
    z: Float,
    weight: Float,
    loads: Float,
) -> float:
    """Estimate s² and the loads that explain a displacement; return s².

    Writes the diagonal of C⁻¹ to ``weight`` (n,), and the posterior mean to ``loads`` (3Q,). ``z`` (n,) is a
    work array.
    """
    _add_rows(moved, whitening, z)
    scale2 = _fit_scale(z, gain, level, scale2)
    for j in range(z.size):
        weight[j] = 1.0 / (scale2 * gain[j] + level)
        z[j] *= scale2 * weight[j]
    _add_rows(z, rows, loads)
    return scale2


@njit
def _fit_scale_without(  # noqa: PLR0913 - a kernel: field, matrices and outputs by name
    moved: Float,
    whitening: Float,
    columns_t: Float,
    columns: Float,
    gain: Float,
    level: float,
    scale2: float,
    seen: Float,
    z: Float,
    weighted: Float,
    precision: Float,
    unknown: Float,
) -> float:
    """Return s², estimated with the left-out coordinates at their most probable displacements.

    Writes the z of the other coordinates to ``seen`` (n,).

    Args:
        moved: (n,) displacement in pitches; 0 for the r coordinates left out.
        whitening: (n, n) transpose of Uᵀ Σ^(−1/2).
        columns_t: (r, n) Wᵀ, the rows of ``whitening`` that belong to the coordinates left out.
        columns: (n, r) W.
        gain: (n,) diagonal of S².
        level: ν².
        scale2: First estimate of s².
        seen: (n,) output.
        z: (n,) work array.
        weighted: (r, n) work array.
        precision: (r, r) work array.
        unknown: (≥ r,) work array.
    """
    size = len(columns_t)
    _add_rows(moved, whitening, seen)
    for _ in range(2):
        for j in range(z.size):
            z[j] = 1.0 / (scale2 * gain[j] + level)
        for i in range(size):
            for j in range(z.size):
                weighted[i, j] = columns_t[i, j] * z[j]
        multiply(weighted, columns, precision)
        multiply_vector(weighted, seen, unknown[:size])
        if not solve_positive(precision, unknown, size):
            unknown[:size] = 0.0
        for j in range(z.size):
            z[j] = seen[j]
        for i in range(size):
            for j in range(z.size):
                z[j] -= unknown[i] * columns_t[i, j]
        scale2 = _fit_scale(z, gain, level, scale2)
    return scale2


@njit
def _loads_without(  # noqa: PLR0913 - a kernel: field, matrices and outputs by name
    seen: Float,
    root: Float,
    basis_t: Float,
    rows: Float,
    scale2: float,
    z: Float,
    overlap: Float,
    loads: Float,
) -> None:
    """Write the posterior mean s² Bᵀ C^(−1/2) (I − Q Qᵀ) C^(−1/2) z into ``loads`` (3Q,).

    ``seen`` (n,) contains z; ``z`` (n,) and ``overlap`` (≥ r,) are work arrays.
    """
    for j in range(z.size):
        z[j] = root[j] * seen[j]
    size = len(basis_t)
    multiply_vector(basis_t, z, overlap[:size])
    for i in range(size):
        for j in range(z.size):
            z[j] -= overlap[i] * basis_t[i, j]
    for j in range(z.size):
        z[j] *= scale2 * root[j]
    _add_rows(z, rows, loads)


@njit_part
def _add_rows(factors: Float, rows: Float, out: Float) -> None:
    """Write the sum of the ``rows`` (n, m), each times its factor (n,), into ``out`` (m,)."""
    for j in range(out.size):
        out[j] = 0.0
    for i in range(factors.size):
        if factors[i] != 0.0:
            row, factor = rows[i], factors[i]
            for j in range(out.size):
                out[j] += factor * row[j]


@njit_part
def _fit_scale(z: Float, gain: Float, level: float, scale2: float) -> float:
    """Return the s² that maximises the evidence of ``z`` (n,), by fixed-point iteration from ``scale2``.

    MacKay's fixed-point equation is Σ E[x]² = s² Σ (1 − posterior / prior variance).
    """
    for _ in range(SCALE_STEPS):
        power, count = 0.0, 0.0
        for j in range(z.size):
            variance = scale2 * gain[j] + level
            share = scale2 * gain[j] / variance
            power += share * scale2 * z[j] * z[j] / variance
            count += share
        last, scale2 = scale2, max(power / count, SCALE_LEAST)
        if abs(scale2 - last) <= SCALE_CLOSE * last:
            break
    return scale2
