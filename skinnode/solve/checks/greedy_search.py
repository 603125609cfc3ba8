"""Greedy search for the loads and the wrong readings that explain a frame.

The search is a form of batch orthogonal matching pursuit. Its dictionary is A = [I B], with one column for
each of the m readings and one for the readings' response to each of the 4Q loads. The search needs Aᵀ P z and
the diagonal of the Gram matrix E = Aᵀ P A. Adding a load or leaving out a reading is a rank-one update of the
precision: P' = P − share · v vᵀ. For each update, the search stores the vector Aᵀ v, with which it updates Aᵀ
P z and the diagonal. Of P' itself, only each wire's block is computed; these blocks are needed to test
whether all readings of a wire are wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.checks.wire_tests import LEAST
from skinnode.solve.linalg.cholesky import cholesky, multiply, multiply_vector, solve_lower_vector
from skinnode.solve.linalg.vectors import Index

STEPS: Final = 8
"""Maximum number of loads and groups of wrong readings in an explanation with faults."""
LOADS: Final = 60
"""Maximum number of loads in an explanation by loads alone. A contact covers up to twenty cells, with three
loads each. With a maximum of 8, half of the healthy frames of a deep slide were reported as faulty (noise
3e-6)."""
ENOUGH: Final = 1.0
"""Minimum gain in log evidence (nats) for adding a load or a group of wrong readings."""
ROUNDING: Final = 1e-6
"""Margin for rounding errors in the bounds on the gains, in nats."""
LOAD, CROSSING, LOWER, UPPER = range(4)
"""Kinds of search steps: add a load; leave out one reading; leave out all readings of a lower wire, or of an
upper wire."""

Mask = NDArray[np.bool_]


class GreedySearch:
    """Greedy search. Each stream needs its own instance.

    The work arrays (3 MB for the reference patch) exist only during a search, because searches are rare.

    Args:
        model: Joint distribution of the readings.

    Attributes:
        kinds: (LOADS,) kind of each step of the last search; −1 for unused entries.
        numbers: (LOADS,) index of the load, reading or wire of each step.
        gains: (LOADS,) gain of each step in log evidence, in nats.
    """

    def __init__(self, model: ReadingModel) -> None:
        self._model = model
        self.kinds, self.numbers = np.full((2, LOADS), -1)
        self.gains = np.empty(LOADS)

    def products(self, z: Float, numbers: Sequence[int]) -> Float:
        """Return Aᵀ P z (n, m + 4Q) of a frame at several κ.

        Args:
            z: (U, K) changes in the readings since rest, in units of their noise.
            numbers: Indices of the n values of κ.
        """
        model, (m, count) = self._model, self._model.response.shape
        parts, by_readings = np.empty(m), np.empty((len(numbers), m))
        by_loads = np.empty((len(numbers), count))
        multiply_vector(model.vectors_t, z.ravel(), parts)
        multiply(model.shrink[list(numbers)] * parts, model.vectors_t, by_readings)
        multiply(by_readings, model.response, by_loads)
        return np.concatenate([by_readings, by_loads], axis=1)

    def run(  # noqa: PLR0913 - the frame, and which explanations are allowed
        self,
        number: int,
        z: Float,
        products: Float,
        present: Mask,
        cost: float,
        *,
        faults: bool,
        loads: bool = True,
        needed: float = -math.inf,
    ) -> float:
        """Find the best explanation of a frame, store its steps as attributes and return its gain in nats.

        The search is abandoned, and −inf returned, once the gain cannot exceed ``needed``.

        Args:
            number: Index of κ.
            z: (U, K) changes in the readings since rest, in units of their noise.
            products: (m + 4Q,) Aᵀ P z at this κ, from :meth:`products`.
            present: (U, K) mask of the readings to use.
            cost: Log evidence subtracted for each wrong reading, in nats.
            faults: Whether the explanation may contain wrong readings.
            loads: Whether the explanation may contain loads.
            needed: Gain that is of interest, in nats.
        """
        self.kinds[:] = -1
        if not self.is_bounded(number):
            needed = -math.inf
        if 0.5 * float(z.ravel() @ products[: z.size]) + self._slack(number, cost, faults) < needed:
            return -math.inf
        (m, count), (upper, lower) = self._model.response.shape, self._model.shape
        level, tables = self._model.level(number), self._model.loads(number)
        weighted, diagonal = products.copy(), tables.diagonal.copy()
        vectors, share = np.empty((LOADS + m, m + count)), np.empty(LOADS + m)
        of_upper, of_lower = level.wires.of_upper, level.wires.of_lower
        if faults:  # the search changes them
            of_upper, of_lower = of_upper.copy(), of_lower.copy()
        block, right = np.empty((max(upper, lower),) * 2), np.empty(max(upper, lower))
        items, applied = np.empty(m, np.int64), np.zeros(upper + lower, np.int64)
        return _search(
            z.ravel(), present.ravel().copy(), upper, lower, cost, loads, faults, needed,
            self._slack(number, cost, faults),
            LEAST * float(tables.diagonal[m:].max()),
            level.precision, tables.moved_t, tables.gram, self._model.response_t, level.wires.log_det_p,
            level.wires.log_det_s,
            weighted, diagonal, vectors, share, of_upper, of_lower, block, right, items, applied,
            self.kinds, self.numbers, self.gains,
        )  # fmt: skip

    def is_bounded(self, number: int) -> bool:
        """Return whether the gain of a search at κ number ``number`` is at most ½ χ² plus the slack.

        Loads whose diagonal element of E is below :data:`LEAST` are added with too small a variance, and can
        be credited again. This happens at large κ.
        """
        return bool(self._model.loads(number).diagonal[len(self._model.response) :].min() >= LEAST)

    def _slack(self, number: int, cost: float, faults: bool) -> float:
        """Return an upper bound on ½ ln det S_GG − cost · |G| over all sets G of readings; 0 without faults.

        All principal minors of S e^(−2 cost) are at most det(I + S e^(−2 cost)).
        """
        if not faults:
            return 0.0
        return 0.5 * float(np.log1p(math.exp(-2.0 * cost) / self._model.shrink[number]).sum())


@njit
def crossing_gain(d: Float, alpha: Float, present: Mask, cost: float) -> tuple[float, int]:
    """Return the largest gain in log evidence from treating one reading as wrong, and the reading's index.

    ``d`` is the diagonal of P. The gain is reduced by ln m, because the best of m readings is chosen.
    """
    best, where = -math.inf, -1
    for i in range(present.size):
        if present[i]:
            precision = max(d[i], LEAST)
            gain = 0.5 * alpha[i] * alpha[i] / precision - 0.5 * math.log(precision)
            if gain > best:
                best, where = gain, i
    return best - cost - math.log(present.size), where


@njit
def _group_gain(  # noqa: PLR0913 - a kernel: arrays by name
    p: Float, alpha: Float, present: Mask, first: int, step: int, cost: float, block: Float, right: Float
) -> float:
    """Return the gain in log evidence from treating readings ``first``, ``first + step``, … as wrong.

    The gain is ½ α_Gᵀ P_GG⁻¹ α_G − ½ ln det P_GG, minus the cost of each reading. It is −inf if fewer than
    two of the readings are available. ``p`` is the block P_GG; ``block`` and ``right`` are work arrays.
    """
    n, here = len(p), 0
    for i in range(n):
        here += present[first + i * step]
    if here < 2:
        return -math.inf
    for i in range(n):
        exists = present[first + i * step]
        right[i] = alpha[first + i * step] if exists else 0.0
        for j in range(i, n):
            block[i, j] = p[i, j] if exists and present[first + j * step] else 0.0
        block[i, i] += LEAST if exists else 1.0
    if not cholesky(block, n):
        return -math.inf
    solve_lower_vector(block, right, n)
    gain = -cost * here
    for i in range(n):
        gain += 0.5 * right[i] * right[i] - math.log(block[i, i])
    return gain


@njit_part
def _update_block(  # noqa: PLR0913 - a kernel: arrays by name
    block: Float, first: int, step: int, vectors: Float, share: Float, done: int, count: int
) -> None:
    """Bring the block of the readings ``first``, ``first + step``, … from ``done`` updates to ``count``.

    The updates are those of P, with the search vectors and their shares.
    """
    size = len(block)
    for k in range(done, count):
        row = vectors[k]
        for i in range(size):
            factor = share[k] * row[first + i * step]
            for j in range(size):
                block[i, j] -= factor * row[first + j * step]


@njit
def _best_group(  # noqa: PLR0913 - a kernel: arrays by name
    count: int,
    vectors: Float,
    share: Float,
    applied: Index,
    d: Float,
    alpha: Float,
    present: Mask,
    of_upper: Float,
    of_lower: Float,
    cost: float,
    enough: float,
    bound: float,
    log_det_p: Float,
    log_det_s: Float,
    block: Float,
    right: Float,
) -> tuple[float, int, int]:
    """Return the largest gain from treating a group of readings as wrong, and the group's kind and index.

    A group is a single reading or all readings of a wire. The gain of each group is reduced by ln n, where n
    is the number of groups of its kind. Groups whose gain cannot exceed ``enough`` may be ignored. The gain
    of a wire is at most ``bound`` plus its element of ``log_det_s`` (U + K,) minus the costs. While all
    readings are in use, it is also at most ``bound`` minus its element of ``log_det_p`` minus the costs.
    A wire's block of P is updated only when it is needed: of the ``count`` updates in ``vectors`` and
    ``share``, each block already contains ``applied`` (U + K,). ``block`` and ``right`` are work arrays.
    """
    upper, lower = len(of_upper), len(of_lower)
    complete = True
    for i in range(present.size):
        complete &= present[i]
    gain, number = crossing_gain(d, alpha, present, cost)
    kind = CROSSING
    for k in range(lower):
        here = 0
        for i in range(upper):
            here += present[i * lower + k]
        most = -log_det_p[upper + k] if complete else log_det_s[upper + k]
        if bound + most - cost * here - math.log(lower) <= max(gain, enough):
            continue
        _update_block(of_lower[k], k, lower, vectors, share, applied[upper + k], count)
        applied[upper + k] = count
        value = _group_gain(of_lower[k], alpha, present, k, lower, cost, block, right) - math.log(lower)
        if value > gain:
            gain, kind, number = value, LOWER, k
    for u in range(upper):
        here = 0
        for k in range(lower):
            here += present[u * lower + k]
        most = -log_det_p[u] if complete else log_det_s[u]
        if bound + most - cost * here - math.log(upper) <= max(gain, enough):
            continue
        _update_block(of_upper[u], u * lower, 1, vectors, share, applied[u], count)
        applied[u] = count
        value = _group_gain(of_upper[u], alpha, present, u * lower, 1, cost, block, right) - math.log(upper)
        if value > gain:
            gain, kind, number = value, UPPER, u
    return gain, kind, number


@njit
def _reading_rows(  # noqa: PLR0913 - a kernel: arrays by name
    items: Index, p: Float, moved_t: Float, gram: Float, response_t: Float, rows: Float
) -> None:
    """Write the rows of E that belong to the readings ``items`` (n,) into ``rows`` (≥ n, m + 4Q).

    All rows are written in one pass through ``moved_t``, whose columns are far apart in memory.
    """
    m = len(p)
    for k in range(items.size):
        row, of_reading = rows[k], p[items[k]]
        for j in range(m):
            row[j] = of_reading[j]
        if not gram.size:
            multiply_vector(response_t, row[:m], row[m:])
    if gram.size:
        for j in range(len(moved_t)):
            of_load = moved_t[j]
            for k in range(items.size):
                rows[k, m + j] = of_load[items[k]]


@njit
def _load_row(  # noqa: PLR0913 - a kernel: arrays by name
    load: int, first: int, p: Float, moved_t: Float, gram: Float, response_t: Float, row: Float
) -> None:
    """Write the row of E that belongs to a load into ``row`` (m + 4Q,).

    If ``first`` is m, only the elements of the loads are valid.
    """
    m = len(p)
    if not gram.size:
        multiply_vector(p, response_t[load], row[:m])
        multiply_vector(response_t, row[:m], row[m:])
        return
    if first < m:
        by_reading = moved_t[load]
        for i in range(m):
            row[i] = by_reading[i]
    by_load = gram[load]
    for j in range(by_load.size):
        row[m + j] = by_load[j]


@njit
def _update(  # noqa: PLR0913 - a kernel: arrays by name
    item: int,
    count: int,
    first: int,
    m: int,
    weighted: Float,
    diagonal: Float,
    vectors: Float,
    share: Float,
) -> None:
    """Update the search vectors for step ``count``, which adds a load or leaves out a reading.

    ``item`` is the index of the load or reading among the columns of A; ``vectors[count]`` is its row of E,
    and becomes Aᵀ v. A load is assigned its most likely variance (b² − h) / h², where b is its element of
    Aᵀ P z and h its diagonal element of E. Elements before ``first`` are not updated.
    """
    row = vectors[count]
    size = row.size
    for i in range(count):
        earlier = vectors[i]
        factor = share[i] * earlier[item]
        for j in range(first, size):
            row[j] -= factor * earlier[j]
    b = weighted[item]
    if item < m:
        share[count] = 1.0 / (row[item] + LEAST)
    else:
        h = max(diagonal[item], LEAST)
        share[count] = 1.0 / (h * h / max(b * b - h, LEAST * h) + h)
    of_b, of_square = share[count] * b, share[count]
    for j in range(first, size):
        weighted[j] -= of_b * row[j]
        diagonal[j] -= of_square * row[j] * row[j]
    if item < m:
        weighted[item] = 0.0


@njit
def _best_load(weighted: Float, diagonal: Float, m: int, least: float) -> tuple[float, int]:
    """Return the largest gain from adding a load, and the load's index; −1 if no load yields a gain."""
    most, number = 1.0, -1
    for j in range(m, diagonal.size):
        if diagonal[j] > least:
            ratio = weighted[j] * weighted[j] / diagonal[j]
            if ratio > most:
                most, number = ratio, j - m
    return 0.5 * (most - 1.0 - math.log(most)) - math.log(diagonal.size - m), number


@njit
def _fall(  # noqa: PLR0913 - a kernel: arrays by name
    kind: int,
    number: int,
    weighted: Float,
    diagonal: Float,
    present: Mask,
    of_upper: Float,
    of_lower: Float,
    block: Float,
    right: Float,
) -> float:
    """Return how much a step reduces ½ zᵀ P z. ``block`` and ``right`` are work arrays."""
    m, lower = present.size, len(of_lower)
    if kind in (LOAD, CROSSING):
        item = m + number if kind == LOAD else number
        precision = max(float(diagonal[item]), LEAST)
        fall = 0.5 * float(weighted[item]) ** 2 / precision
        return max(fall - 0.5, 0.0) if kind == LOAD else fall
    if kind == LOWER:
        _group_gain(of_lower[number], weighted, present, number, lower, 0.0, block, right)
        size = len(of_upper)
    else:
        _group_gain(of_upper[number], weighted, present, number * lower, 1, 0.0, block, right)
        size = lower
    fall = 0.0
    for i in range(size):
        fall += 0.5 * float(right[i]) ** 2
    return fall


@njit
def _search(  # noqa: PLR0913, C901 - a kernel: arrays by name, a greedy search
    z: Float,
    present: Mask,
    upper: int,
    lower: int,
    cost: float,
    with_loads: bool,
    faults: bool,
    needed: float,
    slack: float,
    least: float,
    p: Float,
    moved_t: Float,
    gram: Float,
    response_t: Float,
    log_det_p: Float,
    log_det_s: Float,
    weighted: Float,
    diagonal: Float,
    vectors: Float,
    share: Float,
    of_upper: Float,
    of_lower: Float,
    block: Float,
    right: Float,
    items: Index,
    applied: Index,
    kinds: Index,
    numbers: Index,
    gains: Float,
) -> float:
    """Write the best explanation into ``kinds``, ``numbers`` and ``gains``; return its gain in nats.

    Bounds on the gains: the gain of a load, ½ (r − 1 − ln r), reduces ½ χ² = ½ zᵀ P z by ½ (r − 1) and
    multiplies the determinants of all blocks of S by at most r. The gain of a group G of wrong readings
    reduces ½ χ² by ½ α_Gᵀ P_GG⁻¹ α_G; the rest of it is −½ ln det P_GG ≤ ½ ln det S_GG minus the costs. The
    gain of all further steps is therefore at most the remaining ½ χ² (``left``), and with faults at most
    ``left`` + ``paid`` + ``slack``, where ``paid`` is the sum of ½ ln r.
    """
    m = z.size
    count, left, paid, chosen = 0, 0.0, 0.0, 0
    for i in range(m):
        if not present[i]:
            items[chosen] = i
            chosen += 1
    _reading_rows(items[:chosen], p, moved_t, gram, response_t, vectors)
    for k in range(chosen):
        _update(items[k], count, 0, m, weighted, diagonal, vectors, share)
        count += 1
    for i in range(m):
        left += 0.5 * z[i] * weighted[i]
    total = 0.0
    for step in range(STEPS if faults else LOADS):
        gain, kind, number = 0.0, LOAD, -1
        if with_loads:
            gain, number = _best_load(weighted, diagonal, m, least)
        if faults:
            enough = gain if number >= 0 else -math.inf
            by_fault, fault, which = _best_group(
                count, vectors, share, applied, diagonal, weighted, present, of_upper, of_lower, cost, enough,
                left + paid + ROUNDING, log_det_p, log_det_s, block, right,
            )  # fmt: skip
            if by_fault > gain or number < 0:
                gain, kind, number = by_fault, fault, which
        if gain < ENOUGH or number < 0:
            break
        total += gain
        kinds[step], numbers[step], gains[step] = kind, number, gain
        left -= _fall(kind, number, weighted, diagonal, present, of_upper, of_lower, block, right)
        if kind == LOAD and faults:
            paid += 0.5 * math.log(max(weighted[m + number] ** 2 / diagonal[m + number], 1.0))
        if total + left + paid + slack + ROUNDING < needed:
            return -math.inf
        if kind == LOAD:
            # the first m elements, for the readings, are needed only to find faults
            first = 0 if faults else m
            _load_row(number, first, p, moved_t, gram, response_t, vectors[count])
            _update(m + number, count, first, m, weighted, diagonal, vectors, share)
            count += 1
            continue
        chosen = 0
        for i in range(m):
            belongs = (
                (kind == CROSSING and i == number)
                or (kind == LOWER and i % lower == number)
                or (kind == UPPER and i // lower == number)
            )
            if belongs and present[i]:
                present[i] = False
                items[chosen] = i
                chosen += 1
        _reading_rows(items[:chosen], p, moved_t, gram, response_t, vectors[count:])
        for k in range(chosen):
            _update(items[k], count, 0, m, weighted, diagonal, vectors, share)
            count += 1
    return total
