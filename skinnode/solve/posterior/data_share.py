"""Data share: fraction of an estimated displacement that is determined by the frame, not by the prior."""

from __future__ import annotations

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.posterior.load_prior import LoadPrior


def data_share(std: Float, core: Float, prior: LoadPrior) -> Float:
    """Return 1 minus the ratio of the posterior variance to the prior variance; 0 where ``std`` is infinite.

    ``std``² exceeds the posterior variance, because it contains :attr:`LoadPrior.doubt` times the part that
    depends on the prior. ``core``² contains :attr:`LoadPrior.smooth_share` times the same part. The part that
    depends on the prior therefore follows from ``std``² − ``core``².

    Args:
        std: (U, f) standard deviations, in pitches.
        core: (U, f) standard deviations for the 95 % interval, in pitches.
        prior: Prior of the displacement.

    Returns:
        (U, f) data shares, from 0 to 1.
    """
    variance = prior.scale2 * prior.covariance.diagonal()
    with np.errstate(invalid="ignore"):
        square = std * std
        unseen = (square - core * core) / (prior.doubt - prior.smooth_share)
        share = 1.0 - (square - (prior.doubt - 1.0) * unseen) / variance.reshape(std.shape)
        share[~(share > 0.0)] = 0.0
    return np.asarray(np.minimum(share, 1.0, out=share))
