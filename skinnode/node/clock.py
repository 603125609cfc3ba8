"""Time in a node, passed in by the caller as nanoseconds on the caller's monotonic clock."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Deadline (ns) later than any other, meaning that nothing is scheduled."""

Clock = Callable[[], int]
"""Callback that returns the time of the event being handled, ns."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """Timer precision of a node's thread, traded against processor time."""

    slack_ns: int
    """Permitted lateness of a timer, ns; it lets one wake-up serve several timers. Frames are always
    served immediately."""
    catch_up_ns: int
    """Maximum lateness for which the chunk pacing compensates, ns; 0 for a strict inhibit time. See
    :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing for a board, whose thread wakes for every chunk.

The interval between two chunks is at most one unit (100 µs) shorter than the inhibit time, so a scan takes
longer than planned only if a wake-up is more than 100 µs late.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing for many nodes on one machine.

Four nodes at 0.6 ms per chunk and 12.5 scans/s use 13 % of one core of a small machine if the thread wakes
for every chunk, and 7 % with 2 ms of slack. With the slack, each node sends bursts of three frames.

A kernel with 100 timer ticks per second wakes a thread 10 to 20 ms late, and even later on a busy machine.
With ``catch_up_ns`` at 10 ms, nodes in a User Mode Linux guest skipped a third of their scans at 10 scans/s
and kept reporting an overrun (0x8110). At 50 ms, they did not skip any. The mean pace is unchanged, but a
thread that was delayed by 50 ms sends 50 ms of chunks in one burst.
"""
