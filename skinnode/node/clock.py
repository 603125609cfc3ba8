"""Types and constants for the timing of a node.

All times are in ns and come from the caller's monotonic clock.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Value (ns) of a deadline when nothing is scheduled; it is never reached."""

Clock = Callable[[], int]
"""Callback that returns the time (ns) of the event being handled."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """Timer precision of a node's thread. A higher precision requires more processor time."""

    slack_ns: int
    """Maximum intended delay of a timer, ns. Delaying timers allows the thread to handle several timers per
    wake-up. Received frames are always handled immediately."""
    catch_up_ns: int
    """Maximum delay (ns) that a node makes up for by sending the subsequent chunks earlier; 0 for a strict
    inhibit time. See :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing for a node on its own board, whose thread wakes up for every chunk.

The interval between two chunks may be up to 100 µs shorter than the inhibit time. A scan therefore takes
longer than planned only if a wake-up is more than 100 µs late.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing for many nodes on one computer.

With 0.6 ms per chunk and 12.5 scans/s, four nodes on a small computer use 13 % of one core if the thread
wakes up for every chunk. With 2 ms of slack, the four nodes use 7 %, and each node sends its frames in bursts
of three.

A kernel with 100 timer ticks per second wakes a thread 10 to 20 ms late, or later if the computer is busy.
With a ``catch_up_ns`` of 10 ms, nodes in a User Mode Linux guest skipped a third of their scans at 10 scans/s
and reported overruns (0x8110). With a ``catch_up_ns`` of 50 ms, the nodes skipped no scans. The mean frame
rate stays the same, but after a delay of 50 ms, the thread sends all chunks of these 50 ms in one burst.
"""
