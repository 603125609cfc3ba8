"""Determine the pauses between retries of a failed operation, such as bringing up a node."""

from __future__ import annotations

import math
from typing import Final

from skinnode.process import clock

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 1.0
"""Initial and maximum pause (s) before a failed operation is retried. Each pause is twice the previous one,
up to the maximum.
"""


class Pause:
    """Sequence of increasing pauses between retries of a failed operation.

    The sequence restarts if a failure occurs more than ``longest_s`` after the end of the previous pause.
    """

    def __init__(self, first_s: float = FIRST_PAUSE_S, longest_s: float = LONGEST_PAUSE_S) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._pause_s = 0.0
        self._end_s = -math.inf

    def next_s(self) -> float:
        """Return the pause (s) before the next attempt. Call once per failure."""
        now_s = clock.monotonic()
        again = now_s <= self._end_s + self._longest_s
        self._pause_s = min(2 * self._pause_s, self._longest_s) if again else self._first_s
        self._end_s = now_s + self._pause_s
        return self._pause_s
