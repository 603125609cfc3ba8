"""Tests whole wires for gain errors and for readings that are inconsistent with the other wires.

If the readings of a wire are delayed or belong to another wire, each individual reading may agree with the
others within its uncertainty. Only a joint test of all the wire's readings then detects the fault. Let G be
the readings of a wire, P the precision of all readings, S = P⁻¹ their covariance, and α = P z. The tests
compare two hypotheses with that of a healthy wire:

- Unrelated: z_G is independent of the other wires, with the distribution N(0, S_GG). The log evidence changes
  by ½ α_Gᵀ P_GG⁻¹ α_G − ½ z_Gᵀ S_GG⁻¹ z_G − ½ ln det P_GG S_GG.
- Gain: all readings of the wire are wrong by the same factor 1 + c, with c ~ N(0, τ²). The log evidence
  changes by ½ (1ᵀα_G)² / (q + τ⁻²) − ½ ln(1 + τ² q), with q = 1ᵀ P_GG 1.

Both expressions follow from the conditional distributions of a multivariate normal.
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
"""Assumed standard deviation of a relative gain error, for the gain of a wire and for gain drift. Not
tuned."""
LEAST: Final = 1e-9
"""Minimum precision of a reading, in units of 1 / noise². Smaller values are due to rounding errors."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class WireTables:
    """Each wire's blocks of P, and the Cholesky factors of its blocks of P and S, at one κ.

    The arrays have the shape (U, K, K) for upper wires and (K, U, U) for lower wires.
    """

    upper_p: Float
    """Cholesky factors of P_GG for the upper wires."""
    upper_s: Float
    """Cholesky factors of S_GG for the upper wires."""
    lower_p: Float
    lower_s: Float
    of_upper: Float
    """Blocks P_GG of the upper wires."""
    of_lower: Float
    """Blocks P_GG of the lower wires."""
    log_det_p: Float
    """(U + K,) ½ ln det P_GG of each wire."""
    log_det_s: Float
    """(U + K,) ½ ln det S_GG of each wire."""
    sums: Float
    """(U + K,) sum 1ᵀ P_GG 1 of the elements of each wire's P_GG."""

    @classmethod
    def of(cls, p: Float, s: Float, shape: tuple[int, int]) -> WireTables:
        """Compute the tables from the precision ``p`` (m, m) and the covariance ``s`` (m, m).

        Reads only the wires' blocks of both matrices (:func:`wire_blocks`).
        """
        blocks = [np.array(each, order="C") for each in wire_blocks(p, shape)]
        of_p = [_factors(each + LEAST * np.eye(each.shape[-1])) for each in blocks]
        of_s = [_factors(each) for each in wire_blocks(s, shape)]
        return cls(
            upper_p=of_p[0],
            upper_s=of_s[0],
            lower_p=of_p[1],
            lower_s=of_s[1],
            of_upper=blocks[0],
            of_lower=blocks[1],
            log_det_p=np.concatenate([_half_log_det(each) for each in of_p]),
            log_det_s=np.concatenate([_half_log_det(each) for each in of_s]),
            sums=np.concatenate([(each.sum(axis=1) ** 2).sum(axis=1) for each in of_p]),
        )


def wire_blocks(matrix: Float, shape: tuple[int, int]) -> tuple[Float, Float]:
    """Return writable views of each wire's block in an (m, m) matrix of the readings.

    Args:
        matrix: (m, m) C-ordered matrix, m = U K.
        shape: Number of upper wires U and of lower wires K.

    Returns:
        (U, K, K) blocks of the upper wires, and (K, U, U) blocks of the lower wires.
    """
    of_pairs = matrix.reshape(*shape, *shape)
    return np.einsum("ukul->ukl", of_pairs), np.einsum("ukvk->kuv", of_pairs)


def _factors(blocks: Float) -> Float:
    """Return the Cholesky factors (B, n, n) of the matrices ``blocks`` (B, n, n)."""
    return np.asarray(np.linalg.cholesky(blocks), np.float64)


def _half_log_det(factors: Float) -> Float:
    """Return ½ ln det A of each matrix A, given the Cholesky factors (B, n, n)."""
    return np.asarray(np.log(np.diagonal(factors, axis1=1, axis2=2).copy()).sum(axis=1))


@dataclass(frozen=True, slots=True)
class WireFinding:
    """The wire that is least consistent with the others."""

    gain: float
    """Gain in log evidence from assuming that the wire is faulty, in nats."""
    wire: int
    """Index of the wire: 0 to U − 1 for upper wires, U to U + K − 1 for lower wires."""
    factor: float
    """Error common to all readings of the wire, in units of their noise; NaN if the readings of the wire
    appear unrelated to those of the other wires."""


def least_fitting(  # noqa: PLR0913 - the frame, its tables and scratch
    tables: WireTables, z: Float, alpha: Float, present: Mask, sigma: float, work: Float
) -> WireFinding:
    """Return the wire and the fault (unrelated, or wrong gain) with the largest gain in log evidence.

    A wire is skipped if fewer than half of its readings are available.

    Args:
        tables: Cholesky factors of the wires' blocks of P and S.
        z: (U, K) changes in the readings since rest, in units of their noise.
        alpha: (m,) P z.
        present: (U, K) mask of the available readings.
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
    """Return xᵀ (L Lᵀ)⁻¹ x for the Cholesky factor L and the values x at ``first``, ``first + step``, …."""
    square = 0.0
    for i in range(factor.shape[0]):
        value = values[first + i * step]
        for j in range(i):
            value -= factor[i, j] * work[j]
        work[i] = value / factor[i, i]
        square += work[i] * work[i]
    return square
