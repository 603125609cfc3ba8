"""Types and constants for the timing of a node. Times are in ns, on the caller's monotonic clock."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Deadline in ns if nothing is scheduled. It is never reached."""

Clock = Callable[[], int]
"""Callback that returns the time (ns) of the event being handled."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """Timer precision of a node's thread. Higher precision costs more processor time."""

    slack_ns: int
    """Maximum time (ns) by which a timer may be delayed so that one wake-up serves several timers. Received
    frames are never delayed."""
    catch_up_ns: int
    """Maximum delay (ns) that the node makes up by sending later chunks sooner; 0 for a strict inhibit time.
    See :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing for a node on its own board. The thread wakes up for every chunk.

To make up for late wake-ups, the interval between two chunks can be up to 100 µs shorter than the inhibit
time.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing for many nodes on one computer.

The slack halves the processor load, because a node sends several chunks per wake-up. A kernel with 100 timer
ticks per second wakes a thread 10 to 20 ms late, or later if the computer is busy. In a test on such a
kernel, nodes skipped a third of their scans with a ``catch_up_ns`` of 10 ms, but none with 50 ms. After a
delay of 50 ms, a node sends all overdue chunks in one burst.
"""
