"""Verdict on a point, computed in 80-bit arithmetic: is there a root, or a minimum of ‖r‖, at x?

Newton's method started from x, on r for a root and on Jᵀr for a minimum, gives the nearest root or stationary
point; its distance from x is the error of x.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .more_garbow_hillstrom import Problem, Vector

LONG = np.longdouble
DIGITS = np.finfo(LONG).eps < 1e-18
"""Whether this machine has extended precision."""


@dataclass(frozen=True)
class Verdict:
    """The nearest root, else the nearest stationary point of ‖r‖."""

    root: bool
    minimum: bool
    """Stationary, and the Hessian has no negative eigenvalue."""
    isolated: bool
    """The Hessian has no zero eigenvalue."""
    error: float
    """max |x − x*| / max(1, ‖x‖∞), x* the nearest root or stationary point."""
    norm: float
    """‖r‖₂ at x."""
    cosine: float
    """Largest cosine of the angle between r and a column of the Jacobian; columns too short to be squared in
    64 bits do not count."""


def _columns(j: Vector) -> Vector:
    size = np.sqrt((j * j).sum(0))
    return np.where(size > 0, size, 1)


def _solve(a: Vector, b: Vector) -> Vector:
    return np.linalg.lstsq(a.astype(float), b.astype(float), rcond=1e-14)[0].astype(LONG)


def hessian(problem: Problem, x: Vector) -> Vector:
    """Hessian of ½ ‖r‖² at x: JᵀJ, and Σ r ∇²r by central differences of Jᵀr at constant r, in 80 bits."""
    r, j = problem.pair(x)
    out = np.empty((x.size, x.size), LONG)
    for k in range(x.size):
        ends = np.stack([x, x])
        ends[:, k] += np.array([1e-6, -1e-6]) * (abs(x[k]) if abs(x[k]) > 1e-6 else 1)
        out[k] = (problem.jacobian(ends[0]) - problem.jacobian(ends[1])).T @ r / (ends[0, k] - ends[1, k])
    return j.T @ j + (out + out.T) / 2


def verdict(problem: Problem, point: Vector, polish: int = 60) -> Verdict:
    """Judge a point, whatever a solver says of it."""
    with np.errstate(all="ignore"):
        return _verdict(problem, point.astype(LONG), polish)


def _verdict(problem: Problem, x: Vector, polish: int) -> Verdict:
    r, j = problem.pair(x)
    norm = np.sqrt(r @ r)
    d = _columns(j)
    cosine = float((np.abs(j.T @ r) / d)[d > 1e-150].max(initial=0) / norm) if norm > 0 else 0.0
    nowhere = Verdict(False, False, False, np.inf, float(norm), cosine)
    if not (np.isfinite(r).all() and np.isfinite(j.astype(float)).all()):
        return nowhere
    size = max(1.0, float(np.abs(x).max()))
    away = _root_near(problem, x, polish)
    if away is not None and np.abs(away - x).max() <= 1e-4 * size:
        return Verdict(True, True, True, float(np.abs(away - x).max()) / size, float(norm), cosine)
    y = x.copy()
    for _ in range(polish):
        r, j = problem.pair(y)
        d = _columns(j)
        h = hessian(problem, y) / np.outer(d, d)
        if not np.isfinite(h.astype(float)).all():
            return nowhere
        step = -_solve(h, j.T @ r / d) / d
        y = y + step
        if not np.abs(y - x).max() <= 1e-3 * size:
            return nowhere
        if np.abs(step).max() <= 1e-15 * size:
            break
    r, j = problem.pair(y)
    d = _columns(j)
    slope = np.abs(j.T @ r) / d
    rounded = (np.abs(j).T @ (np.abs(j) @ np.abs(y))) / d * LONG(1e-15)
    if not (slope <= 1e-12 * np.sqrt(r @ r) + rounded).all():
        return nowhere
    bend = np.linalg.eigvalsh((hessian(problem, y) / np.outer(d, d)).astype(float))
    top = np.abs(bend).max()
    return Verdict(
        False,
        bool(bend[0] >= -1e-9 * top),
        bool(np.abs(bend).min() > 1e-14 * top),
        float(np.abs(y - x).max()) / size,
        float(norm),
        cosine,
    )


def _root_near(problem: Problem, x: Vector, polish: int) -> Vector | None:
    """The root that Newton's method reaches from x, if its residual vanishes to rounding of x in 64 bits."""
    y = x.copy()
    for _ in range(polish):
        r, j = problem.pair(y)
        if not (np.isfinite(r).all() and np.isfinite(j.astype(float)).all()):
            return None
        d = _columns(j)
        step = -_solve(j / d, r) / d
        y = y + step
        if np.abs(step).max() <= 1e-17 * max(1.0, float(np.abs(y).max())):
            break
    r, j = problem.pair(y)
    floor = np.abs(j) @ np.abs(y) * LONG(1e-15) + LONG(1e-14)
    return y if (np.abs(r) <= np.minimum(floor, 1e-6)).all() else None
