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
    :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""For a board. The thread wakes for every chunk. Distances fall short of the inhibit time by one of its units
at most, so that a scan is lengthened by wakings later than that, and not by every one."""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""For many nodes on one machine. Four at 0.6 ms a chunk, 12.5 scans/s, take 13 % of a core of a small machine
when the thread wakes for every chunk and 7 % with 2 ms; a bus sees bursts of three frames a node for it.

A kernel with 100 timer ticks a second wakes a thread 10 to 20 ms late, and a busy machine later still. At
10 ms of catching up, nodes in a User Mode Linux guest skipped a third of their scans at 10 scans/s and kept
reporting an overrun (0x8110); at 50 ms they skip none. The mean pace is unchanged; a thread that was away for
50 ms sends 50 ms of chunks in one burst."""
