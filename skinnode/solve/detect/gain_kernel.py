"""Compiled part of the slow state: one update of the gains and offsets from the mean of a block of frames."""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import READONLY, ArrayTable, reader
from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.detect.gain_drift import GainFilter
from skinnode.solve.linalg.cholesky import multiply_vector

SETTLED: Final = 1e-5
"""Relative change in the variances from block to block below which the covariance is considered constant."""
WIRES, MEAN = 0, 1
"""Indices of the variances in ``variances``."""


class GainArrays(ArrayTable):
    """Arrays of one stream's slow state. Changes are in units of the readings' noise."""

    basis_t: Annotated[NDArray[np.float64], "V m", READONLY]
    """Qᵀ; see :class:`skinnode.solve.detect.gain_drift.GainFilter`."""
    by_wires: Annotated[NDArray[np.float64], "V V", READONLY]
    """Covariance of v if the gains of all wires have a variance of 1."""
    by_patch: Annotated[NDArray[np.float64], "V V", READONLY]
    """Covariance of v if the gain of the patch has a variance of 1."""
    of_uppers: Annotated[NDArray[np.float64], "V V", READONLY]
    """Weights by which the covariance of v contributes to the variance of an upper wire's gain."""
    of_lowers: Annotated[NDArray[np.float64], "V V", READONLY]
    """Weights by which the covariance of v contributes to the variance of a lower wire's gain."""
    of_mean: Annotated[NDArray[np.float64], "V", READONLY]
    """Coefficients of the mean change in all readings."""
    mean: Annotated[NDArray[np.float64], "m"]
    """Mean change in the readings in a block of untouched frames."""
    expected: Annotated[NDArray[np.float64], "m"]
    """Changes expected without a touch."""
    offset: Annotated[NDArray[np.float64], "m"]
    """Part of ``expected`` not caused by the gains."""
    covariance: Annotated[NDArray[np.float64], "V V"]
    """Covariance of v after the newest frame in the estimate."""
    v: Annotated[NDArray[np.float64], "V"]
    """Visible coordinates of the gains."""
    variances: Annotated[NDArray[np.float64], "2"]
    """Largest variance of a wire's gain about its layer's mean, and variance of the mean change."""
    settled: Annotated[NDArray[np.float64], "3"]
    """Growth of a wire's variance and of the patch's variance at the last update, followed by 1 if this
    update left the covariance unchanged, otherwise 0."""
    beyond: Annotated[NDArray[np.float64], "m"]
    """Work array."""
    inverse: Annotated[NDArray[np.float64], "V V"]
    """Work array."""
    step: Annotated[NDArray[np.float64], "V"]
    """Work array."""


arrays_of = reader(GainArrays)


def gain_arrays(filter_: GainFilter) -> GainArrays:
    """Return the arrays of a stream whose gains, offsets and covariance are zero."""
    m, v = filter_.basis_t.shape[1], len(filter_.basis_t)
    return GainArrays(
        basis_t=filter_.basis_t,
        by_wires=filter_.by_wires,
        by_patch=filter_.by_patch,
        of_uppers=filter_.of_uppers,
        of_lowers=filter_.of_lowers,
        of_mean=filter_.of_mean,
        mean=np.zeros(m),
        expected=np.zeros(m),
        offset=np.zeros(m),
        covariance=np.zeros((v, v)),
        v=np.zeros(v),
        variances=np.zeros(2),
        settled=np.zeros(3),
        beyond=np.zeros(m),
        inverse=np.zeros((v, v)),
        step=np.zeros(v),
    )


@njit_part
def _invert(a: Float) -> None:
    """Replace the symmetric positive definite matrix ``a`` with its inverse, using Gauss-Jordan elimination.

    No pivoting is needed for such matrices (Higham, Accuracy and Stability of Numerical Algorithms, 2002,
    section 14.4).
    """
    n = a.shape[0]
    for p in range(n):
        row = a[p]
        pivot = 1.0 / row[p]
        row[p] = 1.0
        for j in range(n):
            row[j] *= pivot
        for i in range(n):
            if i != p:
                other = a[i]
                factor = other[p]
                other[p] = 0.0
                for j in range(n):
                    other[j] -= factor * row[j]


@njit_part
def _sum_of_products(a: Float, b: Float) -> float:
    total = 0.0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            total += a[i, j] * b[i, j]
    return total


@njit_part
def _find_variances(its: GainArrays) -> None:
    """Compute ``variances`` from the covariance."""
    covariance, of_mean, step, variances = its.covariance, its.of_mean, its.step, its.variances
    variances[WIRES] = max(
        _sum_of_products(its.of_uppers, covariance), _sum_of_products(its.of_lowers, covariance)
    )
    multiply_vector(covariance, of_mean, step)
    total = 0.0
    for i in range(step.size):
        total += step[i] * of_mean[i]
    variances[MEAN] = total


@njit_part
def _update_covariance(its: GainArrays, wires: float, patch: float, frames: int) -> None:
    """Add the drift to the covariance, then update it with a block; see :func:`use_block` for arguments.

    Most blocks of a stream are consecutive, so the covariance soon becomes constant.
    """
    settled, variances = its.settled, its.variances
    same = settled[0] == wires and settled[1] == patch
    if same and settled[2] == 1.0:
        return
    wires_before, mean_before = variances[WIRES], variances[MEAN]
    covariance, inverse, by_wires, by_patch = its.covariance, its.inverse, its.by_wires, its.by_patch
    n = covariance.shape[0]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = frames * (covariance[i, j] + wires * by_wires[i, j] + patch * by_patch[i, j])
        inverse[i, i] += 1.0
    _invert(inverse)
    # the gain n P (I + n P)⁻¹ = I − (I + n P)⁻¹ is n times the covariance after the update
    for i in range(n):
        for j in range(n):
            gain = -0.5 * (inverse[i, j] + inverse[j, i])
            covariance[i, j] = (gain + (1.0 if i == j else 0.0)) / frames
    _find_variances(its)
    constant = (
        abs(variances[WIRES] - wires_before) <= SETTLED * wires_before
        and abs(variances[MEAN] - mean_before) <= SETTLED * mean_before
    )
    settled[0], settled[1], settled[2] = wires, patch, 1.0 if same and constant else 0.0


@njit
def find_variances(table: NDArray[np.int64]) -> None:
    """Compute ``variances`` after the covariance of :class:`GainArrays` has been set."""
    its = arrays_of(table)
    its.settled[2] = 0.0
    _find_variances(its)


@njit
def use_block(table: NDArray[np.int64], wires: float, patch: float, frames: int, share: float) -> None:
    """Update the gains, their covariance, the offsets and the expected changes from the mean of a block.

    Args:
        table: Table of :class:`GainArrays`.
        wires: Growth of each wire's variance since the last block.
        patch: Growth of the patch's variance since the last block.
        frames: Number n of frames in the block.
        share: Weight of the block in the offsets.
    """
    its = arrays_of(table)
    _update_covariance(its, wires, patch, frames)
    covariance, v, step, basis_t = its.covariance, its.v, its.step, its.basis_t
    mean, expected, offset, beyond = its.mean, its.expected, its.offset, its.beyond
    for i in range(mean.size):
        beyond[i] = mean[i] - expected[i]
        expected[i] = 0.0
    multiply_vector(basis_t, beyond, step)
    for i in range(v.size):
        total = 0.0
        for j in range(v.size):
            total += covariance[i, j] * step[j]
        v[i] += frames * total
    for j in range(v.size):
        row, value = basis_t[j], v[j]
        for i in range(mean.size):
            expected[i] += value * row[i]
    for i in range(mean.size):
        offset[i] += share * (mean[i] - expected[i] - offset[i])
        expected[i] += offset[i]
