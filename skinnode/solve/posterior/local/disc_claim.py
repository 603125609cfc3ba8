"""Standard deviations of a displacement that was estimated with discs.

The variance of a coordinate is the sum of these parts:

- n, due to noise and nuisances
- b, which depends on the prior (:class:`skinnode.solve.posterior.load_prior.LoadPrior`)
- d, due to the uncertainty of the discs
- m, due to an undetected slight touch of the whole patch
- l, due to an undetected local touch: a body on a thin bonded layer may move a single electrode

The standard deviation is √(n + 2.5 b + d + m + l). For the 95 % interval, it is √(n + s b + d), where the
factor s depends on the coordinate and on the discs. Far from a contact, only the sum of its loads matters,
and s is small, because the loads of real bodies are smoother than the independent loads in a disc. Under a
contact, s is larger, because the displacement there depends on how the rubber is supported, which the prior
does not model.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.posterior.local.discs import RADIUS

SHARE: Final = 0.24
"""Factor s of a coordinate that does not move and is well determined, for a single disc of the expected
radius. The constants for s were fitted to the errors in 4,025 scenes of the families in ``skinnode bench
accuracy --only families``, drawn with seeds that the benchmark does not use: the smallest distance of any
family's ratio or coverage from the limits of the benchmark's targets was maximised."""
SHARE_MOVED: Final = 15.0
"""Factor by which s is larger for the coordinate that moves farthest."""
SHARE_RADIUS: Final = 0.62
"""Exponent of the strongest disc's radius in the formula for s."""
SHARE_LEAST_RADIUS: Final = 0.9
"""Minimum radius in the computation of s, in cells. Without it, the 95 % intervals for small bodies on a thin
bonded layer cover fewer errors: 80 % instead of 81 % in the worst of 16 presses."""
SHARE_DISC: Final = 0.72
"""Factor by which s is smaller for each further disc. Several discs fit the loads better than one."""
SHARE_UNKNOWN: Final = 0.16
"""Factor by which s is smaller for a coordinate that the data do not determine at all."""
MOVED: Final = 0.1
"""Displacement, relative to the largest displacement, at which half of :data:`SHARE_MOVED` applies."""
LOCAL_MOST: Final = 0.1
"""Standard deviation, in clearances, of the displacement due to an undetected local touch if there are no
readings."""
LOCAL_NOTICED: Final = 2.0
"""Standard deviation of an undetected displacement of a single coordinate, relative to the standard deviation
of its best estimate with all other coordinates fixed. Bodies that moved a single electrode by up to 7 of
these standard deviations were not found, because their readings resembled those of a larger contact
nearby."""


def prior_shares(displacement: Float, unknown: Float, discs: Float) -> Float:
    """Return the factors s (U, f) of the coordinates.

    Args:
        displacement: (U, f) estimated displacement, in pitches.
        unknown: (U, f) ratio of b to the prior variance.
        discs: (D, 5) discs, as in :mod:`skinnode.solve.posterior.local.discs`; at least one.
    """
    radius = max(math.exp(discs[np.argmax(discs[:, 3]), 2]), SHARE_LEAST_RADIUS)
    share = SHARE * (radius / RADIUS) ** SHARE_RADIUS * SHARE_DISC ** (len(discs) - 1)
    square = displacement**2
    moved = square / (square + (MOVED * np.abs(displacement).max()) ** 2 + np.finfo(np.float64).tiny)
    return np.asarray(share * SHARE_MOVED**moved * SHARE_UNKNOWN**unknown)


def undetected_variance(information: Float, clearance: float) -> Float:
    """Return the variance of the displacement due to an undetected local touch, in pitch².

    Args:
        information: (U, f) squared sensitivity of the readings, in units of their noise, to each
            coordinate, in pitch⁻².
        clearance: Median clearance, in pitches.
    """
    return np.asarray(1.0 / ((LOCAL_MOST * clearance) ** -2 + information / LOCAL_NOTICED**2))
