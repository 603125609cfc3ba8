"""A touch from its onset on: decides when it has ended.

Rest is known less and less well while the patch is touched, because the gains drift. A touch therefore ends
in one of four ways:

- the readings agree with rest as it was at the onset;
- they have changed towards rest, and agree with it within the drift since the onset;
- a small share of the touch remains and stays constant: the rubber creeps;
- they have agreed with rest, within the drift, for half an hour.

A press that is held does none of this for ten minutes, however slight it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skinnode.model.layout import Float
from skinnode.solve.detect.touch_kernel import KEPT
from skinnode.solve.detect.touch_test import TouchTest

RESIDUE: Final = 0.15
"""Share of a touch's largest amplitude that may remain as creep."""
RESIDUE_S: Final = 10.0
"""Time without a change after which such a remainder is taken for creep, s."""
FORGOTTEN_S: Final = 1800.0
"""Time after which a touch that looks no different from drift ends, s."""
AVERAGED_S: Final = 1.0
"""Time over which a touch is averaged, to notice a change, s."""


@dataclass(slots=True)
class HeldTouch:
    """A touch that has not ended yet. Energies are ‖z‖² of the mean of four frames."""

    test: TouchTest
    """Test at the onset."""
    average: Float
    """(m,) average change of the readings, without the last frames."""
    period_s: float
    """Scan period, s."""
    creep: float
    """Energy that may remain of an earlier touch, 0 if there was none."""
    peak: float = 0.0
    """Largest energy."""
    frames: int = 0
    """Number of frames since the onset."""
    _still: int = 0  # frames since the last change
    _like_rest: int = 0  # frames in which drift could explain the readings
    _lighter: bool = True  # whether drift could explain the readings, or they have changed towards rest since

    def follow(self, recent: Float, oldest: Float, variance: float, later: TouchTest) -> bool | None:
        """Process a frame; return whether the touch ended, or None if it ended and creep remains.

        Args:
            recent: (4, m) changes of the readings in the last frames.
            oldest: (m,) the first of them.
            variance: Noise variance of the stream, relative to the stated variance.
            later: Test that allows for the drift since the onset.
        """
        self.frames += 1
        now = recent.mean(axis=0)
        energy = float(((self.test.rows @ now) ** 2).sum()) / variance
        self.peak = max(self.peak, energy)
        within_drift = KEPT * energy
        if later is not self.test:
            within_drift = KEPT * float(((later.rows @ now) ** 2).sum()) / variance
        self._follow_change(now, oldest, variance, later)
        if within_drift > later.onset[1]:
            self._lighter = False  # drift cannot explain this; wait for the next change towards rest
        agrees = within_drift < later.release
        self._like_rest = self._like_rest + 1 if agrees else 0
        forgotten = self._like_rest * self.period_s >= FORGOTTEN_S
        if KEPT * energy < self.test.release or (self._lighter and agrees) or forgotten:
            return True
        if self._still * self.period_s >= RESIDUE_S and energy < self.residue:
            return None
        return False

    @property
    def residue(self) -> float:
        """Energy that may remain as creep, of this touch or of an earlier one."""
        return max(RESIDUE**2 * self.peak, self.creep)

    @property
    def is_creep(self) -> bool:
        """Whether the creep of an earlier touch may be all there is."""
        return self.creep > RESIDUE**2 * self.peak

    def _follow_change(self, now: Float, oldest: Float, variance: float, later: TouchTest) -> None:
        """Compare the last frames with the average of the touch before them, to notice a change."""
        share = 1.0 / min(max(1.0, AVERAGED_S / self.period_s), self.frames)
        spread = variance * (1.0 / KEPT + share)
        average = self.average
        if float(((self.test.rows @ (now - average)) ** 2).sum()) > spread * self.test.change:
            self._still = 0
            lighter = float(((later.rows @ now) ** 2).sum()) < float(((later.rows @ average) ** 2).sum())
            self._lighter = self._lighter or lighter
        else:
            self._still += 1
        average += share * (oldest - average)


def creep_of(peak: float, since_s: float) -> float:
    """Return the energy that may remain of a touch with the energy ``peak``, ``since_s`` after its end.

    Creep slows down: in the first :data:`RESIDUE_S`, :data:`RESIDUE` of the amplitude may remain, afterwards
    less in inverse proportion to the time.
    """
    return peak * (RESIDUE * min(1.0, RESIDUE_S / max(since_s, 1e-9))) ** 2
