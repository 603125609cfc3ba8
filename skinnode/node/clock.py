"""Types and constants for the timing of a node.

All times are in ns and come from the caller's monotonic clock.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

NO_DEADLINE_NS: Final = 1 << 63
"""Deadline (ns) that is never reached; used when nothing is scheduled."""

Clock = Callable[[], int]
"""Callback that returns the time (ns) of the event being handled."""


@dataclass(frozen=True, slots=True)
class Pacing:
    """Timer precision of a node's thread. Higher precision requires more processor time."""

    slack_ns: int
    """Maximum time (ns) by which the thread may delay a timer, so that it can handle several timers per
    wake-up. Received frames are always handled immediately."""
    catch_up_ns: int
    """Maximum delay (ns) for which a node compensates by sending the next chunks earlier; 0 for a strict
    inhibit time. See :mod:`skinnode.node.patch.scan_stream`."""


EXACT: Final = Pacing(slack_ns=0, catch_up_ns=100_000)
"""Pacing for a node that runs on its own board; its thread wakes up for every chunk.

The interval between two chunks may be up to 100 µs shorter than the inhibit time, to compensate for wake-ups
that are up to 100 µs late.
"""

THRIFTY: Final = Pacing(slack_ns=2_000_000, catch_up_ns=50_000_000)
"""Pacing for many nodes on one computer.

The slack halves the processor load, because a node then sends several chunks per wake-up.

A kernel with 100 timer ticks per second wakes a thread 10 to 20 ms late, or later if the computer is busy. In
a test with such a kernel, nodes with a ``catch_up_ns`` of 10 ms skipped a third of their scans, and nodes
with 50 ms skipped no scans. The mean frame rate does not depend on ``catch_up_ns``. However, after a delay of
50 ms, a node sends all chunks of these 50 ms in one burst.
"""
