"""Pauses between retries of an operation that fails: bring-up of a node, opening a bus, a failing thread."""

from __future__ import annotations

import math
from typing import Final

from skinnode.process import clock

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 1.0
"""First and longest pause before a failed operation is retried, in s; each pause is twice the previous
pause."""


class Pause:
    """Sequence of increasing pauses between retries of an operation, s.

    Once the operation has worked for as long as the longest pause, the sequence starts again.
    """

    def __init__(self, first_s: float = FIRST_PAUSE_S, longest_s: float = LONGEST_PAUSE_S) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._pause_s = 0.0
        self._end_s = -math.inf

    def next_s(self) -> float:
        """Return the length of the pause that starts now, before the next attempt."""
        now_s = clock.monotonic()
        again = now_s <= self._end_s + self._longest_s
        self._pause_s = min(2 * self._pause_s, self._longest_s) if again else self._first_s
        self._end_s = now_s + self._pause_s
        return self._pause_s
