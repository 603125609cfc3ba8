"""Count the calls of Python functions per patch and scan of a hand at rest, for docs/performance.md.

Run with ``python docs/calls_at_rest.py``; it takes about two minutes. Sixteen simulated patches send only
changed chunks to a host, in virtual time. Calls of functions written in C or compiled by Numba are not
counted.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from types import CodeType, FrameType
from typing import Final

from skinnode.bench.scale import FIXED, measure

FEW: Final = 50
MANY: Final = 150
SHOWN: Final = 5


def calls_of(scans: int) -> Counter[CodeType]:
    """Return how often each function is called while a hand is started, measured and stopped."""
    found: Counter[CodeType] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            found[frame.f_code] += 1

    threading.setprofile(count)
    sys.setprofile(count)
    try:
        measure(FIXED, 0, scans, changed_only=True)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return found


def main() -> None:
    calls_of(FEW)  # fills the caches
    calls = calls_of(MANY)
    calls.subtract(calls_of(FEW))
    each = 1.0 / (2 * (MANY - FEW) * FIXED)  # measure() runs for twice the number of scans
    print(f"{calls.total() * each:.0f} calls per patch and scan; most often:")
    for code, number in calls.most_common(SHOWN):
        print(f"{number * each:6.1f}  {code.co_qualname}")


if __name__ == "__main__":
    main()
