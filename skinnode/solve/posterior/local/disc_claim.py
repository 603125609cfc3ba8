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
does not model. There, s is also larger for tangential coordinates, because friction can move them farther
than the prior expects.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.local.discs import RADIUS

SHARE: Final = 0.22
"""Factor s of a normal coordinate that does not move and is well determined, for a disc of the expected
radius. The constants for s were fitted to the errors in 7,045 scenes of the families in ``skinnode bench
accuracy --only families``, drawn with seeds that the benchmark does not use, so that each family's ratios and
coverages are as far as possible from the limits of the benchmark's targets, and the coverage depends as
little as possible on a coordinate's direction, displacement and determination."""
SHARE_MOVED: Final = 16.5
"""Factor by which s is larger for the coordinate that moves farthest."""
SHARE_RADIUS: Final = 0.65
"""Exponent of the strongest disc's radius in the formula for s."""
SHARE_LEAST_RADIUS: Final = 0.9
"""Minimum radius in the computation of s, in cells. Without it, the value that is closest to a limit of a
target is 1 % of the target's half-width away from it, instead of 9 %."""
SHARE_TANGENTIAL: Final = 1.65
"""Factor by which s is larger for a tangential coordinate."""
SHARE_UNKNOWN: Final = 0.0097
"""Factor by which s is smaller for a coordinate that the data do not determine at all."""
SHARE_UNKNOWN_TANGENTIAL: Final = 11.0
"""Factor by which s is larger for an undetermined tangential coordinate of the electrode that moves farthest:
friction may have moved it although the estimate is small."""
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


def prior_shares(moved: Float, free: Index, unknown: Float, discs: Float) -> Float:
    """Return the factors s (U, f) of the free coordinates.

    Args:
        moved: (U, 3N) estimated displacement, in pitches; 0 for fixed coordinates.
        free: (f,) indices of the free coordinates of a wire.
        unknown: (U, f) ratio of b to the prior variance.
        discs: (D, 5) discs, as in :mod:`skinnode.solve.posterior.local.discs`; at least one.
    """
    radius = max(math.exp(discs[np.argmax(discs[:, 3]), 2]), SHARE_LEAST_RADIUS)
    square = moved**2
    half = MOVED**2 * square.max() + np.finfo(np.float64).tiny
    own = square[:, free]
    electrode = np.repeat(square.reshape(len(moved), -1, 3).sum(axis=-1), 3, axis=1)[:, free]
    tangential = free % 3 != 2
    exponent = math.log(SHARE_MOVED) * own / (own + half) + math.log(SHARE_UNKNOWN) * unknown
    exponent += tangential * (
        math.log(SHARE_TANGENTIAL)
        + math.log(SHARE_UNKNOWN_TANGENTIAL) * unknown * electrode / (electrode + half)
    )
    return np.asarray(SHARE * (radius / RADIUS) ** SHARE_RADIUS * np.exp(exponent))


def undetected_variance(information: Float, clearance: float) -> Float:
    """Return the variance of the displacement due to an undetected local touch, in pitch².

    Args:
        information: (U, f) squared sensitivity of the readings, in units of their noise, to each
            coordinate, in pitch⁻².
        clearance: Median clearance, in pitches.
    """
    return np.asarray(1.0 / ((LOCAL_MOST * clearance) ** -2 + information / LOCAL_NOTICED**2))
