"""Geometry errors: the manufacturing errors of a patch, estimated as nuisance parameters.

The resistances at rest (R₀) are measured, so a geometry error θ has no effect on the residuals at rest. Away
from rest, the effect is θ times the difference between ∂ ln F/∂θ and its value at rest. The effect grows with
the depth of a press. Each error is expressed in units of its tolerance, so its prior variance is 1.

- Thickness: all upper electrodes are shifted along their normals, in proportion to the clearance.
- Radius: the mean of F over the rims of electrodes of radius ρ is F + (ρ²/2) ∇²F, where ∇² is the Laplacian
  within the surface. Each layer contributes half of the correction. The nuisance is ρ² in units of the
  squared tolerance.
- Gain: the change in each resistance is multiplied by e^γ. Half of the variance of γ is common to the patch;
  the other half is independent for each upper wire.
- Placement: each upper and each lower wire is shifted along x, y and z.

The residuals are computed from the shifted geometry itself; the shifts are not linearised. At a relative
noise of 1e-5, the second-order effect of a placement error of 0.02 pitch is a hundred standard deviations.
Each residual depends on ten of the nuisances; the other elements of H are zero and are not stored.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.kernels import potential, potential_jacobian, surface_laplacian
from skinnode.model.layout import Float
from skinnode.model.tolerances import Tolerances
from skinnode.solve.linalg.vectors import Index, dot
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.wires.problem import PatchProblem

THICKNESS: Final = 0
RADIUS: Final = 1
GAIN: Final = 2
COMMON: Final = 3
"""Number of nuisances common to the whole patch: thickness, radius and gain. These nuisances are the first
elements of g."""
UPPER: Final = 4
"""Number of nuisances of each upper wire: shifts along x, y and z, and gain."""
LOWER: Final = 3
"""Number of nuisances of each lower wire: shifts along x, y and z."""
EFFECTS: Final = COMMON + UPPER + LOWER
"""Number of geometry nuisances that affect each residual."""
GAIN_SHARE: Final = math.sqrt(0.5)
"""Standard deviation of each of the two parts of a gain error, in units of the tolerance. The first part is
common to all wires and models a shared converter. The second part is independent for each upper wire and
models one converter per wire."""


def nuisances(wires: int, equations: int) -> int:
    """Return the number of geometry nuisances of a patch with U upper and K lower wires."""
    return COMMON + UPPER * wires + LOWER * equations


class GeometryError:
    """Residuals of a patch with geometry errors g, and their derivatives with respect to g.

    Args:
        problem: The patch.
        elastic: Elastic prior of the patch, which provides the surface normals.
        tolerances: Manufacturing tolerances of the patch, used as the standard deviations of the errors.
    """

    def __init__(self, problem: PatchProblem, elastic: ElasticPrior, tolerances: Tolerances) -> None:
        layout = problem.layout
        wires, equations = layout.shape
        normal = elastic.frame[elastic.own_cells(), 2]  # (U, N, 3)
        lower = layout.lower_m.reshape(-1, 3)
        gap = layout.upper_m[:, :, None] - lower
        nearest = np.argmin((gap**2).sum(axis=-1), axis=-1)
        height = ((layout.upper_m - lower[nearest]) * normal).sum(axis=-1) / layout.pitch_m
        self._problem = problem
        self._normal = np.ascontiguousarray(normal.reshape(wires, -1))
        self._outward = tolerances.thickness * (normal * height[..., None]).reshape(wires, -1)
        self._placement = tolerances.placement
        self._square = 0.5 * tolerances.electrode_radius**2
        self._gain = GAIN_SHARE * tolerances.gain
        self._rows = np.zeros((4, equations))
        self._slopes = np.zeros((3, layout.unknowns, equations))

    def linearise(  # noqa: PLR0913 - arrays by name
        self, members: Index, moved: Float, a: Float, weight: Float, g: Float, r: Float, jt: Float,
        effect: Float,
    ) -> None:  # fmt: skip
        """Compute the residuals, their Jacobian and H at a displacement, for the wires ``members``.

        Args:
            members: (P,) numbers of the wires.
            moved: (U, 3N) displacement, in pitches.
            a: (U, K) resistances times gain, R · gain.
            weight: (U, K) weights 1/σ of the resistances.
            g: Geometry nuisances; their number is given by :func:`nuisances`.
            r: (U, K) receives the residuals for ``g``.
            jt: (U, 3N, K) receives the transposed Jacobian ∂r/∂xᵀ.
            effect: (U, K, EFFECTS) receives H = −∂r/∂g.
        """
        shift, lower = self._shifts(g)
        problem = self._problem
        _linearise(
            members, problem.rest + moved + shift, problem.rest + shift, lower, a, problem.a_rest, weight,
            self._normal, self._outward, self._placement, self._square, self._gain, g, self._rows,
            self._slopes, r, jt, effect,
        )  # fmt: skip

    def residuals(  # noqa: PLR0913 - arrays by name
        self, members: Index, moved: Float, a: Float, weight: Float, h: Float, own: Float, g: Float, r: Float
    ) -> float:
        """Write the residuals of the wires ``members`` into ``r`` (U, K), and return their sum of squares.

        The residuals are r − H g. ``h`` (U, K, p) and ``own`` (p,) are the effects and the values of the
        other nuisances. The geometry nuisances ``g`` enter through the shifted geometry.
        """
        shift, lower = self._shifts(g)
        problem = self._problem
        return _residuals(
            members, problem.rest + moved + shift, problem.rest + shift, lower, a, problem.a_rest, weight,
            self._normal, self._square, self._gain, h, own, g, self._rows, self._slopes, r,
        )  # fmt: skip

    def _shifts(self, g: Float) -> tuple[Float, Float]:
        """Return the upper electrodes' shifts (U, 3N) and shifted lower electrodes (3, M, K), in pitches."""
        wires, coordinates = self._problem.rest.shape
        upper = g[COMMON : COMMON + UPPER * wires].reshape(wires, UPPER)[:, :3]
        lower = g[COMMON + UPPER * wires :].reshape(-1, LOWER)
        shift = np.tile(self._placement * upper, (1, coordinates // 3)) + g[THICKNESS] * self._outward
        return shift, self._problem.lower + self._placement * lower.T[:, None, :]


@njit_part
def _bend(  # noqa: PLR0913 - a kernel: arrays by name
    x: Float, lower: Float, normal: Float, square: float, out: Float, slope_t: Float
) -> None:
    """Write the effect of the electrodes' radius on F into ``out``, and its derivative into ``slope_t``.

    For point electrodes, the effect is 0 and the derivative is not written.
    """
    if square > 0.0:
        surface_laplacian(x, lower, normal, out, slope_t)
    else:
        for k in range(out.size):
            out[k] = 0.0


@njit
def _linearise(  # noqa: PLR0913 - a kernel: arrays by name
    members: Index, x: Float, rest: Float, lower: Float, a: Float, a_rest: Float, weight: Float,
    normal: Float, outward: Float, placement: float, square: float, gain: float, g: Float, rows: Float,
    slopes: Float, r: Float, jt: Float, effect: Float,
) -> None:  # fmt: skip
    """Write the residuals, Jacobians and H for the shifted positions ``x``, ``rest`` and ``lower``.

    ``rows`` (4, K) and ``slopes`` (3, 3N, K) are work arrays.
    """
    f, bend, rest_bend, rims = rows[0], rows[1], rows[2], rows[3]
    rest_jt, bend_jt, rest_bend_jt = slopes[0], slopes[1], slopes[2]
    for i in range(members.size):
        u = members[i]
        r_u, jt_u, h_u = r[u], jt[u], effect[u]
        potential_jacobian(x[u], lower, r_u, jt_u)
        potential_jacobian(rest[u], lower, f, rest_jt)
        _bend(x[u], lower, normal[u], square, bend, bend_jt)
        _bend(rest[u], lower, normal[u], square, rest_bend, rest_bend_jt)
        correction = math.exp(-gain * (g[GAIN] + g[COMMON + UPPER * u + 3]))
        for k in range(f.size):
            w, own, before = weight[u, k], r_u[k], f[k]
            change = correction * (a[u, k] / a_rest[u, k] - 1.0)
            scale = w * (1.0 + change) / before
            rim = w * square * (bend[k] / own - rest_bend[k] / before)
            h_u[k, RADIUS] = -rim
            h_u[k, GAIN] = w * gain * change * own / before
            h_u[k, COMMON + 3] = h_u[k, GAIN]
            r_u[k] = scale * own - w + rim * g[RADIUS]
            # reuse the work arrays for the factors that _slopes applies to the derivatives
            rims[k] = w * square * g[RADIUS] / own
            bend[k] = scale - rims[k] * bend[k] / own
            at_rest = w * square * g[RADIUS] / before
            f[k] = (scale * own - at_rest * rest_bend[k]) / before
            rest_bend[k] = at_rest
            h_u[k, THICKNESS] = 0.0
            for t in range(3):
                h_u[k, COMMON + t] = 0.0
        _slopes(square, outward[u], placement, rows, slopes, jt_u, h_u)


@njit_part
def _slopes(  # noqa: PLR0913 - a kernel: arrays by name
    square: float, outward: Float, placement: float, rows: Float, slopes: Float, jt: Float, effect: Float
) -> None:
    """Convert one wire's derivatives of F to derivatives of its residuals; write the effects of shifts."""
    f, bend, rest_bend, rims = rows[0], rows[1], rows[2], rows[3]
    for j in range(jt.shape[0]):
        row, before, along, t = jt[j], slopes[0, j], outward[j], COMMON + j % 3
        curve, rest_curve = slopes[1, j], slopes[2, j]
        for k in range(f.size):
            row[k] *= bend[k]
            grown = row[k] - f[k] * before[k]
            if square > 0.0:
                row[k] += rims[k] * curve[k]
                grown += rims[k] * curve[k] - rest_bend[k] * rest_curve[k]
            effect[k, t] -= placement * grown
            effect[k, THICKNESS] -= along * grown
    for k in range(f.size):
        for t in range(3):
            effect[k, COMMON + UPPER + t] = -effect[k, COMMON + t]


@njit
def _residuals(  # noqa: PLR0913 - a kernel: arrays by name
    members: Index, x: Float, rest: Float, lower: Float, a: Float, a_rest: Float, weight: Float,
    normal: Float, square: float, gain: float, h: Float, own: Float, g: Float, rows: Float, slopes: Float,
    r: Float,
) -> float:  # fmt: skip
    """Write the residuals, corrected for all nuisances, into ``r``; return their sum of squares."""
    f, bend, rest_bend = rows[0], rows[1], rows[2]
    total = 0.0
    for i in range(members.size):
        u = members[i]
        r_u = r[u]
        potential(x[u], lower, r_u)
        potential(rest[u], lower, f)
        _bend(x[u], lower, normal[u], square, bend, slopes[1])
        _bend(rest[u], lower, normal[u], square, rest_bend, slopes[2])
        correction = math.exp(-gain * (g[GAIN] + g[COMMON + UPPER * u + 3]))
        for k in range(f.size):
            rim = square * g[RADIUS] * (bend[k] / r_u[k] - rest_bend[k] / f[k])
            change = correction * (a[u, k] / a_rest[u, k] - 1.0)
            r_u[k] = weight[u, k] * ((1.0 + change) * r_u[k] / f[k] - 1.0 + rim)
            for q in range(own.size):
                r_u[k] -= h[u, k, q] * own[q]
        total += dot(r_u, r_u)
    return total


@njit_part
def effect_on(  # noqa: PLR0913 - a kernel
    effect: Float, u: int, k: int, g: Float, first: int, wires: int
) -> float:
    """Return the effect H g on one residual; the geometry nuisances start at ``g[first]``."""
    total, row = 0.0, effect[u, k]
    upper, lower = first + COMMON + UPPER * u, first + COMMON + UPPER * wires + LOWER * k
    for q in range(COMMON):
        total += row[q] * g[first + q]
    for q in range(UPPER):
        total += row[COMMON + q] * g[upper + q]
    for q in range(LOWER):
        total += row[COMMON + UPPER + q] * g[lower + q]
    return total


@njit_part
def add_effect(  # noqa: PLR0913 - a kernel
    effect: Float, u: int, k: int, value: float, g: Float, first: int, wires: int
) -> None:
    """Add ``value`` times one column of Hᵀ to the geometry nuisances, which start at ``g[first]``."""
    row = effect[u, k]
    upper, lower = first + COMMON + UPPER * u, first + COMMON + UPPER * wires + LOWER * k
    for q in range(COMMON):
        g[first + q] += value * row[q]
    for q in range(UPPER):
        g[upper + q] += value * row[COMMON + q]
    for q in range(LOWER):
        g[lower + q] += value * row[COMMON + UPPER + q]


@njit_part
def _product(first: Float, second: Float, start: int, stop: int) -> float:
    """Return the dot product of the effects on two residuals, over the indices ``start`` to ``stop`` − 1."""
    total = 0.0
    for q in range(start, stop):
        total += first[q] * second[q]
    return total


@njit
def add_covariance(members: Index, effect: Float, g: Float, y: Float, s: Float) -> None:
    """Add H Hᵀ to the upper triangle of ``s``, and −H g to ``y``, for the wires ``members``.

    ``g`` contains only the geometry nuisances. All residuals depend on the common nuisances. In addition,
    residuals of the same upper wire share the nuisances of that wire, and so do residuals of the same lower
    wire.
    """
    wires, equations = effect.shape[0], effect.shape[1]
    for j in range(members.size):
        v = members[j]
        for k in range(equations):
            y[j * equations + k] -= effect_on(effect, v, k, g, 0, wires)
        for i in range(j + 1):
            u = members[i]
            for k in range(equations):
                own, row = effect[u, k], s[i * equations + k]
                shared = COMMON + UPPER if i == j else COMMON
                for m in range(k if i == j else 0, equations):
                    row[j * equations + m] += _product(own, effect[v, m], 0, shared)
                row[j * equations + k] += _product(own, effect[v, k], COMMON + UPPER, EFFECTS)


@njit
def estimate(members: Index, effect: Float, v: Float, g: Float) -> None:
    """Write −Hᵀ v, with v = S⁻¹ y, into the geometry nuisances ``g``."""
    wires, equations = effect.shape[0], effect.shape[1]
    for q in range(g.size):
        g[q] = 0.0
    for i in range(members.size):
        for k in range(equations):
            add_effect(effect, members[i], k, -v[i * equations + k], g, 0, wires)


@njit
def add_variance(  # noqa: C901 - a kernel: sums as loops
    members: Index, effect: Float, gain_t: Float, work: Float, out: Float
) -> None:
    """Add diag(K H Hᵀ Kᵀ) to ``out`` (n,). ``gain_t`` (m, n) is Kᵀ; ``work`` (EFFECTS, n) is a work array."""
    equations, n = effect.shape[1], out.size
    for j in range(COMMON * n):
        work[j // n, j % n] = 0.0
    for i in range(members.size):
        for t in range(COMMON, COMMON + UPPER):
            for j in range(n):
                work[t, j] = 0.0
        for k in range(equations):
            row, own = gain_t[i * equations + k], effect[members[i], k]
            for t in range(COMMON + UPPER):
                for j in range(n):
                    work[t, j] += own[t] * row[j]
        for t in range(COMMON, COMMON + UPPER):
            for j in range(n):
                out[j] += work[t, j] * work[t, j]
    for t in range(COMMON):
        for j in range(n):
            out[j] += work[t, j] * work[t, j]
    for k in range(equations):
        for t in range(LOWER):
            for j in range(n):
                work[t, j] = 0.0
        for i in range(members.size):
            row, own = gain_t[i * equations + k], effect[members[i], k]
            for t in range(LOWER):
                for j in range(n):
                    work[t, j] += own[COMMON + UPPER + t] * row[j]
        for t in range(LOWER):
            for j in range(n):
                out[j] += work[t, j] * work[t, j]
