"""Soft discs of loads: variance, evidence and search.

A disc d has a centre (row, column) and a radius R in cells, and an amplitude a in units of the prior's loads. It
adds the variance a² w to the normal and shear loads of each cell, where

    w = 1 / (1 + exp((r − R − ¼) / ¼)),   r: distance of the cell from the centre

The loads of all discs together have the variances v. Let b = BᵀL⁻¹y and M = BᵀB, where B = L⁻¹ J G are the
whitened effects of the loads on the data y, and L Lᵀ is the covariance of the data of an untouched skin. By the
Woodbury identity and the matrix determinant lemma, the log-likelihood of the data exceeds that of an untouched
skin by

    ½ |Λ⁻¹ V b|² − ln |Λ|,   Λ Λᵀ = I + V M V,   V = diag(√v)

No eigenvalue of I + V M V is less than 1, so the factorisation is as accurate as that of the innovation
covariance (:mod:`skinnode.solve.posterior.measurement_update`). Its size is three times the number of loaded
cells, whatever the size of the patch.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import cholesky, solve_lower_transposed_vector, solve_lower_vector
from skinnode.solve.linalg.vectors import Index

SOFT: Final = 0.25
"""Width of the rim of a disc, cells."""
FAINT: Final = 1e-3
"""Variance of a cell, relative to the largest, below which its loads are neglected in the evidence."""
RADIUS: Final = 1.5
"""Expected radius of a disc, cells."""
RADIUS_SPREAD: Final = 0.7
"""Standard deviation of ln(R + ¼) in the prior of a disc."""
RADIUS_RANGE: Final = (0.3, 4.0)
"""Minimum and maximum radius of a disc, cells."""
AMPLITUDE_SPREAD: Final = 1.5
"""Standard deviation of ln a in the prior of a disc."""
STEPS: Final = (0.5, 0.5, 0.3, 0.5)
"""First steps of the search in the row, column, ln R and ln a of a disc."""
SWEEPS: Final = 4
"""Maximum number of sweeps over all parameters. After a sweep without an improvement, the steps are halved."""
WORTH: Final = 0.05
"""Minimum gain in log-likelihood for a step to be taken."""
PARAMETERS: Final = 4
"""Number of parameters of a disc: row, column, ln R, ln a."""


class Effects(NamedTuple):
    """Effects of the loads of n cells on the data of one frame."""

    place: Float
    """(n, 2) row and column of each cell."""
    gram: Float
    """(3n, 3n) matrix M."""
    match: Float
    """(3n,) vector b."""


class Scratch(NamedTuple):
    """Work arrays for up to n cells."""

    variance: Float
    """(n,) variance v of the loads of each cell."""
    cells: Index
    """(n,) cells with loads."""
    factor: Float
    """(3n, 3n) I + V M V, overwritten by Λ."""
    vector: Float
    """(3n,) V b, overwritten by Λ⁻¹ V b."""


def make_scratch(cells: int) -> Scratch:
    """Return work arrays for up to ``cells`` cells."""
    loads = 3 * cells
    return Scratch(np.zeros(cells), np.zeros(cells, np.int64), np.zeros((loads, loads)), np.zeros(loads))


@njit
def add_variance(discs: Float, place: Float, variance: Float) -> None:
    """Write the variances v (n,) of the loads at the cells ``place`` (n, 2) for ``discs`` (D, 4)."""
    for cell in range(variance.size):
        total = 0.0
        for d in range(discs.shape[0]):
            row, column = place[cell, 0] - discs[d, 0], place[cell, 1] - discs[d, 1]
            beyond = (math.sqrt(row * row + column * column) - math.exp(discs[d, 2]) - SOFT) / SOFT
            if beyond < 40.0:
                total += math.exp(2.0 * discs[d, 3]) / (1.0 + math.exp(max(beyond, -40.0)))
        variance[cell] = total


@njit_part
def _factorise(discs: Float, effects: Effects, s: Scratch) -> int:
    """Factorise I + V M V and solve for Λ⁻¹ V b; return the number of loaded cells, or −1 on failure."""
    n = effects.place.shape[0]
    variance = s.variance[:n]
    add_variance(discs, effects.place, variance)
    most = 0.0
    for cell in range(n):
        most = max(most, variance[cell])
    count = 0
    for cell in range(n):
        if variance[cell] > FAINT * most:
            s.cells[count] = cell
            count += 1
    for i in range(count):
        root = math.sqrt(variance[s.cells[i]])
        for t in range(3):
            row, source = s.factor[3 * i + t], effects.gram[3 * s.cells[i] + t]
            s.vector[3 * i + t] = root * effects.match[3 * s.cells[i] + t]
            for j in range(i, count):
                other = root * math.sqrt(variance[s.cells[j]])
                for k in range(3):
                    row[3 * j + k] = other * source[3 * s.cells[j] + k]
            row[3 * i + t] += 1.0
    if not cholesky(s.factor, 3 * count):
        return -1
    solve_lower_vector(s.factor, s.vector, 3 * count)
    return count


@njit
def evidence(discs: Float, effects: Effects, s: Scratch) -> float:
    """Return the log-likelihood of the data, relative to that of an untouched skin; −inf on failure.

    Args:
        discs: (D, 4) row, column, ln R and ln a of each disc.
        effects: Effects of the loads on the data.
        s: Work arrays.
    """
    count = _factorise(discs, effects, s)
    if count < 0:
        return -math.inf
    total = 0.0
    for i in range(3 * count):
        total += 0.5 * s.vector[i] * s.vector[i] - math.log(s.factor[i, i])
    return total


@njit
def log_prior(discs: Float, amplitude: float) -> float:
    """Return the log prior density of ``discs`` (D, 4), up to a constant; ``amplitude`` is the expected ln a."""
    total = 0.0
    for d in range(discs.shape[0]):
        wide = (math.log(math.exp(discs[d, 2]) + SOFT) - math.log(RADIUS)) / RADIUS_SPREAD
        high = (discs[d, 3] - amplitude) / AMPLITUDE_SPREAD
        total -= 0.5 * (wide * wide + high * high)
    return total


@njit
def mean_loads(discs: Float, effects: Effects, s: Scratch, q: Float) -> float:
    """Write the mean loads (3n,) under the discs into ``q``; return the evidence."""
    total = evidence(discs, effects, s)
    for i in range(3 * effects.place.shape[0]):
        q[i] = 0.0
    if total == -math.inf:
        return total
    count, most = 0, 0.0
    for cell in range(effects.place.shape[0]):
        most = max(most, s.variance[cell])
    for cell in range(effects.place.shape[0]):
        count += s.variance[cell] > FAINT * most
    solve_lower_transposed_vector(s.factor, s.vector, 3 * count)
    for i in range(count):
        root = math.sqrt(s.variance[s.cells[i]])
        for t in range(3):
            q[3 * s.cells[i] + t] = root * s.vector[3 * i + t]
    return total


@njit_part
def _allowed(value: float, parameter: int, lattice: Float) -> float:
    if parameter < 2:
        return min(max(value, 0.0), lattice[parameter])
    if parameter == 2:
        return min(max(value, math.log(RADIUS_RANGE[0])), math.log(RADIUS_RANGE[1]))
    return value


@njit
def climb(  # noqa: PLR0913 - a kernel: arrays by name
    discs: Float, effects: Effects, amplitude: float, lattice: Float, trial: Float, s: Scratch
) -> float:
    """Improve the discs (D, 4) in place by a coordinate search; return their evidence plus log prior.

    Args:
        discs: (D, 4) row, column, ln R and ln a of each disc.
        effects: Effects of the loads on the data.
        amplitude: Expected ln a.
        lattice: (2,) largest row and column of a cell.
        trial: (D, 4) copy of the discs, overwritten.
        s: Work arrays.
    """
    best = evidence(trial, effects, s) + log_prior(trial, amplitude)
    scale = 1.0
    for _ in range(SWEEPS):
        better = False
        for d in range(discs.shape[0]):
            for p in range(PARAMETERS):
                taken = False
                for sign in range(2):
                    if sign == 1 and taken:
                        break
                    step = scale * STEPS[p] * (1.0 - 2.0 * sign)
                    for _ in range(4):
                        trial[d, p] = _allowed(discs[d, p] + step, p, lattice)
                        if trial[d, p] == discs[d, p]:
                            break
                        found = evidence(trial, effects, s) + log_prior(trial, amplitude)
                        if not found > best + WORTH:
                            trial[d, p] = discs[d, p]
                            break
                        best = found
                        discs[d, p] = trial[d, p]
                        taken = better = True
        if not better:
            scale *= 0.5
    return best
