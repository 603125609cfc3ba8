"""Time in a node is a number handed in: nanoseconds of the monotonic clock of whoever drives it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Later than any time: nothing to wait for."""

Clock = Callable[[], int]
"""The time of the event that is being handled."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """How closely the thread that drives a node keeps to its timers, against what that costs."""

    slack_ns: int
    """How late timers may be, so that one waking serves several. Frames are served at once whatever it is."""
    catch_up_ns: int
    """Lateness that the pace of chunks makes up for; 0 for a strict inhibit time. See
    :mod:`skinnode.node.stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""For a board. The thread wakes for every chunk. Distances fall short of the inhibit time by one of its units
at most, so that a scan is lengthened by wakings later than that, and not by every one."""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=10_000_000)
"""For many nodes on one machine. Four at 0.6 ms a chunk, 12.5 scans/s, take 13 % of a core of a small machine
when the thread wakes for every chunk and 7 % with 2 ms; a bus sees bursts of three frames a node for it, and
of 15 where the interpreter has been away for two of its switch intervals. The mean pace is unchanged."""
