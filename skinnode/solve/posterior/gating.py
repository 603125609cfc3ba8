"""Gating: χ² tests of which wires moved, and of which a deformation explains.

The test of a wire is on χ² of its residuals, and on each of its coordinates alone, since χ² overlooks an
electrode that moved by 7 standard deviations.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.roots import IMPOSSIBLE_CHANCE

QUIET_CHANCE: Final = 0.005
"""Chance a frame at which a wire at rest, or unmoved, is taken for moved: χ² test."""
QUIET_DEVIATIONS: Final = 3.7
"""Standard deviations by which a single coordinate must seem to move for its wire to be taken for moved: one
in 15 unmoved frames of 300 coordinates."""
KEPT: Final = 50
"""Frames for which the equations of a wire are used after it moved and the others did not predict that."""


class Fit(NamedTuple):
    """How badly a displacement explains a frame."""

    chi_squared: Float
    """(U,) χ² of each wire."""
    sharpest: Float
    """(U,) standard deviations by which a single coordinate is off at most."""
    move: Float
    """(U, f) move of each coordinate that would explain the wire best, were it the only one; pitches."""


class Gate:
    """The χ² tests of one patch, and the wires they keep in the estimate.

    Args:
        wires: Number of upper wires.
        equations: Number of lower wires.
    """

    def __init__(self, wires: int, equations: int) -> None:
        self._quiet, self._impossible = (
            chi_squared_limits(equations, chance) for chance in (QUIET_CHANCE, IMPOSSIBLE_CHANCE)
        )
        self._kept = np.zeros(wires, np.int64)  # frames left to each wire that was kept

    def reset(self) -> None:
        """Keep no wire."""
        self._kept[:] = 0

    def next_frame(self) -> None:
        """Let a frame pass for the wires kept."""
        self._kept -= self._kept > 0

    def keep(self, wires: Index) -> None:
        """Keep these wires in the estimate for :data:`KEPT` frames."""
        self._kept[wires] = KEPT

    def moved(self, fit: Fit, count: Index, noises: float | Float = 1.0) -> NDArray[np.bool_]:
        """Return the wires (U,) whose residuals are beyond noise.

        Args:
            fit: Fit of the displacement that is tested.
            count: (U,) usable resistances of each wire.
            noises: Variance of the residuals' noise, in its own: a number or (U,).
        """
        limit = self._quiet[count]
        return np.asarray(
            (fit.chi_squared > noises * limit) | (fit.sharpest > QUIET_DEVIATIONS * np.sqrt(noises))
        )

    def touched(self, fit: Fit, count: Index, members: Index) -> Index:
        """Return the indices of the wires whose resistances are not those at rest.

        Args:
            fit: Fit of the rest position.
            count: (U,) usable resistances of each wire.
            members: Wires of the last estimate; they stay a little longer.
        """
        touched = self.moved(fit, count)
        stay = np.zeros(len(touched), bool)
        stay[members] = True
        touched |= stay & (fit.chi_squared > count)
        if touched.any():
            touched |= self._kept > 0
        return np.flatnonzero(touched)

    def excess(self, fit: Fit, count: Index) -> Float:
        """Return χ² of each wire (U,) over the χ² that no wire obeying the model has."""
        return np.asarray(fit.chi_squared / self._impossible[count])


def chi_squared_limits(most: int, chance: float) -> Float:
    """Return the χ² (most + 1,) that 0, 1, … degrees of freedom exceed with ``chance``; tiny for none."""
    from scipy.special import chdtri

    return np.concatenate([[1e-300], chdtri(np.arange(1.0, most + 1.0), chance)])
