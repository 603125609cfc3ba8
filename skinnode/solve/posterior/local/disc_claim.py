"""Standard deviations of a displacement that was estimated with discs.

The variance of a coordinate is the sum of these parts:

- n, due to noise and nuisances
- b, which depends on the prior (:class:`skinnode.solve.posterior.load_prior.LoadPrior`)
- d, due to the uncertainty of the discs
- m, due to a slight touch of the whole patch that remains undetected
- l, due to a local touch that remains undetected: a body on a thin bonded layer may move a single electrode

The standard deviation is √(n + 2.5 b + d + m + l). That for the 95 % interval is √(n + s b + d). The loads of real
bodies are smoother than the independent loads in a disc, so s is less than 1 far from a contact, where only
the sum of the loads matters. Under a contact, s is larger, because the skin there depends on the support of the
rubber, which the prior does not know.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.posterior.local.discs import RADIUS

SHARE_REST: Final = 0.25
"""Factor s of a coordinate that hardly moves, for a single disc of radius :data:`RADIUS`. The constants for s
were fitted to the errors in 1,679 simulated scenes; ``skinnode bench accuracy --only families`` measures other
scenes of the same families."""
SHARE_MOVED: Final = 3.0
"""Factor by which s is larger for a coordinate that moves as far as any."""
SHARE_RADIUS: Final = 0.6
"""Exponent of the strongest disc's radius in s."""
SHARE_DISC: Final = 2.2
"""Factor by which each further disc increases s. Several discs indicate loads that no single disc fits."""
MOVED: Final = 0.1
"""Displacement, relative to the largest displacement, at which half of :data:`SHARE_MOVED` applies."""
LOCAL_MOST: Final = 0.1
"""Standard deviation of the displacement due to an undetected local touch if there are no readings, in
clearances."""
LOCAL_NOTICED: Final = 2.0
"""Displacement of a single coordinate at which a local touch is noticed, in standard deviations of its best
estimate with all other coordinates fixed. Bodies that displaced a single electrode by up to 7 of these standard
deviations were not found, because their readings resembled those of a larger contact nearby."""


def prior_shares(displacement: Float, discs: Float) -> Float:
    """Return the factors s of the coordinates.

    Args:
        displacement: (U, f) estimated displacement, in pitches.
        discs: (D, 5) discs, as in :mod:`skinnode.solve.posterior.local.discs`; at least one.
    """
    strongest = discs[np.argmax(discs[:, 3])]
    base = math.log(SHARE_REST) + SHARE_RADIUS * (strongest[2] - math.log(RADIUS))
    base += (len(discs) - 1) * math.log(SHARE_DISC)
    square = displacement**2
    moved = square / (square + (MOVED * np.abs(displacement).max()) ** 2 + np.finfo(np.float64).tiny)
    return np.asarray(np.exp(base + math.log(SHARE_MOVED) * moved))


def undetected_variance(information: Float, clearance: float) -> Float:
    """Return the variance of the displacement due to an undetected local touch, in pitch².

    Args:
        information: (U, f) squared sensitivity of the readings to each coordinate, in units of their noise and
            per pitch².
        clearance: Median clearance, in pitches.
    """
    return np.asarray(1.0 / ((LOCAL_MOST * clearance) ** -2 + information / LOCAL_NOTICED**2))
