"""Explanations of a frame: loads on the skin, readings that are wrong, or two wires that are crossed.

A frame that the elastic prior makes unlikely has one of these causes: loads that the prior does not expect at
their place, as under a contact much narrower than the patch, wrong readings, or two crossed wires. Loads and
wrong readings are added one at a time, the one that raises the log evidence most first (greedy search, as in
orthogonal matching pursuit). Readings are at fault only if the best explanation with faults beats the best
explanation by loads alone by :data:`MARGIN`. So do wires that are crossed, with loads alone explaining the
exchanged readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit
from skinnode.model.data_fault import FaultKind, FaultyPart
from skinnode.model.layout import Float
from skinnode.solve.checks.crossed_wires import WirePair, exchanged, likeliest
from skinnode.solve.checks.reading_model import Level, ReadingModel, evidences
from skinnode.solve.checks.wire_tests import GAIN_STD, LEAST, WireFinding, least_fitting
from skinnode.solve.linalg.cholesky import multiply_vector
from skinnode.solve.linalg.vectors import Index, dot

MARGIN: Final = 20.0
"""Log evidence by which faults must explain a frame better than loads alone to be named, nats. With
:data:`LOADS` loads, none of 6,800 frames of deep slides at a noise of 3e-6, and of 270 frames of presses of
six kinds at 1e-5, was taken for a fault."""
MARGIN_OF_READING: Final = 50.0
"""The same for a single reading that is compared at every scale: under a narrow load at the edge of a patch,
a reading that is right reached 29 nats in 36,000 frames (``bench trust --seed 1 --only hours``)."""
DOUBT: Final = 5.0
"""Log evidence by which faults must explain a frame better than loads alone to make it doubtful, nats. The
largest of 144 healthy frames was 0, with 8 loads in place of :data:`LOADS`."""
STEPS: Final = 8
"""Maximum number of loads and groups of readings in an explanation with faults."""
LOADS: Final = 60
"""Maximum number of loads in an explanation by loads alone: a contact covers up to twenty cells, with three
loads each. With 8, at a noise of 3e-6, half of all healthy frames of a deep slide were taken for faults."""
STRIDE: Final = 2
"""Step in log2 κ between the scales at which explanations are sought."""
SCALES: Final = 4
"""Number of scales, from the one that fits the frame as it is downwards: a wrong reading inflates the scale
by up to 2⁴, a narrow contact by up to 2³."""
ENOUGH: Final = 1.0
"""Gain below which a load or fault is not worth adding, nats."""

_LOAD, _CROSSING, _LOWER, _UPPER = range(4)
_PARTS: Final = {_CROSSING: FaultyPart.CROSSING, _LOWER: FaultyPart.LOWER, _UPPER: FaultyPart.UPPER}

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Group:
    """Readings that are wrong together."""

    part: FaultyPart
    upper: int | None
    lower: int | None
    gain: float
    """Gain in log evidence, nats."""
    kind: FaultKind = FaultKind.CONTRADICTS

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Return the readings (U, K) of the group."""
        found = np.zeros(shape, bool)
        rows = slice(None) if self.upper is None else self.upper
        found[rows, slice(None) if self.lower is None else self.lower] = True
        return found


class Explainer:
    """Search for the likeliest explanation of a frame. Do not share an instance between owners.

    Args:
        model: Distribution of the readings.
    """

    def __init__(self, model: ReadingModel) -> None:
        self._model = model
        m, loads = model.response.shape
        self._response_t = np.ascontiguousarray(model.response.T)
        self._p, self._alpha, self._stiffness = np.empty((m, m)), np.empty(m), np.empty(loads)
        self._work, self._by_load = np.empty(m), np.empty(loads)
        widest = max(model.shape) + 1
        self._block, self._row = np.empty((widest, widest)), np.empty(widest)
        self._kind, self._number = np.empty((2, LOADS), np.int64)
        self._gain = np.empty(LOADS)
        self.margin = -math.inf
        """Log evidence by which faults explained the last frame better than loads or noise alone, nats."""
        self.is_noisier = False
        """Whether more noise than stated explained the last frame better than loads."""

    def wrong_readings(  # noqa: PLR0913 - the frame, and what is known of it
        self,
        z: Float,
        present: Mask,
        evidence: Float,
        best: int,
        cost: float,
        sigma: float,
        noisier: float = -math.inf,
        whole_wires_only: bool = False,
    ) -> tuple[Group, ...]:
        """Return the groups of readings that are wrong; none if loads explain the frame as well.

        Args:
            z: (U, K) changes of the readings since rest, in units of their noise.
            present: (U, K) readings to be used.
            evidence: (L,) log evidence at every κ.
            best: Index of the κ that fits the frame as it is.
            cost: Cost of a wrong reading: ln of the ratio between its expected error and the noise.
            sigma: Relative noise of the readings.
            noisier: Log evidence of the frame without loads or faults, if all its readings are noisier.
            whole_wires_only: Look only for a wire that does not fit, not for wrong or exchanged readings.
        """
        by_loads, by_faults = -math.inf, -math.inf
        groups: tuple[Group, ...] = ()
        for number in range(best, max(best - STRIDE * SCALES, -1), -STRIDE):
            level, start = self._model.level(number), float(evidence[number])
            if not whole_wires_only:
                total = start + self._explain(level, z, present, cost, faults=True)
                if total > by_faults:
                    by_faults, groups = total, self._groups()
            by_loads = max(by_loads, start + self._explain(level, z, present, cost, faults=False))
        self.is_noisier = noisier > by_loads + DOUBT
        by_loads = max(by_loads, noisier)
        level = self._model.level(best)
        multiply_vector(level.precision, z.ravel(), self._alpha)
        alpha = self._alpha.copy()
        if not whole_wires_only:
            by_pair, pair = self._by_exchange(z, present, cost, alpha, level)
            if by_pair > by_faults:
                by_faults, groups = by_pair, _crossed(pair, by_pair - by_loads)
            by_reading, number = self._by_reading(z, present, evidence, best, cost)
            # a narrow load at the edge of a patch resembles a wrong reading: no doubt follows from less
            if by_reading > max(by_faults, by_loads + MARGIN_OF_READING):
                by_faults, groups = by_reading, (self._reading(number, by_reading - by_loads),)
        self.margin = by_faults - by_loads
        finding = least_fitting(level.wires, z, alpha, present, sigma, self._row)
        if finding.gain > DOUBT:
            by_wire = self._by_wire(z, present, cost, finding, alpha, best, GAIN_STD / sigma)
            # a wire under a load of its own does not fit the others either: no doubt follows from less
            if by_wire > max(by_faults, by_loads + MARGIN):
                self.margin, groups = by_wire - by_loads, (self._wire(finding.wire, by_wire - by_loads),)
        return groups if self.margin > MARGIN else ()

    def wrong_without_loads(
        self, z: Float, present: Mask, evidence: Float, best: int, cost: float
    ) -> tuple[Group, ...]:
        """Return the groups of readings that are wrong in a frame that no load explains; at least one.

        The arguments are those of :meth:`wrong_readings`.
        """
        most = -math.inf
        groups: tuple[Group, ...] = ()
        for number in range(best, -1, -STRIDE):
            level = self._model.level(number)
            total = float(evidence[number]) + self._explain(level, z, present, cost, faults=True, loads=False)
            if total > most:
                most, groups = total, self._groups()
        return groups

    def _by_reading(
        self, z: Float, present: Mask, evidence: Float, best: int, cost: float
    ) -> tuple[float, int]:
        """Return the log evidence of the best explanation by loads if one reading is wrong, and that reading.

        A search that adds the best group at each step would leave out its whole wire first at small scales.
        """
        p = self._model.level(best).precision
        multiply_vector(p, z.ravel(), self._alpha)
        gain, number = crossing_gain(p, self._alpha, present.ravel(), cost)
        most = -math.inf
        if gain < DOUBT:
            return most, number
        without = present.copy()
        without.ravel()[number] = False
        for scale in range(best, max(best - STRIDE * SCALES, -1), -STRIDE):
            level = self._model.level(scale)
            d = max(float(level.precision[number, number]), LEAST)
            alpha = float(level.precision[number] @ z.ravel())
            gain = 0.5 * alpha * alpha / d - 0.5 * math.log(d) - cost - math.log(z.size)
            total = float(evidence[scale]) + gain + self._explain(level, z, without, cost, faults=False)
            most = max(most, total)
        return most, number

    def _reading(self, number: int, gain: float) -> Group:
        upper, lower = divmod(number, self._model.shape[1])
        return Group(FaultyPart.CROSSING, upper, lower, gain)

    def _by_exchange(
        self, z: Float, present: Mask, cost: float, alpha: Float, level: Level
    ) -> tuple[float, WirePair]:
        """Return the log evidence of the best explanation by loads with two wires exchanged, and these."""
        gain, pair = likeliest(level.precision, alpha, z, present, far=True)
        if gain < DOUBT:
            return -math.inf, pair
        straight, there = exchanged(z, present, pair)
        choice = math.log(sum(math.comb(count, 2) for count in self._model.shape))
        return self._by_loads(straight, there, cost, lambda level: -choice), pair

    def _by_wire(  # noqa: PLR0913 - the frame, and what was found in it
        self, z: Float, present: Mask, cost: float, finding: WireFinding, alpha: Float, best: int, tau: float
    ) -> float:
        """Return the log evidence of the best explanation by loads if a wire is at fault."""
        upper, lower = self._model.shape
        wire, choice = finding.wire, math.log(2.0 * (upper + lower))
        rows = (slice(wire, wire + 1), slice(None)) if wire < upper else (slice(None), wire - upper)
        z, present = z.copy(), present.copy()
        if math.isfinite(finding.factor):
            z[rows] -= finding.factor
            prior = 0.5 * (finding.factor / tau) ** 2
            return self._by_loads(
                z,
                present,
                cost,
                lambda level: -choice - prior - 0.5 * math.log1p(tau**2 * level.wires.sums[wire]),
            )
        own = z[rows].ravel().copy()
        tables = self._model.level(best).wires
        of_p = tables.upper_p[wire] if wire < upper else tables.lower_p[wire - upper]
        error = np.linalg.solve(of_p @ of_p.T, alpha.reshape(z.shape)[rows].ravel())
        z[rows] = (own - error).reshape(z[rows].shape)  # what the others predict
        present[rows] = False

        def alone(level: Level) -> float:
            tables = level.wires
            of_s = tables.upper_s[wire] if wire < upper else tables.lower_s[wire - upper]
            square = float((np.linalg.solve(of_s, own) ** 2).sum())
            return -choice - float(tables.log_det_p[wire] + tables.log_det_s[wire]) - 0.5 * square

        return self._by_loads(z, present, cost, alone)

    def _by_loads(self, z: Float, present: Mask, cost: float, extra: Callable[[Level], float]) -> float:
        """Return the log evidence of the best explanation by loads, plus ``extra``."""
        model = self._model
        evidence, scratch = np.empty(len(model.kappa)), np.empty(z.size)
        best = evidences(model.vectors_t, model.shrink, model.log_det, z.ravel(), scratch, evidence)
        return max(
            float(evidence[number])
            + extra(model.level(number))
            + self._explain(model.level(number), z, present, cost, faults=False)
            for number in range(best, max(best - STRIDE * SCALES, -1), -STRIDE)
        )

    def _wire(self, wire: int, gain: float) -> Group:
        """Return a wire as a group of wrong readings."""
        upper = self._model.shape[0]
        if wire < upper:
            return Group(FaultyPart.UPPER, wire, None, gain)
        return Group(FaultyPart.LOWER, None, wire - upper, gain)

    def _explain(  # noqa: PLR0913 - the frame, and which explanations are allowed
        self, level: Level, z: Float, present: Mask, cost: float, *, faults: bool, loads: bool = True
    ) -> float:
        """Return the gain in log evidence of the best explanation; its parts stay in the arrays."""
        self._kind[:] = -1
        self._p[:], self._stiffness[:] = level.precision, level.stiffness
        return _explain(
            z.ravel(), present.ravel().copy(), *self._model.shape, cost, loads, faults,
            LEAST * float(level.stiffness.max()), self._response_t, self._p, self._alpha, self._stiffness,
            self._work, self._by_load, self._block, self._kind, self._number, self._gain,
            STEPS if faults else LOADS,
        )  # fmt: skip

    def _groups(self) -> tuple[Group, ...]:
        found = []
        for kind, number, gain in zip(
            self._kind.tolist(), self._number.tolist(), self._gain.tolist(), strict=True
        ):
            if kind > _LOAD:
                upper, lower = divmod(number, self._model.shape[1]) if kind == _CROSSING else (number, number)
                found.append(
                    Group(
                        _PARTS[kind],
                        None if kind == _LOWER else upper,
                        None if kind == _UPPER else lower,
                        gain,
                    )
                )
        return tuple(found)


def _crossed(pair: WirePair, gain: float) -> tuple[Group, ...]:
    """Return the two wires of a pair as groups of wrong readings."""
    wires = pair.one, pair.other
    if pair.part is FaultyPart.UPPER:
        return tuple(Group(pair.part, wire, None, gain, FaultKind.CROSSED) for wire in wires)
    return tuple(Group(pair.part, None, wire, gain, FaultKind.CROSSED) for wire in wires)


@njit
def crossing_gain(p: Float, alpha: Float, present: Mask, cost: float) -> tuple[float, int]:
    """Return the largest gain from treating a reading as wrong, nats, and the number of the reading."""
    best, where = -math.inf, -1
    for i in range(alpha.size):
        if present[i]:
            d = max(p[i, i], LEAST)
            gain = 0.5 * alpha[i] * alpha[i] / d - 0.5 * math.log(d)
            if gain > best:
                best, where = gain, i
    return best - cost - math.log(alpha.size), where


@njit
def group_gain(  # noqa: PLR0913 - a kernel: arrays by name, a Cholesky factorisation as loops
    p: Float, alpha: Float, present: Mask, first: int, step: int, count: int, cost: float, block: Float
) -> float:
    """Return the gain from treating the readings first, first + step, … as wrong; −inf if fewer than two.

    ``block`` is scratch. The gain is ½ α_Gᵀ P_GG⁻¹ α_G − ½ ln det P_GG minus the cost of each reading.
    """
    here = 0
    gain = 0.0
    for i in range(count):
        a = first + i * step
        here += present[a]
        for j in range(i + 1):
            b = first + j * step
            value = p[a, b]
            if i == j:
                value += LEAST if present[a] else 1.0
            for q in range(j):
                value -= block[i, q] * block[j, q]
            if i == j:
                block[i, i] = math.sqrt(max(value, LEAST))
            else:
                block[i, j] = value / block[j, j]
    if here < 2:
        return -math.inf
    square = 0.0
    for i in range(count):
        value = alpha[first + i * step]
        for q in range(i):
            value -= block[i, q] * block[count, q]
        block[count, i] = value / block[i, i]
        square += block[count, i] * block[count, i]
        gain -= math.log(block[i, i])
    return gain + 0.5 * square - cost * here


@njit
def best_group(  # noqa: PLR0913 - a kernel: arrays by name
    p: Float, alpha: Float, present: Mask, upper: int, lower: int, cost: float, block: Float
) -> tuple[float, int, int]:
    """Return the largest gain from treating a group of readings as wrong, its kind and its number.

    The choice among n groups of a kind costs ln n. ``block`` (n + 1, n + 1), n = max(U, K), is scratch.
    """
    gain, kind, number = -math.inf, _CROSSING, 0
    choice = math.log(upper * lower)
    for i in range(upper * lower):
        if present[i]:
            d = max(p[i, i], LEAST)
            value = 0.5 * alpha[i] * alpha[i] / d - 0.5 * math.log(d) - cost - choice
            if value > gain:
                gain, kind, number = value, _CROSSING, i
    for k in range(lower):
        value = group_gain(p, alpha, present, k, lower, upper, cost, block) - math.log(lower)
        if value > gain:
            gain, kind, number = value, _LOWER, k
    for u in range(upper):
        value = group_gain(p, alpha, present, u * lower, 1, lower, cost, block) - math.log(upper)
        if value > gain:
            gain, kind, number = value, _UPPER, u
    return gain, kind, number


@njit
def _condition(  # noqa: PLR0913 - a kernel: arrays by name
    row: int, response_t: Float, p: Float, alpha: Float, stiffness: Float, work: Float, by_load: Float
) -> None:
    """Remove the reading ``row`` from the data."""
    m = alpha.size
    for i in range(m):
        work[i] = p[row, i]
    factor = 1.0 / (work[row] + LEAST)
    multiply_vector(response_t, work, by_load)
    for j in range(stiffness.size):
        stiffness[j] -= factor * by_load[j] * by_load[j]
    shared = factor * alpha[row]
    for i in range(m):
        alpha[i] -= shared * work[i]
        value, line = factor * work[i], p[i]
        for j in range(m):
            line[j] -= value * work[j]
    for i in range(m):
        p[row, i], p[i, row] = 0.0, 0.0
    alpha[row] = 0.0


@njit
def _add_load(  # noqa: PLR0913 - a kernel: arrays by name
    load: int, response_t: Float, p: Float, alpha: Float, stiffness: Float, work: Float, by_load: Float
) -> None:
    """Add a load with its likeliest variance, (b² − h) / h²."""
    response = response_t[load]
    multiply_vector(p, response, work)
    h = max(stiffness[load], LEAST)
    b = dot(response, alpha)
    share = 1.0 / (h * h / max(b * b - h, LEAST * h) + h)
    multiply_vector(response_t, work, by_load)
    for j in range(stiffness.size):
        stiffness[j] -= share * by_load[j] * by_load[j]
    for i in range(alpha.size):
        alpha[i] -= share * b * work[i]
        value, line = share * work[i], p[i]
        for j in range(alpha.size):
            line[j] -= value * work[j]


@njit
def _explain(  # noqa: PLR0913, C901 - a kernel: arrays by name, a greedy search
    z: Float,
    present: Mask,
    upper: int,
    lower: int,
    cost: float,
    with_loads: bool,
    faults: bool,
    least: float,
    response_t: Float,
    p: Float,
    alpha: Float,
    stiffness: Float,
    work: Float,
    by_load: Float,
    block: Float,
    kinds: Index,
    numbers: Index,
    gains: Float,
    steps: int,
) -> float:
    """Write the best explanation of ``z`` (m,) into the last three arrays; return its gain.

    ``p`` (m, m) and ``stiffness`` (3Q,) are those of a level on entry and are changed, as is ``present``.
    """
    multiply_vector(p, z, alpha)
    for i in range(present.size):
        if not present[i]:
            _condition(i, response_t, p, alpha, stiffness, work, by_load)
    total = 0.0
    for step in range(steps):
        multiply_vector(response_t, alpha, by_load)
        gain, kind, number = 0.0, _LOAD, -1
        for j in range(stiffness.size if with_loads else 0):
            if stiffness[j] > least:
                ratio = by_load[j] * by_load[j] / stiffness[j]
                if ratio > 1.0:
                    value = 0.5 * (ratio - 1.0 - math.log(ratio)) - math.log(stiffness.size)
                    if value > gain:
                        gain, number = value, j
        if faults:
            by_fault, fault, which = best_group(p, alpha, present, upper, lower, cost, block)
            if by_fault > gain:
                gain, kind, number = by_fault, fault, which
        if gain < ENOUGH or number < 0:
            break
        total += gain
        kinds[step], numbers[step], gains[step] = kind, number, gain
        if kind == _LOAD:
            _add_load(number, response_t, p, alpha, stiffness, work, by_load)
            continue
        for u in range(upper):
            for k in range(lower):
                i = u * lower + k
                chosen = (
                    (kind == _CROSSING and i == number)
                    or (kind == _LOWER and k == number)
                    or (kind == _UPPER and u == number)
                )
                if chosen and present[i]:
                    present[i] = False
                    _condition(i, response_t, p, alpha, stiffness, work, by_load)
    return total
