"""Soft load discs: variance, evidence and search.

A cell has four loads: two shear loads and a normal load on a half-space, and a normal load on a thin bonded
layer. The layer load moves the skin only near the cell, and represents all displacements that loads on a
half-space cannot cause. A disc d has a centre (row, column) and a radius R in cells, an amplitude a in units
of the prior's loads, and a layer share β. It adds the variance a² w to the half-space loads of each cell, and
a² β² w to the layer load, where

    w = 1 / (1 + exp((r − R − ¼) / ¼)),   r: distance of the cell from the centre

Let v be the variances of the loads, summed over all discs, b = BᵀL⁻¹y and M = BᵀB. Here, B = L⁻¹ J G are
the whitened effects of the loads on the data y, and L Lᵀ is the data covariance of an untouched skin. By the
Woodbury identity and the matrix determinant lemma, the log-likelihood of the data exceeds that of an
untouched skin by

    ½ |Λ⁻¹ V b|² − ln |Λ|,   Λ Λᵀ = I + V M V,   V = diag(√v)

No eigenvalue of I + V M V is less than 1, so the factorisation is as accurate as that of the innovation
covariance (:mod:`skinnode.solve.posterior.measurement_update`). The matrix size is four times the number
of loaded cells, regardless of the size of the patch.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import (
    cholesky,
    solve_lower,
    solve_lower_transposed_vector,
    solve_lower_vector,
)
from skinnode.solve.linalg.vectors import Index

SOFT: Final = 0.25
"""Rim width of a disc, in cells."""
FAINT: Final = 0.03
"""Load variance of a cell, relative to the largest, below which the cell is neglected in the evidence."""
RADIUS: Final = 1.5
"""Expected radius of a disc, in cells."""
RADIUS_SPREAD: Final = 0.7
"""Standard deviation of ln(R + ¼) in the prior of a disc."""
RADIUS_RANGE: Final = (0.3, 4.0)
"""Minimum and maximum radius of a disc, in cells."""
AMPLITUDE_SPREAD: Final = 1.0
"""Standard deviation of ln a in the prior of a disc."""
LAYER: Final = 0.5
"""Expected layer share β."""
LAYER_SPREAD: Final = 1.5
"""Standard deviation of ln β in the prior of a disc."""
STEPS: Final = (0.5, 0.5, 0.3, 0.5, 1.0)
"""Initial search steps in the row, column, ln R, ln a and ln β of a disc."""
SWEEPS: Final = 3
"""Maximum number of sweeps over all parameters. After a sweep without an improvement, the steps are
halved."""
WORTH: Final = 0.05
"""Minimum gain in log-likelihood for a step to be accepted."""
PARAMETERS: Final = 5
"""Number of parameters per disc: row, column, ln R, ln a, ln β."""
LOADS: Final = 4
"""Number of loads per cell: shear along and across the wire, normal load, normal load on a layer."""


class Effects(NamedTuple):
    """Effects of n cells' loads on the data of one frame."""

    place: Float
    """(n, 2) row and column of each cell."""
    gram: Float
    """(4n, 4n) matrix M."""
    match: Float
    """(4n,) vector b."""
    strongest: float = 0.0
    """Largest load variance of the discs that ``gram`` and ``match`` already account for; 0 if there are
    none."""


class Scratch(NamedTuple):
    """Work arrays for up to n cells."""

    root: Float
    """(2, n) standard deviations of the half-space loads and of the layer load of each cell."""
    cells: Index
    """(n,) indices of the loaded cells."""
    factor: Float
    """(4n, 4n) I + V M V, overwritten by Λ."""
    vector: Float
    """(4n,) V b, overwritten by Λ⁻¹ V b."""


def make_scratch(cells: int) -> Scratch:
    """Return work arrays for up to ``cells`` cells."""
    loads = LOADS * cells
    return Scratch(np.zeros((2, cells)), np.zeros(cells, np.int64), np.zeros((loads, loads)), np.zeros(loads))


@njit
def add_variance(discs: Float, place: Float, variance: Float) -> None:
    """Write the variances (2, n) of the half-space loads and the layer load at the cells ``place`` (n, 2)."""
    for cell in range(place.shape[0]):
        total, layer = 0.0, 0.0
        for d in range(discs.shape[0]):
            row, column = place[cell, 0] - discs[d, 0], place[cell, 1] - discs[d, 1]
            beyond = (math.sqrt(row * row + column * column) - math.exp(discs[d, 2]) - SOFT) / SOFT
            if beyond < 40.0:
                own = math.exp(2.0 * discs[d, 3]) / (1.0 + math.exp(max(beyond, -40.0)))
                total += own
                layer += own * math.exp(2.0 * discs[d, 4])
        variance[0, cell] = total
        variance[1, cell] = layer


@njit_part
def _factorise(discs: Float, effects: Effects, s: Scratch) -> int:
    """Factorise I + V M V and solve for Λ⁻¹ V b; return the number of loaded cells, or −1 on failure."""
    n = effects.place.shape[0]
    add_variance(discs, effects.place, s.root)
    most = effects.strongest
    for cell in range(n):
        most = max(most, s.root[0, cell])
    count = 0
    for cell in range(n):
        if s.root[0, cell] > FAINT * most:
            s.cells[count] = cell
            count += 1
        s.root[0, cell], s.root[1, cell] = (
            math.sqrt(s.root[0, cell]),
            math.sqrt(s.root[1, cell]),
        )
    for i in range(count):
        at = LOADS * s.cells[i]
        for t in range(LOADS):
            root = s.root[t // 3, s.cells[i]]
            row, source = s.factor[LOADS * i + t], effects.gram[at + t]
            s.vector[LOADS * i + t] = root * effects.match[at + t]
            for j in range(i, count):
                cell = s.cells[j]
                other, layer = root * s.root[0, cell], root * s.root[1, cell]
                to, start = LOADS * j, LOADS * cell
                row[to] = other * source[start]
                row[to + 1] = other * source[start + 1]
                row[to + 2] = other * source[start + 2]
                row[to + 3] = layer * source[start + 3]
            row[LOADS * i + t] += 1.0
    if not cholesky(s.factor, LOADS * count):
        return -1
    solve_lower_vector(s.factor, s.vector, LOADS * count)
    return count


@njit
def evidence(discs: Float, effects: Effects, s: Scratch) -> float:
    """Return the log-likelihood of the data, relative to that of an untouched skin; −inf on failure.

    Args:
        discs: (D, 5) row, column, ln R, ln a and ln β of each disc.
        effects: Effects of the loads on the data.
        s: Work arrays.
    """
    count = _factorise(discs, effects, s)
    if count < 0:
        return -math.inf
    total = 0.0
    for i in range(LOADS * count):
        total += 0.5 * s.vector[i] * s.vector[i] - math.log(s.factor[i, i])
    return total


@njit
def mean_loads(discs: Float, effects: Effects, s: Scratch, q: Float) -> float:
    """Write the mean loads (4n,) for the discs into ``q``; return the evidence."""
    for i in range(q.size):
        q[i] = 0.0
    count = _factorise(discs, effects, s)
    if count < 0:
        return -math.inf
    total = 0.0
    for i in range(LOADS * count):
        total += 0.5 * s.vector[i] * s.vector[i] - math.log(s.factor[i, i])
    solve_lower_transposed_vector(s.factor, s.vector, LOADS * count)
    for i in range(count):
        for t in range(LOADS):
            q[LOADS * s.cells[i] + t] = s.root[t // 3, s.cells[i]] * s.vector[LOADS * i + t]
    return total


@njit
def log_prior(discs: Float, amplitude: float) -> float:
    """Return the log prior density of ``discs`` (D, 5); ``amplitude`` is the expected ln a."""
    total = 0.0
    for d in range(discs.shape[0]):
        wide = (math.log(math.exp(discs[d, 2]) + SOFT) - math.log(RADIUS)) / RADIUS_SPREAD
        high = (discs[d, 3] - amplitude) / AMPLITUDE_SPREAD
        layer = (discs[d, 4] - math.log(LAYER)) / LAYER_SPREAD
        total -= 0.5 * (wide * wide + high * high + layer * layer)
    return total


@njit_part
def _allowed(value: float, parameter: int, bounds: Float) -> float:
    low: float = bounds[0, parameter]
    high: float = bounds[1, parameter]
    return min(max(value, low), high)


@njit
def whiten_by_discs(  # noqa: PLR0913 - a kernel: arrays by name
    discs: Float, effects: Effects, own: Index, s: Scratch, cross: Float, gram: Float, match: Float
) -> int:
    """Prepare the effects of loads on the k cells ``own``, given the discs.

    These effects are Mₒₒ − Cᵀ C and bₒ − Cᵀ Λ⁻¹ V b with C = Λ⁻¹ V Mₒ, where o stands for the loads of the k
    cells.

    Args:
        discs: (D, 5) row, column, ln R, ln a and ln β of each disc.
        effects: Effects of the loads on the data.
        own: (k,) positions of the cells in ``effects``.
        s: Work arrays; ``vector`` receives Λ⁻¹ V b.
        cross: (4n, 4k) receives C in its first rows.
        gram: (4k, 4k) receives Mₒₒ.
        match: (4k,) receives bₒ.

    Returns:
        The number of rows of C; −1 on failure.
    """
    count = _factorise(discs, effects, s)
    for j in range(own.size):
        to, start = LOADS * j, LOADS * own[j]
        for u in range(LOADS):
            match[to + u] = effects.match[start + u]
            row, source = gram[to + u], effects.gram[start + u]
            for i in range(own.size):
                for t in range(LOADS):
                    row[LOADS * i + t] = source[LOADS * own[i] + t]
    if count < 0:
        return -1
    for i in range(count):
        at = LOADS * s.cells[i]
        for t in range(LOADS):
            root = s.root[t // 3, s.cells[i]]
            row, source = cross[LOADS * i + t], effects.gram[at + t]
            for j in range(own.size):
                to, start = LOADS * j, LOADS * own[j]
                for u in range(LOADS):
                    row[to + u] = root * source[start + u]
    solve_lower(s.factor, cross, LOADS * count, LOADS * own.size)
    return LOADS * count


@njit
def climb(  # noqa: PLR0913, C901 - a kernel: arrays by name
    discs: Float, effects: Effects, amplitude: float, bounds: Float, work: Float, s: Scratch
) -> float:
    """Improve the discs (D, 5) in place by a coordinate search; return their evidence plus log prior.

    After a sweep without an improvement, smaller steps are tried only in the direction in which the larger
    step gained more.

    Args:
        discs: (D, 5) row, column, ln R, ln a and ln β of each disc.
        effects: Effects of the loads on the data.
        amplitude: Expected ln a.
        bounds: (2, 5) minimum and maximum of each parameter.
        work: (3, D, 5) work array.
        s: Work arrays.
    """
    trial, gain = work[0], work[1:]
    for d in range(discs.shape[0]):
        for p in range(PARAMETERS):
            trial[d, p] = discs[d, p]
    best = evidence(trial, effects, s) + log_prior(trial, amplitude)
    scale, still = 1.0, False
    for _ in range(SWEEPS):
        better = False
        for d in range(discs.shape[0]):
            for p in range(PARAMETERS):
                taken, one_way = False, still and not better
                for sign in range(2):
                    if taken or (one_way and gain[sign, d, p] < gain[1 - sign, d, p]):
                        continue
                    step = scale * STEPS[p] * (1.0 - 2.0 * sign)
                    gain[sign, d, p] = -math.inf
                    for attempt in range(4):
                        trial[d, p] = _allowed(discs[d, p] + step, p, bounds)
                        if trial[d, p] == discs[d, p]:
                            break
                        found = evidence(trial, effects, s) + log_prior(trial, amplitude)
                        if attempt == 0:
                            gain[sign, d, p] = found - best
                        if not found > best + WORTH:
                            trial[d, p] = discs[d, p]
                            break
                        best = found
                        discs[d, p] = trial[d, p]
                        taken = better = True
        still = not better
        if still:
            scale *= 0.5
    return best
