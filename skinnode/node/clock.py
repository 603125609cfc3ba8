"""Time in a node is a number handed in: nanoseconds of the monotonic clock of whoever drives it."""

from collections.abc import Callable
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Later than any time: nothing to wait for."""

Clock = Callable[[], int]
"""The time of the event that is being handled."""
