"""Simulated patch with drifting gains and its touch detector, for the detection benchmark."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.bench.trust_loads import draw
from skinnode.bench.truth import Load, Press, Skin
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.detect.touch_detector import TouchDetector

PERIOD_S: Final = 0.08
"""Default scan period, in s."""
FALSE_ALARMS_PER_HOUR: Final = 0.1
DRIFT: Final = 0.01
BLOCK: Final = 500
"""Number of frames generated at a time by :meth:`Patch.rest_long`."""


@dataclass(eq=False)
class Patch:
    """Simulated patch with drifting gains, and its touch detector."""

    layout: PatchLayout
    noise: float
    drift: str
    rng: np.random.Generator
    false_alarms_per_hour: float = FALSE_ALARMS_PER_HOUR

    def __post_init__(self) -> None:
        upper, lower = self.layout.shape
        self.skin = Skin(self.layout)
        self.rest_ohm = self.skin.rest_ohm
        self.detector = TouchDetector(
            self.layout,
            self.rest_ohm,
            np.full((upper, lower), self.noise),
            np.zeros((upper, lower)),
            period_s=PERIOD_S,
            false_alarms_per_hour=self.false_alarms_per_hour,
        )
        self._upper, self._lower = np.zeros((upper, 1)), np.zeros(lower)
        rate = DRIFT * PERIOD_S / 3600.0
        self._rates = (
            rate * self.rng.choice((-1.0, 1.0), (upper, 1)),
            rate * self.rng.choice((-1.0, 1.0), lower),
        )
        self._walk = DRIFT * math.sqrt(PERIOD_S / 3600.0)

    def see(self, ohm: Float) -> bool:
        """Pass the next frame to the detector; return whether it finds a touch."""
        if self.drift == "steady":
            self._upper += self._rates[0]
            self._lower += self._rates[1]
        elif self.drift == "walk":
            self._upper += self._walk * self.rng.standard_normal(self._upper.shape)
            self._lower += self._walk * self.rng.standard_normal(self._lower.shape)
        noisy = ohm * (1.0 + self.noise * self.rng.standard_normal(ohm.shape))
        return bool(self.detector.see(noisy * (1.0 + self._upper) * (1.0 + self._lower)).touched)

    def rest(self, frames: int) -> None:
        """Pass frames of the untouched patch to the detector."""
        for _ in range(frames):
            self.see(self.rest_ohm)

    def rest_long(self, frames: int) -> tuple[int, int]:
        """Pass many frames of the untouched patch to the detector.

        The frames are generated in blocks, which takes a tenth of the time needed by :meth:`see`.

        Args:
            frames: Number of frames.

        Returns:
            The number of touches that the detector reports, and the number of frames without a touch.
        """
        detector, onsets, untouched = self.detector, 0, 0
        before = detector.touched
        for first in range(0, frames, BLOCK):
            for ohm in self.rest_block(min(BLOCK, frames - first)):
                touched = bool(detector.see(ohm).touched)
                onsets += touched and not before
                untouched += not touched
                before = touched
        return onsets, untouched

    def rest_block(self, frames: int) -> Float:
        """Return the untouched patch's (frames, U, K) resistances in the next frames, in ohms."""
        errors = []
        for gains, rates in ((self._upper, self._rates[0]), (self._lower, self._rates[1])):
            steps = np.zeros((frames, *gains.shape))
            if self.drift == "steady":
                steps += rates
            elif self.drift == "walk":
                steps += self._walk * self.rng.standard_normal(steps.shape)
            steps = gains + np.cumsum(steps, axis=0)
            gains[:] = steps[-1]
            errors.append(steps)
        ohm = self.rng.standard_normal((frames, *self.rest_ohm.shape))
        ohm *= self.noise
        ohm += 1.0
        ohm *= self.rest_ohm
        ohm *= 1.0 + errors[0]
        ohm *= 1.0 + errors[1][:, None, :]
        return ohm

    def settle(self) -> None:
        """Release the patch for five seconds; if the touch does not end, reset and retrain the detector."""
        self.rest(64)
        if self.detector.touched:
            self.detector.reset()
            self.rest(1500)

    def pressed_ohm(self, load: Load, share: float = 1.0) -> Float:
        """Return the (U, K) resistances under a load."""
        return self.skin.resistance_ohm(self.skin.displacement_m((load,), share))


def load_of(kind: str, depth: float, layout: PatchLayout, rng: np.random.Generator) -> Load:
    """Return a random load of one of the kinds in :data:`skinnode.bench.accuracy_detection.FAMILIES`.

    Args:
        kind: Kind of the load.
        depth: Depth divided by the layer height.
        layout: Patch to press.
        rng: Random generator.
    """
    if kind == "small sphere":
        return draw("sphere", layout, rng, depth)
    if kind != "blunt sphere":
        return draw(kind, layout, rng, depth)
    contact = rng.uniform(1.5, 3.0) * layout.pitch_m
    center = draw("sphere", layout, rng, depth).center_m
    sunk = depth * layout.height_m
    return Press(center, contact**2 / sunk, sunk)
