"""Checks whether frames arrive with an expected period.

A busy machine delays individual frames, so both mean and median are checked. A delayed frame lengthens one
interval and shortens the next, so the mean hardly changes. A few late frames do not change the median.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence

from skinnode.conformance.tester import Failed
from skinnode.transport import Frame


def gaps_ms(frames: Sequence[Frame]) -> list[float]:
    """Return the intervals between successive frames, ms."""
    return [(after.t_ns - before.t_ns) * 1e-6 for before, after in itertools.pairwise(frames)]


def check_period(frames: Sequence[Frame], period_ms: float, what: str, *, or_sooner: bool = False) -> None:
    """Raise Failed unless frames arrive with the period ``period_ms``.

    Args:
        frames: At least two frames.
        period_ms: Expected period, ms.
        what: Name of the frames, for the message.
        or_sooner: Whether events may trigger additional frames between the periodic frames.
    """
    gaps = gaps_ms(frames)
    mean, median = statistics.mean(gaps) / period_ms, statistics.median(gaps) / period_ms
    too_seldom = mean > 1.3 or median > 1.25
    too_often = (mean < 0.9 or median < 0.8) and not or_sooner
    if too_seldom or too_often:
        raise Failed(
            f"{what} every {period_ms:g} ms", f"gaps of {', '.join(f'{gap:.1f}' for gap in gaps)} ms"
        )
