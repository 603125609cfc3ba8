"""Prevents garbage collection and busy threads from delaying time-critical code."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Exclude all objects that exist on entry to the ``with`` block from garbage collection during the block.

    With numba and canopen loaded, a full garbage collection on a small computer stops all threads for 30 ms.
    During the pause, a node can miss a scan, or the host's SYNC can be delayed. Enter the ``with`` block
    after setup is complete. Objects that exist on entry and become cyclic garbage are freed only after the
    block.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def responsive_threads() -> Iterator[None]:
    """Set Python's thread switch interval to 0.5 ms for the duration of the block; the default is 5 ms.

    At the default interval, a thread that receives frames or updates the screen could delay the solver by
    more time than the solver needs for a scan.
    """
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
