"""Which root of F = b the rubber is at. Zero residuals are no proof: F = b has several roots.

Rubber is smooth, so the displacement of a wire has a Gaussian covariance, C_ij = s² exp(−d_ij² / 2ℓ²) of
each coordinate with d the distance of two electrodes at rest. That is weaker than the elasticity of a patch,
needs no constant of the material and serves two ends:

guided_start   the smooth displacement that explains the resistances: the maximum a posteriori estimate,
               followed from much noise to none (data-space Gauss-Newton, Tarantola 2005, section 3.4)
near_twin      where J is close to singular a second root lies close by, on the other side of the fold. To
               second order along the direction v that J maps onto the least, σ α + ½ α² wᵀF″[v, v] = 0 has
               the twin at α = −2σ / wᵀF″[v, v] (Golubitsky & Schaeffer 1985, chapter I.3)
roughness      √(uᵀ C⁻¹ u): of two roots the smoother one is the more likely by far
"""

from __future__ import annotations

import functools
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.compiled.jit import njit
from skinnode.model.forward import jacobian
from skinnode.model.kernels import potential_jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.linalg.factorisations import Index, dot, largest, lu_factor, lu_solve_transposed, padded
from skinnode.solve.wires.problem import PatchProblem

CORRELATION_PITCHES: Final = 1.0
"""ℓ. With 1.0 the guided start finds 3204 of the 3209 wires that are on the branch of the rest position, in
82 random presses each of 70 % on staggered, h = 0.5, and 10, 30 and 50 % on h = 1; 0.7 and 1.5 lose more."""
ROUGH_SHARE: Final = 1e-3
"""Share of C that is not smooth, so that C⁻¹ exists in floating point."""
NOISE_LEVELS: Final[Float] = np.power(10.0, -0.5 * np.arange(2.0, 16.0))
"""Standard deviations of r the guided start goes through, 0.1 to 3e-8, one step each. Whole decades lose one
wire in a hundred more at h = 1 and 50 %."""
POWER_STEPS: Final = 8
"""Of the inverse iteration: singular values next to the least one are some 3 times larger."""
DIFFERENCE: Final = 1e-4
"""Pitches, of the second derivative: about eps^(1/3) and far below any clearance."""


FOLDED: Final = 250.0
"""RMS of ∂x/∂(ln R) at rest over the clearance from which on presses run into folds: 70 on staggered at h =
0.5, where none of 6000 wires did, 1200 and more on staggered from h = 1 on and on aligned and symmetric,
where one in 30 ends on a wrong root."""
BLIND: Final = 1e7
"""∂x/∂(ln R) of a wire over the clearance from which on a root says nothing: its electrodes cross the layer
within the seventh digit of R. Wires on a symmetry line of the layout are like that, where each root has its
mirror image; of the others only those of layers of 1.5 pitches and more above aligned lower wires."""
JUMP: Final = 0.2
"""Share of the clearance by which an electrode may move between two frames before a root is no longer taken
for the right one because it is the next one: folds were passed from 0.24 on."""
NEARLY_BLIND: Final = 1e5
"""The same where a root has to be clearly likelier than any other: aligned from h = 1 on."""
REFEREE_NOISE: Final = 1e-5
"""Least noise of the posterior of the patch when it is asked about a root: with less it is drawn to roots
itself."""
AGREE: Final = 6.0
"""Deviations within which that posterior confirms a root."""


class Smoothness:
    """C of every upper wire of a patch, pitches²."""

    def __init__(self, problem: PatchProblem) -> None:
        self._problem = problem
        self.covariance: Float
        """(U, n, n)"""
        self.whitening: Float
        """(U, N, N) inverse of the Cholesky factor of one coordinate's C."""
        self.covariance, self.whitening = _smooth(problem.layout, problem.step_limit)

    def roughness(self, x: Float) -> Float:
        """(U,) √(uᵀ C⁻¹ u) of x (U, n), in standard deviations."""
        displacement = (x - self._problem.rest).reshape(self._problem.layout.upper_m.shape)
        return np.asarray(np.sqrt(((self.whitening @ displacement) ** 2).sum(axis=(1, 2))))


@functools.lru_cache(maxsize=64)
def _smooth(layout: PatchLayout, size: float) -> tuple[Float, Float]:
    """(U, n, n) C for displacements of ``size``, which hardly matters, tenfold either way, and the
    whitening."""
    electrodes: Float = layout.upper_m / layout.pitch_m
    wires, most = electrodes.shape[:2]
    gaps = electrodes[:, :, None, :] - electrodes[:, None, :, :]
    smooth = np.exp(-(gaps**2).sum(axis=-1) / (2.0 * CORRELATION_PITCHES**2))
    smooth += ROUGH_SHARE * np.eye(most)
    covariance = size**2 * np.einsum("uij,cd->uicjd", smooth, np.eye(3)).reshape(wires, 3 * most, -1)
    whitening = np.linalg.inv(np.linalg.cholesky(smooth)) / size
    covariance.setflags(write=False)
    whitening.setflags(write=False)
    return covariance, whitening


def guided_start(problem: PatchProblem, wire: int, a: Float, covariance: Float) -> tuple[Float, int]:
    """(n,) pitches, near the root of a F = 1 that is likeliest under ``covariance`` (n, n); evaluations.

    ``a`` (K,). Any covariance will do; that of elastic rubber would know the neighbouring wires as well. The
    rest position where it runs into an electrode.
    """
    n, equations = problem.rest.shape[1], a.size
    x = problem.rest[wire].copy()
    y, (jt, spread) = np.empty(equations), np.empty((2, n, equations))
    inner, pivot = padded(equations + 3, equations), np.empty(equations, np.int64)
    evaluations = _follow_noise(
        x, problem.rest[wire], problem.lower, a, covariance, NOISE_LEVELS, y, jt, spread, inner, pivot
    )
    return x, evaluations


@njit
def _follow_noise(
    x: Float,
    rest: Float,
    lower: Float,
    a: Float,
    covariance: Float,
    noises: Float,
    y: Float,
    jt: Float,
    spread: Float,
    inner: Float,
    pivot: Index,
) -> int:
    """One Gauss-Newton step a noise level into ``x`` (n,), C Jᵀ (J C Jᵀ + σ²)⁻¹ y with y = J (x − rest) − r;
    evaluations. All behind ``noises`` is scratch, ``inner`` with zeros as :func:`lu_factor` wants it."""
    n, equations = jt.shape
    for level in range(noises.size):
        potential_jacobian(x, lower, y, jt)
        for k in range(equations):
            y[k] = 1.0 - a[k] * y[k]
        for i in range(n):
            row, moved = jt[i], x[i] - rest[i]
            for k in range(equations):
                row[k] *= a[k]
                y[k] += moved * row[k]
        inner[:equations, :equations] = 0.0
        for i in range(n):
            target, source = spread[i], jt[i]
            target[:] = 0.0
            for j in range(n):
                share = covariance[i, j]
                if share != 0.0:
                    row = jt[j]
                    for k in range(equations):
                        target[k] += share * row[k]
            for k in range(equations):
                row = inner[k]
                for m in range(equations):
                    row[m] += source[k] * target[m]
        for k in range(equations):
            inner[k, k] += noises[level] * noises[level]
        found = lu_factor(inner, pivot) != 0
        if found:
            lu_solve_transposed(inner, pivot, y)
            for i in range(n):
                x[i] = rest[i] + dot(spread[i], y)
        if not (found and largest(x) < math.inf):
            for i in range(n):
                x[i] = rest[i]
            return level + 1
    return noises.size


def near_twin(problem: PatchProblem, x: Float, a: Float, inverse: Float) -> Float:
    """(n,) estimate of the root on the other side of the nearest fold; x, a and ``inverse`` ∂x/∂r of a wire.

    Costs two Jacobians. Not finite where there is no fold to second order.
    """
    w = np.ones(a.size)
    for _ in range(POWER_STEPS):
        w = (inverse @ w) @ inverse
        w /= math.sqrt(w @ w)
    v = inverse @ w
    least = 1.0 / math.sqrt(v @ v)
    v *= least
    f, jt = np.empty(a.size), np.empty((x.size, a.size))
    slopes = []
    for side in (DIFFERENCE, -DIFFERENCE):
        potential_jacobian(x + side * v, problem.lower, f, jt)
        slopes.append(v @ (jt * a))
    curvature = w @ (slopes[0] - slopes[1]) / (2.0 * DIFFERENCE)
    return np.asarray(x - 2.0 * least / curvature * v)


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> NDArray[np.bool_]:
    """(U,) wires on which presses run into folds of F = b."""
    return wire_deviations(layout, 1.0, normal_only) > FOLDED


def exact_deviation(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> float:
    """RMS deviation of the exact inverse at rest over the least clearance of an electrode: the Cramér-Rao
    bound J⁺ diag(σ²) J⁺ᵀ. Inf where a Jacobian is singular."""
    return math.sqrt(float((wire_deviations(layout, relative_noise, normal_only) ** 2).mean()))


def wire_deviations(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> Float:
    """(U,) :func:`exact_deviation` wire by wire."""
    if np.ndim(relative_noise) == 0:
        return np.asarray(relative_noise) * _unit_deviations(layout, normal_only)
    return _deviations(layout, np.broadcast_to(relative_noise, layout.shape), normal_only)


@functools.lru_cache(maxsize=64)  # 3 ms a layout, and asked for by every path
def _unit_deviations(layout: PatchLayout, normal_only: bool) -> Float:
    return _deviations(layout, np.ones(layout.shape), normal_only)


def _deviations(layout: PatchLayout, relative_noise: Float, normal_only: bool) -> Float:
    problem = PatchProblem.of(layout)
    slopes = jacobian(layout, layout.upper_m) * layout.pitch_m**2 * problem.a_rest[..., None, None]
    slopes = slopes[..., 2:] if normal_only else slopes
    weighted = slopes.reshape(*layout.shape, -1) / relative_noise[..., None]
    singular = np.linalg.svd(weighted, compute_uv=False)
    with np.errstate(divide="ignore"):
        variance = (1.0 / singular**2).sum(axis=1) / weighted.shape[2]
    return np.asarray(np.sqrt(variance) / problem.clearance.min())
