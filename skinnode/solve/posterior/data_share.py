"""Share of the data in a posterior: how much of a displacement comes from the frame, not from the prior."""

from __future__ import annotations

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.posterior.map_estimate import PRIOR_DOUBT, SMOOTH_SHARE


def data_share(std: Float, core: Float, prior_variance: Float) -> Float:
    """Return 1 minus the ratio of the posterior's variance to the prior's; 0 where nothing is known.

    ``std`` and ``core`` count the variance that only the prior determines several times or in part. Their
    difference gives it back, and with it the variance of the posterior.

    Args:
        std: (U, f) standard deviations, pitches.
        core: (U, f) standard deviations for the 95 % interval, pitches.
        prior_variance: (U f,) variances of the prior, pitch².

    Returns:
        (U, f) shares from 0 to 1.
    """
    with np.errstate(invalid="ignore"):
        square = std * std
        unseen = (square - core * core) / (PRIOR_DOUBT - SMOOTH_SHARE)
        share = 1.0 - (square - (PRIOR_DOUBT - 1.0) * unseen) / prior_variance.reshape(std.shape)
        share[~(share > 0.0)] = 0.0
    return np.asarray(np.minimum(share, 1.0, out=share))
