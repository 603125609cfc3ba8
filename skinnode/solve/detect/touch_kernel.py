"""Compiled part of the touch detector: one pass over the readings of a frame."""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import READONLY, ArrayTable, reader
from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import multiply_vector

KEPT: Final = 4
"""Number of recent frames kept for computing means."""
STATISTICS: Final = (1, 3, 4)
"""Numbers of frames averaged before the statistic is computed."""
WORST, UPPER, LOWER, COUNT, MOTION, RATIO = 3, 4, 5, 6, 7, 8
"""Indices of the other results in ``found``."""


class TouchArrays(ArrayTable):
    """Arrays of one patch's detector. Changes y are in units of each reading's noise."""

    ohm: Annotated[NDArray[np.float64], "U K"]
    """Resistances of the frame, in ohms; NaN where missing."""
    rest: Annotated[NDArray[np.float64], "U K"]
    """Resistances at rest, in ohms."""
    weight: Annotated[NDArray[np.float64], "U K"]
    """1 / σ of each reading, or less if the frame is noisier than usual; 0 for readings to ignore."""
    expected: Annotated[NDArray[np.float64], "U K"]
    """Changes y expected without a touch, computed from the gains and offsets."""
    recent: Annotated[NDArray[np.float64], "4 m"]
    """Unexpected changes in the readings of the last frames."""
    responses: Annotated[NDArray[np.float64], "R m", READONLY]
    """Bᵀ: the part of the features that depends on the responses to loads."""
    ratios: Annotated[NDArray[np.float64], "U K", READONLY]
    """Noise of each reading divided by the median."""
    features: Annotated[NDArray[np.float64], "4 F"]
    """Features (Bᵀ y, Hᵀ y) of the last frames: R responses, U + K + 1 gains."""
    shift: Annotated[NDArray[np.float64], "m"]
    """Work array."""
    shift_features: Annotated[NDArray[np.float64], "F"]
    """Work array."""
    products: Annotated[NDArray[np.float64], "4 R"]
    """z of the last frames."""
    residual: Annotated[NDArray[np.float64], "U"]
    """RMS of ln(R₀/R) over each upper wire's readings; inf if the wire has no readings."""
    columns: Annotated[NDArray[np.float64], "K"]
    """Work array."""
    counts: Annotated[NDArray[np.float64], "K"]
    """Work array."""
    found: Annotated[NDArray[np.float64], "9"]
    """Results: w ‖mean z‖² for w = 1, 3 and 4 frames; largest |y| of a reading, and largest χ² excess of an
    upper wire and of a lower wire, each in standard deviations; number of readings used; noise variance from
    three successive frames, relative to the stated variance, or −1 if unknown; log likelihood ratio of touch
    to no touch."""


arrays_of = reader(TouchArrays)


@njit_part
def _norms(products: Float, at: int, frames: int, found: Float) -> None:
    """Write w ‖mean z‖² of the last w frames into ``found``, or 0 if there are fewer frames."""
    found[0], found[1], found[2] = 0.0, 0.0, 0.0
    now, last = products[at], products[(at + 3) % 4]
    third, fourth = products[(at + 2) % 4], products[(at + 1) % 4]
    one, three, four = 0.0, 0.0, 0.0
    for i in range(now.size):
        three_sum = now[i] + last[i] + third[i]
        four_sum = three_sum + fourth[i]
        one += now[i] * now[i]
        three += three_sum * three_sum
        four += four_sum * four_sum
    found[0] = one
    if frames >= 3:
        found[1] = three / 3.0
    if frames >= 4:
        found[2] = four / 4.0


@njit_part
def _features(responses: Float, ratios: Float, y: Float, features: Float) -> None:
    """Write Bᵀ y, and the sums Hᵀ y over upper wires, lower wires and the patch, into ``features``."""
    size = responses.shape[0]
    upper, lower = ratios.shape
    multiply_vector(responses, y, features[:size])
    for j in range(size, features.size):
        features[j] = 0.0
    total = 0.0
    for u in range(upper):
        of_wire = 0.0
        for k in range(lower):
            value = y[u * lower + k] / ratios[u, k]
            of_wire += value
            features[size + upper + k] += value
        features[size + u] = of_wire
        total += of_wire
    features[size + upper + lower] = total


@njit_part
def _log_ratio(z: Float, shares: Float, log_dets: Float, octaves: int, variance: float) -> float:
    """Return the logarithm of the mean over the octaves of exp ½ (Σ share z² / variance − log_det)."""
    most, total = -np.inf, 0.0
    for j in range(octaves):
        row, square = shares[j], 0.0
        for i in range(z.size):
            square += row[i] * z[i] * z[i]
        term = 0.5 * (square / variance - log_dets[j])
        if term > most:
            total = total * np.exp(most - term) + 1.0
            most = term
        else:
            total += np.exp(term - most)
    found: float = most + np.log(total / octaves)
    return found


@njit
def see_frame(  # noqa: PLR0913 - a kernel: arrays by name
    table: NDArray[np.int64],
    rows: Float,
    shares: Float,
    log_dets: Float,
    octaves: int,
    variance: float,
    at: int,
    frames: int,
) -> None:
    """Compute the statistics of a frame.

    Args:
        table: Table of :class:`TouchArrays`.
        rows: (R, F) matrix of the test.
        shares: (S, R) weights of the test's likelihood ratios.
        log_dets: (S,) constants of the test's likelihood ratios.
        octaves: Number of octaves of depth, at most S.
        variance: Noise variance of the stream, relative to the stated variance.
        at: Position of this frame in ``recent`` and ``products``.
        frames: Number of frames in ``recent``, including this one.
    """
    its = arrays_of(table)
    ohm, rest, weight, expected = its.ohm, its.rest, its.weight, its.expected
    columns, counts, found, recent = its.columns, its.counts, its.found, its.recent
    y, last, before = recent[at], recent[(at + 3) % 4], recent[(at + 2) % 4]
    upper, lower = ohm.shape
    used, worst, excess, motion, pairs = 0, 0.0, 0.0, 0.0, 0
    for k in range(lower):
        columns[k] = counts[k] = 0.0
    for u in range(upper):
        total, moved, here = 0.0, 0.0, 0
        for k in range(lower):
            i = u * lower + k
            r, r0, w = ohm[u, k], rest[u, k], weight[u, k]
            y[i] = 0.0
            if r > 0.0 and r < 1e300 and w > 0.0:
                s = (r0 - r) / (r0 + r)  # ln(R₀/R) = 2 artanh s
                s2 = s * s
                change = 2.0 * s * (1.0 + s2 * (1.0 / 3.0 + s2 * (0.2 + s2 / 7.0)))
                moved += change * change
                value = change * w - expected[u, k]
                y[i] = value
                square = value * value
                total += square
                columns[k] += square
                counts[k] += 1.0
                here += 1
                worst = max(worst, square)
                if frames >= 3 and last[i] != 0.0 and before[i] != 0.0:
                    bend = value - 2.0 * last[i] + before[i]
                    motion += bend * bend
                    pairs += 1
        used += here
        its.residual[u] = np.sqrt(moved / here) if here else np.inf
        if here:
            excess = max(excess, (total / variance - here) / np.sqrt(2.0 * here))
    found[WORST], found[UPPER], found[COUNT] = np.sqrt(worst / variance), excess, float(used)
    excess = 0.0
    for k in range(lower):
        if counts[k] > 0.0:
            excess = max(excess, (columns[k] / variance - counts[k]) / np.sqrt(2.0 * counts[k]))
    found[LOWER] = excess
    found[MOTION] = motion / (6.0 * pairs) if pairs else -1.0
    features, z = its.features[at], its.products[at]
    _features(its.responses, its.ratios, y, features)
    multiply_vector(rows, features, z)
    _norms(its.products, at, frames, found)
    found[RATIO] = _log_ratio(z, shares, log_dets, octaves, variance)


@njit
def retest(table: NDArray[np.int64], rows: Float, expected: Float, at: int, frames: int) -> None:
    """Recompute the statistics of the last frames for different expected changes and a different test.

    Args:
        table: Table of :class:`TouchArrays`.
        rows: (R, F) matrix of the test; see :func:`see_frame`.
        expected: (U, K) changes expected from now on.
        at: Position of the last frame in ``recent`` and ``products``.
        frames: Number of frames in ``recent``.
    """
    its = arrays_of(table)
    before, shift, of_shift = its.expected, its.shift, its.shift_features
    upper, lower = before.shape
    for u in range(upper):
        for k in range(lower):
            shift[u * lower + k] = before[u, k] - expected[u, k]
            before[u, k] = expected[u, k]
    _features(its.responses, its.ratios, shift, of_shift)  # features are linear in the changes
    for one in range(4):
        recent, features = its.recent[one], its.features[one]
        for i in range(shift.size):
            recent[i] += shift[i]
        for j in range(of_shift.size):
            features[j] += of_shift[j]
    for back in range(frames):
        one = (at - back) % 4
        multiply_vector(rows, its.features[one], its.products[one])
    _norms(its.products, at, frames, its.found)
