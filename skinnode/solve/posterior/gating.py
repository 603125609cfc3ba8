"""Gating: χ² tests that find moved wires, and wires whose resistances no deformation explains.

Each wire is tested in two ways: with the χ² of its residuals, and with the apparent movement of each
coordinate. χ² alone can miss a movement of one electrode by 7 standard deviations.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.roots import IMPOSSIBLE_CHANCE

QUIET_CHANCE: Final = 0.005
"""Probability per frame that the χ² test mistakes an unmoved wire for a moved wire."""
QUIET_DEVIATIONS: Final = 3.7
"""Maximum apparent movement of any coordinate of an unmoved wire, in standard deviations. With 300
coordinates at rest, noise exceeds this limit in one frame in 15."""
KEPT: Final = 50
"""Number of frames for which a wire stays in the estimate after an unexpected movement."""


class Fit(NamedTuple):
    """Misfit between a displacement and the resistances of a frame."""

    chi_squared: Float
    """(U,) χ² of each wire."""
    sharpest: Float
    """(U,) largest apparent error in any coordinate of each wire, in standard deviations."""
    move: Float
    """(U, f) best-fitting movement of each coordinate with all others fixed, in pitches."""


class Gate:
    """χ² tests for the wires of one patch; remembers which wires moved recently.

    Args:
        wires: Number of upper wires.
        equations: Number of lower wires.
    """

    def __init__(self, wires: int, equations: int) -> None:
        self._quiet, self._impossible = (
            chi_squared_limits(equations, chance) for chance in (QUIET_CHANCE, IMPOSSIBLE_CHANCE)
        )
        self._kept = np.zeros(wires, np.int64)  # remaining frames for which each wire is kept

    def reset(self) -> None:
        """Forget which wires moved recently."""
        self._kept[:] = 0

    def next_frame(self) -> None:
        """Count down the frames for which each kept wire stays in the estimate."""
        self._kept -= self._kept > 0

    def keep(self, wires: Index) -> None:
        """Keep the given wires in the estimate for :data:`KEPT` frames."""
        self._kept[wires] = KEPT

    def moved(self, fit: Fit, count: Index, noises: float | Float = 1.0) -> NDArray[np.bool_]:
        """Return a (U,) mask of the wires whose residuals exceed their noise.

        Args:
            fit: Misfit of the tested displacement.
            count: (U,) number of usable resistances of each wire.
            noises: Noise variance of the residuals, relative to that of a single frame; a number or (U,).
        """
        limit = self._quiet[count]
        return np.asarray(
            (fit.chi_squared > noises * limit) | (fit.sharpest > QUIET_DEVIATIONS * np.sqrt(noises))
        )

    def touched(self, fit: Fit, count: Index, members: Index) -> Index:
        """Return the indices of the wires whose resistances differ from those at rest.

        Args:
            fit: Misfit of the rest position.
            count: (U,) number of usable resistances of each wire.
            members: Wires in the last estimate, which are tested with a lower threshold.
        """
        touched = self.moved(fit, count)
        stay = np.zeros(len(touched), bool)
        stay[members] = True
        touched |= stay & (fit.chi_squared > count)
        if touched.any():
            touched |= self._kept > 0
        return np.flatnonzero(touched)

    def excess(self, fit: Fit, count: Index) -> Float:
        """Return each wire's χ² (U,), relative to the limit above which the wire is INCONSISTENT."""
        return np.asarray(fit.chi_squared / self._impossible[count])


def chi_squared_limits(most: int, chance: float) -> Float:
    """Return the χ² limits (most + 1,) with tail probability ``chance`` for 0, 1, … degrees of freedom."""
    from scipy.special import chdtri

    return np.concatenate([[1e-300], chdtri(np.arange(1.0, most + 1.0), chance)])
