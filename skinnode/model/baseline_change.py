"""Compares a new baseline R0 with the old one: did something touch the skin during either tare?

Temperature, ageing and contact resistance change the readings of whole wires. A touch changes the readings of
a few crossings of several wires. The test therefore removes the median change of each wire.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from skinnode.model.layout import Float

LOCAL_CHANGE: Final = 0.002
"""Minimum relative change of a crossing that is attributed to a touch. In the model of the staggered preset,
a press of 10 % of the layer thickness over three pitches changes the most affected reading by 0.8 %."""

NOISES: Final = 8.0
"""The same minimum, in standard deviations estimated from the changes' median absolute deviation."""

LEAST_SHARE: Final = 0.01
"""Fraction of changed crossings above which a touch is reported. A smaller fraction probably results from
defects in individual crossings.

With a baseline noise of 2.5e-4, as for rubber, the test detects presses of 20 % of the layer thickness, but
not all presses of 10 %.
"""

TOUCHED: Final = "as if something touched the skin now or at the previous tare: clear the skin and tare again"
"""Explanation and advice in warnings."""


def touched_crossings(before_ohm: Float, after_ohm: Float) -> tuple[int, float]:
    """Return the number of crossings that changed as if touched, and the largest change among them.

    Args:
        before_ohm: (U, K) old baseline, in ohms.
        after_ohm: (U, K) new baseline, in ohms.

    Returns:
        The number of crossings whose relative changes differ from those of their two wires by more than both
        :data:`LOCAL_CHANGE` and :data:`NOISES` standard deviations, and the largest such difference. Both are
        0 if the fraction of such crossings is at most :data:`LEAST_SHARE`, or if no values can be compared.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.log(after_ohm / before_ohm)
    known = np.isfinite(change)
    if not known.any():
        return 0, 0.0
    change[~known] = np.nan
    for axis in (1, 0):
        left = np.isfinite(change).any(axis=axis, keepdims=True)
        filled = np.where(left, change, 0.0)
        change = filled - np.nanmedian(filled, axis=axis, keepdims=True)
    size = np.abs(np.where(known, change, 0.0))
    noise = 1.4826 * float(np.median(size[known]))
    count = int((size > max(LOCAL_CHANGE, NOISES * noise)).sum())
    if count <= LEAST_SHARE * known.sum():
        return 0, 0.0
    return count, float(np.expm1(size.max()))
