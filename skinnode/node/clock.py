"""Time in a node: a number that the caller passes in, ns of the caller's monotonic clock."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Time later than any other: there is nothing to wait for."""

Clock = Callable[[], int]
"""Returns the time of the event being handled, ns."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """How closely a node's thread keeps to its timers: precision against processor time."""

    slack_ns: int
    """Maximum lateness of a timer, ns, so that one wake-up serves several. Frames are always served at once.
    """
    catch_up_ns: int
    """Lateness for which the pace of chunks compensates, ns; 0 for a strict inhibit time. See
    :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing of a board: the thread wakes for every chunk.

The distance of two chunks is at most one unit (100 µs) shorter than the inhibit time, so that only later
wake-ups lengthen a scan.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing of many nodes on one machine.

Four nodes at 0.6 ms a chunk, 12.5 scans/s, take 13 % of a core of a small machine if the thread wakes for
every chunk, and 7 % with 2 ms of slack; the bus then sees bursts of three frames a node.

A kernel with 100 timer ticks a second wakes a thread 10 to 20 ms late, and a busy machine later still. At
10 ms of catching up, nodes in a User Mode Linux guest skipped a third of their scans at 10 scans/s and kept
reporting an overrun (0x8110); at 50 ms they skip none. The mean pace is unchanged; a thread that was held up
for 50 ms sends 50 ms of chunks in one burst.
"""
