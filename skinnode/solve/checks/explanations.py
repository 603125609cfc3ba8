"""Explanations of a frame: loads on the skin, wrong readings, or two crossed wires.

A frame can be unlikely under the elastic prior for three reasons: some readings are wrong, two wires are
crossed, or the loads are unusual, such as a contact much narrower than the patch. A greedy search, similar to
orthogonal matching pursuit, builds an explanation step by step. Each step adds the load or the group of wrong
readings with the largest gain in log evidence. An explanation with faults is accepted only if its log
evidence exceeds that of the best explanation without faults by more than :data:`MARGIN`. Crossed wires need
only :data:`MARGIN_OF_EXCHANGE`. Their log evidence is computed for loads alone, after the readings of the two
wires have been exchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import FaultKind, FaultyPart
from skinnode.model.layout import Float
from skinnode.solve.checks.crossed_wires import WirePair, exchanged, likeliest
from skinnode.solve.checks.greedy_search import CROSSING, LOAD, LOWER, UPPER, GreedySearch, crossing_gain
from skinnode.solve.checks.reading_model import Level, ReadingModel, evidences
from skinnode.solve.checks.wire_tests import GAIN_STD, LEAST, WireFinding, least_fitting

MARGIN: Final = 100.0
"""Minimum margin for reporting a fault, in nats. The margin is the log evidence with faults minus the log
evidence of loads alone. Over 1.9 million healthy frames, the margin reached 29 nats, in presses on the border
of a patch (``bench trust --seed 1 --only hours``). While a sphere slides with friction over a thin bonded
layer, it is larger: in the scene ``press`` (``docs/friction.py``, noise 1e-5), 13 of 200 frames exceed 80
nats, and none exceeds 100. Harder slides reach larger margins: see docs/limits.md."""
MARGIN_OF_EXCHANGE: Final = 40.0
"""Minimum margin for reporting two exchanged wires, in nats. With a margin of 80, wires that had been
exchanged before the tare were reported too late: 0.2 % of the trusted coordinates had errors beyond 5
standard deviations (``bench trust --seed 1 --only "upper wires crossed, tared"``)."""
MARGIN_OF_WIRE: Final = 20.0
"""Minimum margin for reporting a wire that contradicts the others, in nats. At this value, no faults were
reported in 6,800 healthy frames of deep slides (noise 3e-6), or in 270 frames with six kinds of press (noise
1e-5). A smaller margin does not make a frame doubtful."""
MARGIN_OF_READING: Final = 100.0
"""Minimum margin for reporting a single wrong reading, in nats. Over 1.2 million healthy frames at a noise of
1e-5, the margin reached 77 and 87 nats, in two presses (``bench trust --seed 1 --only hours --hours 10``)."""
DOUBT: Final = 5.0
"""Minimum margin at which a frame is considered doubtful, in nats. In 144 healthy frames, the margin over
explanations with up to 8 loads was never positive."""
CLEAR: Final = -30.0
"""Margin, in nats, below which loads or noise clearly explain a frame. Lower margins need not be computed."""
SCALES: Final = 4
"""Number of prior scales searched for explanations: the best-fitting scale and smaller ones. A wrong reading
can inflate the best-fitting scale by a factor of up to 2⁴, and a narrow contact by a factor of up to 2³."""
STRIDE: Final = 2
"""Step in log2 κ between the prior scales that are searched."""
HOPELESS: Final = 150.0
"""Difference between the log evidence of loads and of faults at one prior scale, in nats, above which smaller
scales are not searched for faults. In 163 frames with a fault, the difference was at most 114 nats."""

_PARTS: Final = {CROSSING: FaultyPart.CROSSING, LOWER: FaultyPart.LOWER, UPPER: FaultyPart.UPPER}

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Group:
    """Group of wrong readings: the reading of one crossing, or all readings of one wire."""

    part: FaultyPart
    upper: int | None
    lower: int | None
    gain: float
    """Gain in log evidence from treating the readings as wrong, in nats."""
    kind: FaultKind = FaultKind.CONTRADICTS

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Return a (U, K) mask of the group's readings."""
        found = np.zeros(shape, bool)
        rows = slice(None) if self.upper is None else self.upper
        found[rows, slice(None) if self.lower is None else self.lower] = True
        return found


class Explainer:
    """Finds the most likely explanation of a frame. Each stream needs its own instance.

    Args:
        model: Joint distribution of the readings.
    """

    def __init__(self, model: ReadingModel) -> None:
        self._model = model
        self._search = GreedySearch(model)
        self._row = np.empty(max(model.shape) + 1)
        self.margin = -math.inf
        """Margin of the last frame, in nats: log evidence with faults minus log evidence with loads or more
        noise. Below :data:`CLEAR`, it is only a bound, or −inf."""
        self.is_noisier = False
        """Whether noise above the stated level explains the last frame better than loads do."""

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
        """Return the groups of wrong readings; empty if loads or noise explain the frame well enough.

        Args:
            z: (U, K) changes in the readings since rest, in units of their noise.
            present: (U, K) mask of the readings to use.
            evidence: (L,) log evidence of the frame at each κ.
            best: Index of the κ with the largest log evidence.
            cost: Log evidence subtracted for each wrong reading, in nats: the logarithm of its expected error
                divided by the noise.
            sigma: Relative noise of the readings.
            noisier: Log evidence of the frame, assuming noise above the stated level and no faults.
            whole_wires_only: Whether to search only for wires that contradict the others. Single wrong
                readings and crossed wires are then skipped.
        """
        products = self._search.products(z, _scales(best))
        scales = list(zip(_scales(best), products, strict=True))
        of_loads = [
            float(evidence[number]) + self._search.run(number, z, of_scale, present, cost, faults=False)
            for number, of_scale in scales
        ]
        by_loads = max(of_loads)
        self.is_noisier = noisier > by_loads + DOUBT
        by_loads = max(by_loads, noisier)
        by_faults, needed_of_faults = -math.inf, MARGIN
        groups: tuple[Group, ...] = ()
        for (number, of_scale), loads in zip(scales, of_loads, strict=True) if not whole_wires_only else ():
            start, hopeless = float(evidence[number]), loads - HOPELESS
            needed = min(by_loads + CLEAR, hopeless)
            total = start + self._search.run(
                number, z, of_scale, present, cost, faults=True, needed=needed - start
            )
            if total > by_faults:
                by_faults, groups = total, self._groups()
            if total <= hopeless:
                break
        level, alpha = self._model.level(best), products[0, : z.size].copy()
        if not whole_wires_only:
            by_pair, pair = self._by_exchange(z, present, cost, alpha, level, by_loads + CLEAR)
            if by_pair > by_faults:
                by_faults, groups = by_pair, _crossed(pair, by_pair - by_loads)
                needed_of_faults = MARGIN_OF_EXCHANGE
            needed = by_loads + MARGIN_OF_READING
            by_reading, number = self._by_reading(z, products, present, evidence, best, cost, needed)
            # A narrow load at the edge of a patch looks like a wrong reading. A smaller margin is therefore
            # no reason to doubt the frame.
            if by_reading > max(by_faults, needed):
                by_faults, groups = by_reading, (self._reading(number, by_reading - by_loads),)
        self.margin, needed = by_faults - by_loads, needed_of_faults
        finding = least_fitting(level.wires, z, alpha, present, sigma, self._row)
        if finding.gain > DOUBT:
            enough = by_loads + MARGIN_OF_WIRE
            by_wire = self._by_wire(z, present, cost, finding, alpha, best, GAIN_STD / sigma, enough)
            # A load on only one wire makes this wire contradict the others. A smaller margin is therefore no
            # reason to doubt the frame.
            if by_wire > max(by_faults, enough):
                self.margin, needed = by_wire - by_loads, MARGIN_OF_WIRE
                groups = (self._wire(finding.wire, self.margin),)
        return groups if self.margin > needed else ()

    def wrong_without_loads(
        self, z: Float, present: Mask, evidence: Float, best: int, cost: float
    ) -> tuple[Group, ...]:
        """Return the most likely groups of wrong readings of a frame that loads cannot explain.

        The arguments are those of :meth:`wrong_readings`.
        """
        most = -math.inf
        groups: tuple[Group, ...] = ()
        scales = range(best, -1, -STRIDE)
        for number, of_scale in zip(scales, self._search.products(z, scales), strict=True):
            total = float(evidence[number])
            total += self._search.run(number, z, of_scale, present, cost, faults=True, loads=False)
            if total > most:
                most, groups = total, self._groups()
        return groups

    def _by_reading(  # noqa: PLR0913 - the frame, and what is known of it
        self,
        z: Float,
        products: Float,
        present: Mask,
        evidence: Float,
        best: int,
        cost: float,
        needed: float,
    ) -> tuple[float, int]:
        """Return the highest log evidence for loads and one wrong reading, and the index of this reading.

        A log evidence that does not exceed ``needed`` is not computed; −inf is returned instead. A single
        reading needs its own search. At small prior scales, the greedy search would first leave out the whole
        wire of this reading.
        """
        alphas = np.ascontiguousarray(products[:, : z.size])
        gain, number = crossing_gain(self._model.diagonals[best], alphas[0], present.ravel(), cost)
        most = -math.inf
        if gain < DOUBT:
            return most, number
        without = present.copy()
        without.ravel()[number] = False
        for scale, of_scale, alpha in zip(_scales(best), products, alphas[:, number].tolist(), strict=True):
            d = max(float(self._model.diagonals[scale, number]), LEAST)
            gain = 0.5 * alpha * alpha / d - 0.5 * math.log(d) - cost - math.log(z.size)
            gain += float(evidence[scale])
            gain += self._search.run(scale, z, of_scale, without, cost, faults=False, needed=needed - gain)
            most = max(most, gain)
        return most, number

    def _reading(self, number: int, gain: float) -> Group:
        upper, lower = divmod(number, self._model.shape[1])
        return Group(FaultyPart.CROSSING, upper, lower, gain)

    def _by_exchange(  # noqa: PLR0913 - the frame, and what is known of it
        self, z: Float, present: Mask, cost: float, alpha: Float, level: Level, needed: float
    ) -> tuple[float, WirePair]:
        """Return the highest log evidence for loads and two exchanged wires, and these wires.

        A log evidence that does not exceed ``needed`` is not computed; −inf is returned instead.
        """
        gain, pair = likeliest(level.precision, alpha, z, present, far=True, enough=DOUBT)
        if gain <= DOUBT:
            return -math.inf, pair
        straight, there = exchanged(z, present, pair)
        choice = math.log(sum(math.comb(count, 2) for count in self._model.shape))
        return self._by_loads(straight, there, cost, lambda level: -choice, needed), pair

    def _by_wire(  # noqa: PLR0913 - the frame, and what was found in it
        self,
        z: Float,
        present: Mask,
        cost: float,
        finding: WireFinding,
        alpha: Float,
        best: int,
        tau: float,
        needed: float,
    ) -> float:
        """Return the highest log evidence for loads and a fault of the wire in ``finding``.

        A log evidence that does not exceed ``needed`` is not computed; −inf is returned instead.
        """
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
                needed,
            )
        own = z[rows].ravel().copy()
        tables = self._model.level(best).wires
        of_p = tables.upper_p[wire] if wire < upper else tables.lower_p[wire - upper]
        error = np.linalg.solve(of_p @ of_p.T, alpha.reshape(z.shape)[rows].ravel())
        z[rows] = (own - error).reshape(z[rows].shape)  # prediction from the other wires
        present[rows] = False

        def alone(level: Level) -> float:
            tables = level.wires
            of_s = tables.upper_s[wire] if wire < upper else tables.lower_s[wire - upper]
            square = float((np.linalg.solve(of_s, own) ** 2).sum())
            return -choice - float(tables.log_det_p[wire] + tables.log_det_s[wire]) - 0.5 * square

        return self._by_loads(z, present, cost, alone, needed)

    def _by_loads(
        self, z: Float, present: Mask, cost: float, extra: Callable[[Level], float], needed: float
    ) -> float:
        """Return the highest log evidence for loads alone, with ``extra`` added at each κ.

        A log evidence that does not exceed ``needed`` is not computed; −inf is returned instead.
        """
        model = self._model
        evidence, scratch = np.empty(len(model.kappa)), np.empty((2, z.size))
        best = evidences(model.vectors_t, model.shrink, model.log_det, z.ravel(), scratch, evidence)
        starts = {number: float(evidence[number]) + extra(model.level(number)) for number in _scales(best)}
        half_chi2 = -evidence - 0.5 * model.log_det  # loads can gain no more than this
        hopeful = [
            number
            for number in starts
            if starts[number] + half_chi2[number] >= needed or not self._search.is_bounded(number)
        ]
        if not hopeful:
            return -math.inf
        return max(
            starts[number]
            + self._search.run(
                number, z, of_scale, present, cost, faults=False, needed=needed - starts[number]
            )
            for number, of_scale in zip(hopeful, self._search.products(z, hopeful), strict=True)
        )

    def _wire(self, wire: int, gain: float) -> Group:
        """Return all readings of a wire as one group."""
        upper = self._model.shape[0]
        if wire < upper:
            return Group(FaultyPart.UPPER, wire, None, gain)
        return Group(FaultyPart.LOWER, None, wire - upper, gain)

    def _groups(self) -> tuple[Group, ...]:
        """Return the groups of wrong readings found in the last search."""
        found, search = [], self._search
        for kind, number, gain in zip(
            search.kinds.tolist(), search.numbers.tolist(), search.gains.tolist(), strict=True
        ):
            if kind > LOAD:
                upper, lower = divmod(number, self._model.shape[1]) if kind == CROSSING else (number, number)
                found.append(
                    Group(
                        _PARTS[kind],
                        None if kind == LOWER else upper,
                        None if kind == UPPER else lower,
                        gain,
                    )
                )
        return tuple(found)


def _scales(best: int) -> range:
    """Return the indices of the values of κ to search, in descending order from ``best``."""
    return range(best, max(best - STRIDE * SCALES, -1), -STRIDE)


def _crossed(pair: WirePair, gain: float) -> tuple[Group, ...]:
    """Return the wires of a crossed pair as two groups of wrong readings."""
    wires = pair.one, pair.other
    if pair.part is FaultyPart.UPPER:
        return tuple(Group(pair.part, wire, None, gain, FaultKind.CROSSED) for wire in wires)
    return tuple(Group(pair.part, None, wire, gain, FaultKind.CROSSED) for wire in wires)
