"""Amplifier and converter of a simulated patch: gain, offset, noise and rounding."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from vcan_sim.skin.body import Draws
from vcan_sim.skin.imperfections import Imperfections

FULL_SCALE: Final = 2.0
"""Full scale of the converter, as a multiple of the largest resistance at rest."""


class FrontEnd:
    """Amplifier and converter of one patch.

    The amplifier is balanced at rest, so its gain error acts on changes in resistance. A gain error on the
    whole reading would cancel out, because nodes send R divided by the baseline R0.

    Args:
        imperfections: Sizes of the errors.
        draws: Random draws for the patch.
        rest_ohm: (U, K) float64, ohm: resistances at the amplifier's input when the skin is at rest.
    """

    def __init__(self, imperfections: Imperfections, draws: Draws, rest_ohm: Float) -> None:
        wires = len(rest_ohm)
        common, own = draws.normal("gain", 1), draws.normal("gain of wires", wires, 1)
        self._gain = imperfections.gain * math.sqrt(0.5) * (common + own)
        self._offset_ohm = (
            imperfections.offset * float(np.median(rest_ohm)) * draws.normal("offset", wires, 1)
        )
        self._rest_ohm = rest_ohm
        self._full_ohm = FULL_SCALE * float(rest_ohm.max())
        self._noise_ohm = imperfections.noise * self._full_ohm
        self._step_ohm = self._full_ohm / 2**imperfections.bits if imperfections.bits else 0.0
        self._draws = draws
        self._amplifies = bool(imperfections.gain or imperfections.offset)

    def amplified_ohm(self, ohm: Float) -> Float:
        """Return the amplifier output (U, K) in ohms, with gain and offset errors."""
        if not self._amplifies:
            return ohm
        return np.asarray(ohm + self._gain * (ohm - self._rest_ohm) + self._offset_ohm)

    def converted_ohm(self, ohm: Float, reading: int) -> Float:
        """Return the converter output (U, K) in ohms, with noise and rounding.

        Args:
            ohm: (U, K) float64, ohm: converter input.
            reading: Number of the reading, at least 0. It seeds the noise.
        """
        if self._noise_ohm:
            ohm = ohm + self._noise_ohm * self._draws.stream("noise", reading).standard_normal(ohm.shape)
        if self._step_ohm:
            code = np.rint(ohm / self._step_ohm)
            ohm = np.clip(code, 0.0, self._full_ohm / self._step_ohm - 1.0) * self._step_ohm
        return ohm
