"""Ongoing touch: decides when the touch has ended.

While the patch is touched, the gains drift, so the expected readings at rest become increasingly uncertain. A
touch therefore ends in one of four ways:

- the readings agree with the values that were expected at rest when the touch began;
- the readings have moved back towards rest and agree with the rest values to within the drift since the
  onset;
- a small fraction of the touch remains and stays constant, because the rubber creeps;
- the readings have agreed with the rest values, to within the drift, for half an hour.

Even a slight press that is held for ten minutes meets none of these conditions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skinnode.model.layout import Float
from skinnode.solve.detect.touch_kernel import KEPT
from skinnode.solve.detect.touch_test import TouchTest

RESIDUE: Final = 0.15
"""Fraction of a touch's peak amplitude that may remain as creep."""
RESIDUE_S: Final = 10.0
"""Time without change after which such a remainder is considered creep, in s."""
FORGOTTEN_S: Final = 1800.0
"""Time after which a touch that is indistinguishable from drift ends, in s."""
AVERAGED_S: Final = 1.0
"""Averaging time for a touch's readings, in s. Later readings are compared with this average to detect a
change."""


@dataclass(slots=True)
class HeldTouch:
    """Touch that has not ended yet. Its energy is ‖z‖² for the mean of four frames."""

    test: TouchTest
    """Test used at the onset."""
    average: Float
    """(m,) average change in the readings, excluding the most recent frames."""
    average_features: Float
    """Features of ``average``; see :class:`skinnode.solve.detect.touch_statistic.TouchBasis`."""
    period_s: float
    """Scan period, in s."""
    creep: float
    """Energy that may remain from an earlier touch; 0 if there was none."""
    peak: float = 0.0
    """Largest energy so far."""
    frames: int = 0
    """Number of frames since the onset."""
    _still: int = 0  # number of frames since the last change
    _like_rest: int = 0  # number of successive frames that drift could explain
    _lighter: bool = True  # False after a frame that drift cannot explain, until a change towards rest

    def follow(
        self, features: Float, at: int, oldest: Float, variance: float, later: TouchTest
    ) -> bool | None:
        """Process a frame; return True if the touch ended, None if creep remains, otherwise False.

        Args:
            features: (4, F) features of the last four frames.
            at: Index of the first of these frames in ``features``.
            oldest: (m,) changes in the readings in the first of these frames.
            variance: Noise variance of the stream, relative to the stated variance.
            later: Test that accounts for drift since the onset.
        """
        self.frames += 1
        now = 0.25 * (features[0] + features[1] + features[2] + features[3])
        energy = _energy(self.test, now) / variance
        self.peak = max(self.peak, energy)
        within_drift = KEPT * energy
        if later is not self.test:
            within_drift = KEPT * _energy(later, now) / variance
        self._follow_change(now, features[at], oldest, variance, later)
        if within_drift > later.thresholds.onset[1]:
            self._lighter = False  # drift cannot explain this; wait for the next change towards rest
        agrees = within_drift < later.thresholds.release
        self._like_rest = self._like_rest + 1 if agrees else 0
        forgotten = self._like_rest * self.period_s >= FORGOTTEN_S
        if KEPT * energy < self.test.thresholds.release or (self._lighter and agrees) or forgotten:
            return True
        if self._still * self.period_s >= RESIDUE_S and energy < self.residue:
            return None
        return False

    @property
    def residue(self) -> float:
        """Energy that may remain as creep from this touch or an earlier one."""
        return max(RESIDUE**2 * self.peak, self.creep)

    @property
    def is_creep(self) -> bool:
        """Whether creep from an earlier touch may explain the whole touch."""
        return self.creep > RESIDUE**2 * self.peak

    def _follow_change(
        self, now: Float, oldest_features: Float, oldest: Float, variance: float, later: TouchTest
    ) -> None:
        """Detect a change by comparing the last frames with the average of the touch before them."""
        share = 1.0 / min(max(1.0, AVERAGED_S / self.period_s), self.frames)
        spread = variance * (1.0 / KEPT + share)
        average = self.average_features
        if _energy(self.test, now - average) > spread * self.test.thresholds.change:
            self._still = 0
            self._lighter = self._lighter or _energy(later, now) < _energy(later, average)
        else:
            self._still += 1
        average += share * (oldest_features - average)
        self.average += share * (oldest - self.average)


def _energy(test: TouchTest, features: Float) -> float:
    """Return ‖z‖², given the ``features``."""
    z = test.rows @ features
    return float(z @ z)


def creep_of(peak: float, since_s: float) -> float:
    """Return the energy that may remain ``since_s`` seconds after a touch whose peak energy was ``peak``.

    Creep slows down. During the first :data:`RESIDUE_S`, a fraction :data:`RESIDUE` of the amplitude may
    remain; afterwards, this fraction decreases in inverse proportion to time.
    """
    return peak * (RESIDUE * min(1.0, RESIDUE_S / max(since_s, 1e-9))) ** 2
