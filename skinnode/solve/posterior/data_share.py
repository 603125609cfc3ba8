"""Data share: fraction of an estimated displacement that is determined by the frame, not by the prior."""

from __future__ import annotations

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.posterior.load_prior import PRIOR_DOUBT, SMOOTH_SHARE


def data_share(std: Float, core: Float, prior_variance: Float) -> Float:
    """Return 1 minus the ratio of the posterior variance to the prior variance; 0 where ``std`` is infinite.

    ``std``² exceeds the posterior variance, because it contains :data:`PRIOR_DOUBT` times the part that
    depends on the prior. ``core``² contains :data:`SMOOTH_SHARE` times the same part. The part that depends
    on the prior therefore follows from ``std``² − ``core``².

    Args:
        std: (U, f) standard deviations, pitches.
        core: (U, f) standard deviations for the 95 % interval, pitches.
        prior_variance: (U f,) prior variances, pitch².

    Returns:
        (U, f) data shares, from 0 to 1.
    """
    with np.errstate(invalid="ignore"):
        square = std * std
        unseen = (square - core * core) / (PRIOR_DOUBT - SMOOTH_SHARE)
        share = 1.0 - (square - (PRIOR_DOUBT - 1.0) * unseen) / prior_variance.reshape(std.shape)
        share[~(share > 0.0)] = 0.0
    return np.asarray(np.minimum(share, 1.0, out=share))
