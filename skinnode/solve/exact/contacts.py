"""Estimates the loads and contacts that explain a displacement field of the exact inverse.

The field u is modelled as the sum of three terms:

- G q: displacement due to the loads q ~ N(0, s²) of the elastic prior;
- slack: displacement not explained by loads, with a standard deviation of ε s;
- e ~ N(0, ν² Σ): error of the exact inverse, with the error covariance Σ at rest. The factor ν² is computed
  from the standard deviations of the field.

With the singular value decomposition

    Σ^(−1/2) [G, ε I] = U S Vᵀ,   z = Uᵀ Σ^(−1/2) u,   B = Uᵀ Σ^(−1/2) G

the covariance s² S² + ν² of z is diagonal for every s and ν. The matrices Uᵀ Σ^(−1/2) and B are computed once
per patch. Each frame then requires two matrix-vector products, one for z and one for
q = s² Bᵀ (s² S² + ν²)⁻¹ z. The scale s maximises the evidence.

Wires without a position, or with a much larger standard deviation than the other wires, are left out: their
rows are projected out of z and B. The projection of B takes a few milliseconds, so the result is cached.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit
from skinnode.model.elastic import Rubber
from skinnode.model.forward import jacobian
from skinnode.model.frames import Contact, FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.process.clock import perf_counter
from skinnode.solve.linalg.cholesky import multiply, multiply_vector, solve_positive, subtract_product
from skinnode.solve.linalg.vectors import Index, orthonormalise
from skinnode.solve.options import TrackerOptions
from skinnode.solve.posterior.contacts import ContactFinder, LoadEstimate
from skinnode.solve.posterior.elastic_prior import SLACK, ElasticPrior
from skinnode.solve.wires.problem import PatchProblem

UNTOUCHED: Final = 4.0
"""Maximum displacement, in standard deviations, of a patch that is considered untouched.

Noise alone exceeds this limit in 2 % of frames, which are then searched for contacts.
"""
WILD: Final = 16.0
"""Ratio of a wire's variance to the median over all wires above which the wire is left out. All variances are
relative to their values at rest."""
SCALE_STEPS: Final = 30
"""Maximum number of fixed-point iterations for s²."""
SCALE_CLOSE: Final = 0.01
"""Relative change in s² at which the iteration stops; the relative change in the loads is smaller."""
SCALE_LEAST: Final = 1e-12
"""Lower limit of s², in pitch²."""


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


class ExactContacts:
    """Estimates the contacts in a stream of exact fields; each stream needs its own instance.

    Args:
        layout: The patch.
        options: Options of the tracker.
    """

    def __init__(self, layout: PatchLayout, options: TrackerOptions) -> None:
        self.layout = layout
        noise = np.broadcast_to(np.asarray(options.relative_noise, float), layout.shape)
        level = float(np.sqrt(np.mean(noise[np.isfinite(noise)] ** 2)))
        uniform = bool((noise == noise.flat[0]).all())
        self._factors = (
            _cached_factors(layout, options.rubber, level, options.normal_only)
            if uniform
            else _factors(layout, options.rubber, np.array(noise), options.normal_only)
        )
        factors = self._factors
        self._finder = ContactFinder(
            factors.prior,
            layout,
            options.rubber,
            calibrated=options.force_calibrated,
            outermost=False,
        )
        n, loads = factors.rows.shape
        self._z, self._weight, self._moved, self._load = (
            np.empty(n),
            np.empty(n),
            np.empty(n),
            np.empty(loads),
        )
        self._share = np.ones(loads // 3)
        self._stiff = options.stiffness_n_per_m is not None
        self._field = np.empty((2, layout.upper_m.size))
        self._ratio, self._sorted = np.empty((2, layout.upper_m.shape[0]))
        self._no_contacts: tuple[Contact, ...] = ()
        self.no_force_n = np.zeros(layout.upper_m.shape)
        """(U, N, 3) zero forces of an untouched patch, in N; read-only."""
        self.no_force_n.setflags(write=False)
        self._wire = factors.free // (3 * layout.upper_m.shape[1])
        self.reset()
        solved = np.full(n, 1e-3)
        self._finder.warm_up(self._estimate(solved, 1.0))
        # The following two calls compile the kernels before a stream starts.
        self._find(np.zeros(layout.upper_m.shape), np.ones(layout.upper_m.shape))
        self._estimate_without(np.arange(len(layout.upper_m)) == 0, 1.0)
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        self._finder.reset()
        self._scale2 = 1e-4
        self._force, self._contacts, self._known = self.no_force_n, self._no_contacts, False
        # wires left out, s² and ν² of the last projection, its basis, and the projected matrix B
        self._without: tuple[bytes, float, float, Float, Float] | None = None

    def add(self, field: FieldFrame) -> FieldFrame:
        """Return the field with its contacts and, unless the ``stiffness_n_per_m`` option is set, its forces.

        Wires with an infinite standard deviation are ignored. If every wire is ignored, there are no contacts
        and all forces are zero.

        Args:
            field: Field of the exact method, after its roots and readings have been checked.
        """
        start = perf_counter()
        held = field.held is not None and bool(field.held.all())
        if not (held and self._known):
            self._force, self._contacts = self._find(field.displacement_m, field.displacement_std_m)
            self._known = True
        if not self._contacts and (self._stiff or self._force is field.force_n):
            return field
        force, contacts = self._force, self._contacts
        stats = dataclasses.replace(field.stats, time_s=field.stats.time_s + perf_counter() - start)
        if self._stiff:
            return dataclasses.replace(field, contacts=contacts, stats=stats)
        return dataclasses.replace(field, contacts=contacts, force_n=force, stats=stats)

    def _find(self, displacement_m: Float, std_m: Float) -> tuple[Float, tuple[Contact, ...]]:
        np.copyto(self._field[0], displacement_m.ravel())
        np.copyto(self._field[1], std_m.ravel())
        factors = self._factors
        largest, level, wild = _judge(
            self._field, factors.free, factors.rest_std, self.layout.pitch_m, self._moved, self._ratio,
            self._sorted,
        )  # fmt: skip
        if not largest > UNTOUCHED:  # untouched, or all standard deviations are infinite
            self._finder.reset()
            return self.no_force_n, ()
        if wild:
            left_out = ~(self._ratio <= WILD * level)
            loads = self._estimate_without(left_out, level)
            std_m = np.where(left_out[:, None, None], np.inf, std_m)
        else:
            loads = self._estimate(self._moved, level)
        return self._finder.find(loads, displacement_m, std_m)

    def _estimate(self, moved: Float, level: float) -> LoadEstimate:
        """Return the loads that explain the displacement ``moved`` (n,) in pitches, for ν² = ``level``."""
        factors = self._factors
        self._scale2 = _solve_loads(
            moved, factors.whitening, factors.gain, factors.rows, level, self._scale2,
            self._z, self._weight, self._load,
        )  # fmt: skip
        return LoadEstimate(self._load.reshape(-1, 3), factors.rows, self._weight, self._share, self._scale2)

    def _estimate_without(self, left_out: NDArray[np.bool_], level: float) -> LoadEstimate:
        """Return the loads that explain the displacement of all wires except ``left_out`` (U,).

        The scale s is computed with the wires left out at their most probable positions.
        """
        factors, gone = self._factors, left_out[self._wire]
        moved = np.where(gone, 0.0, self._moved)
        columns_t = np.ascontiguousarray(factors.whitening[gone])  # shape (left-out coordinates, n)
        columns, weighted = np.ascontiguousarray(columns_t.T), np.empty_like(columns_t)
        size, n = columns_t.shape
        precision, unknown, seen = np.empty((size, size)), np.empty(size), np.empty(n)
        multiply(moved[None], factors.whitening, seen[None])
        for _ in range(2):
            np.divide(columns_t, self._scale2 * factors.gain + level, out=weighted)
            multiply(weighted, columns, precision)
            multiply_vector(weighted, seen, unknown)
            if solve_positive(precision, unknown, size):
                moved[gone] = -unknown
            self._estimate(moved, level)
        key = left_out.tobytes()
        known = self._without
        if (
            known is None
            or known[0] != key
            or abs(known[1] / self._scale2 - 1) > 0.25
            or abs(known[2] / level - 1) > 0.25
        ):
            root = 1.0 / np.sqrt(self._scale2 * factors.gain + level)
            basis_t = columns_t * root
            orthonormalise(basis_t)
            basis, rows, shared = (
                np.ascontiguousarray(basis_t.T),
                np.empty_like(factors.rows) if known is None else known[4],
                np.empty((size, self._load.size)),
            )
            np.multiply(root[:, None], factors.rows, out=rows)
            multiply(basis_t, rows, shared)
            subtract_product(basis, shared, rows)
            known = self._without = key, self._scale2, level, basis_t, rows
        _, scale2, level, basis_t, rows = known
        y = seen / np.sqrt(scale2 * factors.gain + level)
        part, q = np.empty(size), np.empty(self._load.size)
        multiply_vector(basis_t, y, part)
        subtract_product(part[None], basis_t, y[None])
        multiply(y[None], rows, q[None])
        q *= scale2
        return LoadEstimate(q.reshape(-1, 3), rows, np.ones(n), self._share, scale2)


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
def _judge(  # noqa: PLR0913 - a kernel: field, factors and outputs by name
    field: Float,
    free: Index,
    rest_std: Float,
    pitch: float,
    moved: Float,
    ratio: Float,
    ordered: Float,
) -> tuple[float, float, bool]:
    """Find the largest displacement in a field and the wires with unusually large standard deviations.

    Args:
        field: (2, 3UN) displacements and their standard deviations, in m.
        free: (n,) indices of the free coordinates.
        rest_std: (n,) standard deviations of the free coordinates at rest, in pitches.
        pitch: Pitch, in m.
        moved: (n,) output: displacements of the free coordinates, in pitches.
        ratio: (U,) output: each wire's mean ratio of a variance to the variance at rest; inf if a variance is
            infinite.
        ordered: (U,) work array.

    Returns:
        The largest displacement, in standard deviations; the median of the finite ratios; and True if any
        wire's ratio exceeds :data:`WILD` times the median.
    """
    largest, each, known = 0.0, free.size // ratio.size, 0
    for u in range(ratio.size):
        ratio[u] = 0.0
        for j in range(u * each, (u + 1) * each):
            at, std = field[0, free[j]], field[1, free[j]]
            moved[j] = at / pitch
            if std > 0.0:
                largest = max(largest, abs(at) / std)
            ratio[u] += (std / (pitch * rest_std[j])) ** 2 / each
        if ratio[u] < math.inf:
            place = known
            while place > 0 and ordered[place - 1] > ratio[u]:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = ratio[u]
            known += 1
    if known == 0:
        return 0.0, 1.0, True
    level, wild = ordered[known // 2], False
    for u in range(ratio.size):
        wild = wild or not ratio[u] <= WILD * level
    return largest, level, wild


@njit
def _solve_loads(  # noqa: PLR0913, C901 - a kernel: field, matrices and outputs by name, sums as loops
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

    Writes ``z`` (n,), (s² S² + ν²)^(−1/2) to ``weight`` (n,), and the posterior mean to ``loads`` (3Q,).
    """
    for j in range(z.size):
        z[j] = 0.0
    for i in range(moved.size):
        if moved[i] != 0.0:
            row, factor = whitening[i], moved[i]
            for j in range(z.size):
                z[j] += factor * row[j]
    # MacKay's fixed-point equation: Σ E[x]² = s² Σ (1 − posterior / prior variance)
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
    for q in range(loads.size):
        loads[q] = 0.0
    for j in range(z.size):
        variance = scale2 * gain[j] + level
        weight[j] = 1.0 / variance**0.5
        factor, row = scale2 * z[j] / variance, rows[j]
        for q in range(loads.size):
            loads[q] += factor * row[q]
    return scale2
