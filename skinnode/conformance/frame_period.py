"""Checks that frames arrive at an expected period.

The check must tolerate individual frames that a busy machine receives late. A late frame lengthens one
interval and shortens the next, so it hardly changes the mean, and a few late frames do not change the median.
The check therefore uses the mean and the median of the intervals.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence

from skinnode.conformance.tester import Failed
from skinnode.transport import Frame


def gaps_ms(frames: Sequence[Frame]) -> list[float]:
    """Return the intervals between successive frames, in ms."""
    return [(after.t_ns - before.t_ns) * 1e-6 for before, after in itertools.pairwise(frames)]


def check_period(frames: Sequence[Frame], period_ms: float, what: str, *, or_sooner: bool = False) -> None:
    """Raise Failed unless the period of the frames is ``period_ms``.

    Args:
        frames: At least two frames.
        period_ms: Expected period, in ms.
        what: Description of the frames, for the message.
        or_sooner: Whether shorter intervals are allowed, because events trigger additional frames.
    """
    gaps = gaps_ms(frames)
    mean, median = statistics.mean(gaps) / period_ms, statistics.median(gaps) / period_ms
    too_seldom = mean > 1.3 or median > 1.25
    too_often = (mean < 0.9 or median < 0.8) and not or_sooner
    if too_seldom or too_often:
        raise Failed(
            f"{what} every {period_ms:g} ms", f"gaps of {', '.join(f'{gap:.1f}' for gap in gaps)} ms"
        )
