"""Second-order test for minima of ‖r‖ with r ≠ 0, and Newton's method for such minima.

The Hessian of ½ ‖r‖² is JᵀJ + S. S = Σ_k r_k ∇²r_k is computed from central differences of Jᵀr with constant
r. With the column norms D of J, the decomposition J D⁻¹ = U Σ Vᵀ and C = Vᵀ D⁻¹ S D⁻¹ V, the Hessian is
D V (Σ² + C) Vᵀ D. This form avoids the product JᵀJ.

The test scales Σ² + C: row k and column k are divided by √(σ_k² + ν), where ν is the rounding error of C. The
smallest eigenvalue of the scaled matrix is 1 at a minimum with r = 0, about 0 at a flat point, and negative
at a saddle point.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.operators.codes import EPS, STATIONARY

DIFFERENCE: Final = EPS ** (1 / 3)
"""Relative step of a central difference; it balances truncation and rounding errors."""
NOISE: Final = EPS ** (2 / 3)
"""Relative rounding error of a central difference with the step :data:`DIFFERENCE`."""
CURVED: Final = 0.05
"""Limit above which the smallest scaled eigenvalue of the Hessian is considered positive.

On the problems of Moré, Garbow & Hillstrom, this eigenvalue is at most 2e-6 at flat points and at least 0.38
at isolated minima. The exception is Watson's problem with n = 12, where rounding errors reduce the eigenvalue
at the minimum to 0.003.
"""
CONTRACTION: Final = 0.5
"""Ratio of the sizes of successive Newton steps above which the iteration ends."""
NEWTON_STEPS: Final = 8
"""Maximum number of Newton steps to a minimum. With quadratic convergence, 4 steps suffice from an error of
1 %."""


@dataclass(frozen=True)
class Point:
    """A point, its residual and its Jacobian."""

    x: Float
    r: Float
    j: Float

    @property
    def norm(self) -> float:
        """Euclidean norm ‖r‖₂ of the residual."""
        return float(np.linalg.norm(self.r))

    @property
    def cosine(self) -> float:
        """Largest cosine of the angle between r and a column of J; 0 for a zero column or a zero residual."""
        with np.errstate(all="ignore"):
            below = column_norms(self.j) * self.norm
            share = np.divide(np.abs(self.j.T @ self.r), below, out=np.zeros(below.size), where=below > 0)
            return float(share.max())

    @property
    def rounding(self) -> Float:
        """(m,) error of each residual due to rounding of x."""
        return np.asarray(EPS * (np.abs(self.j) @ np.abs(self.x)))

    def is_root(self, tol_f: float) -> bool:
        """Return whether every |r_k| is at most ``tol_f`` or four times the error due to rounding of x."""
        return bool((np.abs(self.r) <= np.maximum(tol_f, 4.0 * self.rounding)).all())


@dataclass(frozen=True)
class Curvature:
    """Second-order properties of ½ ‖r‖² at a point."""

    lowest: float
    """Smallest scaled eigenvalue of the Hessian; about 0 if ‖r‖ is constant in some direction, NaN if a
    number overflowed."""
    step: Float
    """(n,) Newton step towards Jᵀr = 0."""
    error: float
    """Largest error in a coordinate of the minimum due to rounding of r, J and x."""

    @property
    def positive(self) -> bool:
        """Whether the Hessian is positive definite."""
        return self.lowest > CURVED


def column_norms(j: Float) -> Float:
    """Return the Euclidean norms (n,) of the columns of J."""
    return np.asarray(np.sqrt((j * j).sum(axis=0)))


def curvature(jacobian: Callable[[Float], Float], at: Point) -> Curvature:
    """Return the curvature at a point. Computing the Hessian requires 2n Jacobians."""
    n = at.x.size
    d = column_norms(at.j)
    d[d == 0.0] = 1.0
    reach = at.norm / d  # change in each coordinate that, to first order, changes r by ‖r‖
    size = np.maximum(np.abs(at.x), np.minimum(reach, 1.0))
    s = np.empty((n, n))
    for k in range(n):
        ends = np.stack([at.x, at.x])
        ends[:, k] += (DIFFERENCE * size[k], -DIFFERENCE * size[k])
        ahead, behind = jacobian(ends[0]), jacobian(ends[1])
        with np.errstate(all="ignore"):
            s[k] = (ahead - behind).T @ at.r / (ends[0, k] - ends[1, k])
    with np.errstate(all="ignore"):
        s = 0.5 * (s + s.T) / np.outer(d, d)
    if not (np.isfinite(s).all() and np.isfinite(at.j).all()):
        return Curvature(math.nan, np.zeros(n), math.inf)
    u, sigma, vt = np.linalg.svd(at.j / d, full_matrices=False)
    c = vt @ s @ vt.T
    noise = NOISE * float(np.abs(c).max() + (reach / size).max()) + (n * EPS * sigma[0]) ** 2
    share = 1.0 / np.sqrt(sigma**2 + noise)
    bend, q = np.linalg.eigh(np.diag((sigma * share) ** 2) + c * np.outer(share, share))
    if not bend[0] > CURVED:
        return Curvature(float(bend[0]), np.zeros(n), math.inf)
    half = (q.T * share) @ vt / d
    inverse = (half.T / bend) @ half  # Hessian⁻¹
    pseudo = (half.T / bend) @ (q.T * (share * sigma)) @ u.T  # Hessian⁻¹ Jᵀ
    rounded = np.abs(pseudo) @ at.rounding + EPS * (np.abs(inverse) @ (np.abs(at.j).T @ np.abs(at.r)))
    return Curvature(float(bend[0]), -pseudo @ at.r, float((rounded + EPS * np.abs(at.x)).max()))


@dataclass(frozen=True)
class Settled:
    """Outcome of :func:`settle`."""

    at: Point
    lowest: float
    """Smallest scaled eigenvalue of the Hessian at the point; NaN if a number overflowed."""
    error: float
    """Estimate of max |x − x*|; inf unless Jᵀr is zero and the Hessian is positive definite."""


def settle(
    residual: Callable[[Float], Float],
    jacobian: Callable[[Float], Float],
    at: Point,
    tol_x: float,
    max_steps: int,
) -> Settled:
    """Take Newton steps towards Jᵀr = 0 until they converge or fail; assess the last point.

    The steps fail if they no longer contract, if ‖r‖ grows, or if the Hessian is not positive definite.

    Args:
        residual: Function that returns r (m,) for x (n,).
        jacobian: Function that returns J (m, n) for x (n,).
        at: Starting point.
        tol_x: Maximum size of the remaining step, relative to max(1, max|x|).
        max_steps: Maximum number of Newton steps.
    """
    before = math.inf
    for left in range(min(NEWTON_STEPS, max_steps), -1, -1):
        bent = curvature(jacobian, at)
        size = float(np.abs(bent.step).max())
        reached = size <= max(tol_x * max(1.0, float(np.abs(at.x).max())), bent.error)
        if not bent.positive or reached or left == 0 or not size <= CONTRACTION * before:
            break
        x = at.x + bent.step
        r = residual(x)
        if not float(np.linalg.norm(r)) <= at.norm * (1.0 + STATIONARY):
            break
        before, at = size, Point(x, r, jacobian(x))
    # If Jᵀr consists only of rounding errors, the steps no longer contract, but the point is stationary.
    known = bent.positive and (reached or at.cosine <= STATIONARY)
    return Settled(at, bent.lowest, size + bent.error if known else math.inf)
