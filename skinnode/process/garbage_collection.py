"""Keeps Python's garbage collector, and threads each other, from holding up a program with deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Within the block, collections do not walk through the objects that exist at its begin.

    What numba and canopen load makes a full collection take 30 ms of a small machine, with every thread
    stopped: long enough for a node to skip a scan, or a host a SYNC. Enter it when all is set up. What exists
    by then and becomes garbage in a cycle stays until the end of the block.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def responsive_threads() -> Iterator[None]:
    """Within the block, a thread that computes lets another in after half a millisecond. At Python's 5 ms one
    that receives, or draws, could hold up a scan for longer than it takes to solve."""
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
