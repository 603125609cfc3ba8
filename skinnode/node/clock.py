"""Types and constants for time in a node. The caller passes times in ns, on its own monotonic clock."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Deadline that is never reached, ns; it means that nothing is scheduled."""

Clock = Callable[[], int]
"""Callback that returns the time of the event being handled, ns."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """Timer precision of a node's thread; higher precision needs more processor time."""

    slack_ns: int
    """Maximum intended delay of a timer, ns. A delay allows one wake-up of the thread to serve several
    timers. Received frames are always served immediately."""
    catch_up_ns: int
    """Maximum delay of chunks that subsequent chunks make up for, ns; 0 for a strict inhibit time. See
    :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing for a node on its own board, whose thread wakes up for every chunk.

The interval between two chunks may be up to 100 µs shorter than the inhibit time. A scan therefore takes
longer than planned only if a wake-up is more than 100 µs late.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing for many nodes on one computer.

With 0.6 ms per chunk and 12.5 scans/s, four nodes on a small computer use 13 % of one core if the thread
wakes up for every chunk. With 2 ms of slack, they use 7 %, and each node sends bursts of three frames.

A kernel with 100 timer ticks per second wakes a thread 10 to 20 ms late, and even later if the computer is
busy. With a ``catch_up_ns`` of 10 ms, nodes in a User Mode Linux guest skipped a third of their scans at 10
scans/s and reported overruns (0x8110). With 50 ms, they skipped no scans. The mean pace stays the same, but a
thread that was delayed by 50 ms sends the chunks of 50 ms in one burst.
"""
