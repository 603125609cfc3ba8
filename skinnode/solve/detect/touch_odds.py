"""Odds of touch versus no touch, updated by Bayes' rule in each frame, for an occasionally touched patch."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.detect.touch_statistic import DEPTH, MOST_OCTAVES, SHALLOWEST, Statistic

DEEPEST: Final = 0.16
"""Maximum RMS normal displacement considered in the odds, as a multiple of the layer height."""
TOUCHES_PER_S: Final = 1.0 / 60.0
"""Prior rate of touches, in 1/s."""
TOUCH_S: Final = 1.0
"""Prior mean duration of a touch, in s."""


def octaves_for(noise: float) -> int:
    """Return the number of octaves of depth considered in the odds at the relative noise ``noise``."""
    most = math.log2(DEEPEST / (DEPTH * noise * SHALLOWEST))
    return min(1 + max(int(most), 0), MOST_OCTAVES)


def log_likelihood_ratio(statistic: Statistic, octaves: int, z: Float) -> float:
    """Return a frame's log likelihood ratio of touch versus no touch, given its z (r,) from ``statistic``.

    All ``octaves`` of depth are equally likely.
    """
    terms = 0.5 * (statistic.shares[:octaves] @ (z * z) - statistic.log_dets[:octaves])
    most = float(terms.max())
    return most + math.log(float(np.exp(terms - most).sum()) / octaves)


def next_log_odds(log_odds: float, log_ratio: float, period_s: float) -> float:
    """Return the log odds after a frame, by Bayes' rule for a two-state Markov chain.

    Args:
        log_odds: Log odds before the frame.
        log_ratio: Log likelihood ratio of touch to no touch for the frame.
        period_s: Scan period, in s.
    """
    begins, ends = min(TOUCHES_PER_S * period_s, 0.5), min(period_s / TOUCH_S, 0.5)
    odds = bounded_exp(log_odds)
    prior = (1.0 - ends) / ends
    if odds < math.inf:
        prior = (odds * (1.0 - ends) + begins) / (odds * ends + 1.0 - begins)
    return log_ratio + math.log(prior)


def bounded_exp(value: float) -> float:
    """Return exp(value), or inf on overflow."""
    return math.exp(value) if value < 700.0 else math.inf
