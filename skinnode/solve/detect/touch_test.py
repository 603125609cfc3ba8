"""Touch test for a frame: the statistic of :mod:`skinnode.solve.detect.touch_statistic`, and its thresholds.

The thresholds follow from the distribution of the statistic without a touch
(:mod:`skinnode.solve.detect.weighted_chi_squared`). In the mean of w successive frames, the squared
signal-to-noise ratio of a touch is w times that of one frame, because noise is independent from frame to
frame. The errors in the gains are not independent, so the mean has its own distribution and threshold.
Quantization errors may be the same in successive frames. The thresholds are then interpolated linearly
between those for independent noise and those for noise that is the same in all frames.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final, NamedTuple

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.detect.touch_statistic import (
    PATCH_VARIANCES,
    WIRE_VARIANCES,
    Statistic,
    TouchBasis,
)
from skinnode.solve.detect.weighted_chi_squared import upper_quantile

WINDOWS: Final = (1, 3)
"""Numbers of frames averaged in the tests for the onset of a touch."""
RELEASE_FRAMES: Final = 4
"""Number of frames averaged in the test for the release of a touch."""
RELEASE_CHANCE: Final = 0.01
"""Probability that noise alone delays the release of a touch by one frame."""
CHANGE_CHANCE: Final = 1e-6
"""Probability per frame that noise alone looks like a change in a held touch."""
DOUBT_CHANCE: Final = 0.003
"""Probability that noise alone opens the gate for a frame."""


class Thresholds(NamedTuple):
    """Thresholds of the statistic."""

    onset: tuple[float, float]
    """Thresholds of w ‖mean z‖² for the windows w in :data:`WINDOWS`."""
    doubt: tuple[float, float]
    """Thresholds of w ‖mean z‖² above which a frame is solved even if no touch is reported."""
    change: float
    """Threshold of ‖z‖², relative to its noise variance, above which a touch has changed."""
    release: float
    """Threshold of w ‖mean z‖² for w = :data:`RELEASE_FRAMES`, below which a touch ends."""


@dataclass(frozen=True, eq=False)
class TouchTest:
    """Touch test for one patch, one false-alarm rate and one level of gain uncertainty."""

    statistic: Statistic
    """Statistic."""
    thresholds: Thresholds
    """Thresholds of the statistic."""

    @property
    def rows(self) -> Float:
        """(r, r + U + K + 1) matrix that multiplies the features and yields z."""
        return self.statistic.rows


class TouchTests:
    """Touch tests of one patch for all levels of gain uncertainty.

    Args:
        basis: Features and statistics of the patch.
        chance: Accepted probability of a false alarm in each frame and window.
        coded: Fraction of the noise variance that is the same in successive frames: the quantization error,
            if the noise is below half a code.
    """

    def __init__(self, basis: TouchBasis, chance: float, coded: float) -> None:
        self.basis, self._chance, self._coded = basis, chance, coded
        self._tests: dict[tuple[int, int], TouchTest] = {}

    def test(self, wires: int, patch: int) -> TouchTest:
        """Return the test for two levels of the gains' variances; see :meth:`TouchBasis.statistic`."""
        found = self._tests.get((wires, patch))
        if found is None:
            independent, same = _thresholds(self.basis, wires, patch, self._chance)
            thresholds = Thresholds(
                (independent.onset[0], self._between(independent.onset[1], same.onset[1])),
                (independent.doubt[0], self._between(independent.doubt[1], same.doubt[1])),
                independent.change,
                self._between(independent.release, same.release),
            )
            found = TouchTest(self.basis.statistic(wires, patch), thresholds)
            self._tests[wires, patch] = found
        return found

    def prepare(self) -> None:
        """Compute all tests in advance, so that none of them delays a frame."""
        for wires in range(len(WIRE_VARIANCES)):
            for patch in range(len(PATCH_VARIANCES)):
                self.test(wires, patch)

    def _between(self, independent: float, same: float) -> float:
        return independent + self._coded * (same - independent)


def touch_tests(
    layout: PatchLayout,
    ratios: bytes,
    coded: float,
    period_s: float,
    false_alarms_per_hour: float,
) -> TouchTests:
    """Return the tests of a patch.

    Args:
        layout: The patch.
        ratios: (U, K) noise of each reading divided by the median, as float64.
        coded: Fraction of the noise variance that is the same in successive frames.
        period_s: Scan period, in s.
        false_alarms_per_hour: Accepted number of false alarms per hour.
    """
    frames_per_alarm = 3600.0 / (period_s * false_alarms_per_hour)
    chance = min(1.0 / (frames_per_alarm * len(WINDOWS)), 0.1)
    return TouchTests(TouchBasis.of(layout, ratios), chance, coded)


@functools.lru_cache(maxsize=4096)
def _thresholds(basis: TouchBasis, wires: int, patch: int, chance: float) -> tuple[Thresholds, Thresholds]:
    """Return the thresholds for independent noise, and for noise that is the same in all frames."""
    statistic = basis.statistic(wires, patch)
    one, three = statistic.weights, statistic.weights_of_mean(WINDOWS[1])
    four = statistic.weights_of_mean(RELEASE_FRAMES)
    onset, doubt = upper_quantile(one, chance), upper_quantile(one, DOUBT_CHANCE)
    change, release = upper_quantile(one, CHANGE_CHANCE), upper_quantile(one, RELEASE_CHANCE)
    independent = Thresholds(
        (onset, upper_quantile(three, chance)),
        (doubt, upper_quantile(three, DOUBT_CHANCE)),
        change,
        upper_quantile(four, RELEASE_CHANCE),
    )
    same = Thresholds(
        (onset, WINDOWS[1] * onset), (doubt, WINDOWS[1] * doubt), change, RELEASE_FRAMES * release
    )
    return independent, same
