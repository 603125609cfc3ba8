"""Tests whether the readings of a wire are consistent with the other wires, and whether its gain is correct.

If a wire's readings are delayed or belong to another wire, each reading deviates only slightly from the
prediction by the other wires. A test of single readings does not detect these small deviations. Let G be the
readings of a wire, P the precision, S = P⁻¹ the covariance and α = P z. Two fault hypotheses are compared
with the hypothesis that the wire is healthy:

- Unrelated: z_G has its own distribution N(0, S_GG), independent of the other wires. The log evidence changes
  by ½ α_Gᵀ P_GG⁻¹ α_G − ½ z_Gᵀ S_GG⁻¹ z_G − ½ ln det P_GG S_GG.
- Gain: all readings of the wire are wrong by the same factor 1 + c, c ~ N(0, τ²). The log evidence changes by
  ½ (1ᵀα_G)² / (q + τ⁻²) − ½ ln(1 + τ² q) with q = 1ᵀ P_GG 1.

The changes of the log evidence follow from the rules for conditioning a normal distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float

GAIN_STD: Final = 0.02
"""Assumed standard deviation of a wire's relative gain error; the same value is used for gain drift. Not
tuned."""
LEAST: Final = 1e-9
"""Minimum precision of a reading, in units of 1 / noise²; smaller values result from rounding errors."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class WireTables:
    """Cholesky factors of each wire's blocks of P and S at one κ.

    The arrays of upper wires have the shape (U, K, K), those of lower wires (K, U, U).
    """

    upper_p: Float
    """Cholesky factors of P_GG."""
    upper_s: Float
    """Cholesky factors of S_GG."""
    lower_p: Float
    lower_s: Float
    log_det_p: Float
    """(U + K,) half the log determinant of each wire's block of P, ½ ln det P_GG."""
    log_det_s: Float
    """(U + K,) half the log determinant of each wire's block of S, ½ ln det S_GG."""
    sums: Float
    """(U + K,) sum of the elements of each wire's block of P, 1ᵀ P_GG 1."""

    @classmethod
    def of(cls, p: Float, s: Float, shape: tuple[int, int]) -> WireTables:
        """Compute the tables from the precision ``p`` and the covariance ``s``, both (m, m)."""
        upper, lower = shape
        blocks = [np.arange(u * lower, (u + 1) * lower) for u in range(upper)]
        blocks += [np.arange(k, upper * lower, lower) for k in range(lower)]
        of_p = [np.linalg.cholesky(p[np.ix_(b, b)] + LEAST * np.eye(len(b))) for b in blocks]
        of_s = [np.linalg.cholesky(s[np.ix_(b, b)]) for b in blocks]
        return cls(
            upper_p=np.stack(of_p[:upper]),
            upper_s=np.stack(of_s[:upper]),
            lower_p=np.stack(of_p[upper:]),
            lower_s=np.stack(of_s[upper:]),
            log_det_p=np.array([np.log(np.diag(each)).sum() for each in of_p]),
            log_det_s=np.array([np.log(np.diag(each)).sum() for each in of_s]),
            sums=np.array([(each.sum(axis=0) ** 2).sum() for each in of_p]),
        )


@dataclass(frozen=True, slots=True)
class WireFinding:
    """The wire that is least consistent with the other wires."""

    gain: float
    """Gain in log evidence, nats."""
    wire: int
    """Number of the wire; for a lower wire, U plus its number."""
    factor: float
    """Error common to all readings of the wire, in units of their noise; nan if the wire is unrelated to the
    others."""


def least_fitting(  # noqa: PLR0913 - the frame, its tables and scratch
    tables: WireTables, z: Float, alpha: Float, present: Mask, sigma: float, work: Float
) -> WireFinding:
    """Return the wire and the hypothesis (unrelated, or wrong gain) with the largest gain in log evidence.

    Args:
        tables: Cholesky factors of the wires' blocks of P and S.
        z: (U, K) changes of the readings since rest, in units of their noise.
        alpha: (m,) P z.
        present: (U, K) mask of the available readings; a wire is skipped if fewer than half of its readings
            are available.
        sigma: Relative noise of the readings.
        work: (max(U, K),) work array.
    """
    gain, wire, factor = _least_fitting(
        z.ravel(), alpha, present.ravel(), GAIN_STD / sigma, tables.upper_p, tables.upper_s, tables.lower_p,
        tables.lower_s, tables.log_det_p, tables.log_det_s, tables.sums, work,
    )  # fmt: skip
    return WireFinding(gain, int(wire), factor)


@njit
def _least_fitting(  # noqa: PLR0913 - a kernel: arrays by name
    z: Float,
    alpha: Float,
    present: Mask,
    tau: float,
    upper_p: Float,
    upper_s: Float,
    lower_p: Float,
    lower_s: Float,
    log_det_p: Float,
    log_det_s: Float,
    sums: Float,
    work: Float,
) -> tuple[float, int, float]:
    upper, lower = upper_p.shape[0], lower_p.shape[0]
    best, wire, factor = -math.inf, 0, math.nan
    for w in range(upper + lower):
        first, step, count = (w * lower, 1, lower) if w < upper else (w - upper, lower, upper)
        here, total = 0, 0.0
        for i in range(count):
            here += present[first + i * step]
            total += alpha[first + i * step]
        if 2 * here < count:
            continue
        if w < upper:
            p, s = upper_p[w], upper_s[w]
        else:
            p, s = lower_p[w - upper], lower_s[w - upper]
        unrelated = 0.5 * (_square(p, alpha, first, step, work) - _square(s, z, first, step, work))
        unrelated -= log_det_p[w] + log_det_s[w]
        if unrelated > best:
            best, wire, factor = unrelated, w, math.nan
        q = sums[w]
        off = 0.5 * total * total / (q + 1.0 / (tau * tau)) - 0.5 * math.log(1.0 + tau * tau * q)
        if off > best:
            best, wire, factor = off, w, total / (q + 1.0 / (tau * tau))
    return best - math.log(2.0 * (upper + lower)), wire, factor


@njit_part
def _square(factor: Float, values: Float, first: int, step: int, work: Float) -> float:
    """Return xᵀ (L Lᵀ)⁻¹ x for the Cholesky factor L and the elements x at ``first``, ``first + step``, …."""
    square = 0.0
    for i in range(factor.shape[0]):
        value = values[first + i * step]
        for j in range(i):
            value -= factor[i, j] * work[j]
        work[i] = value / factor[i, i]
        square += work[i] * work[i]
    return square
