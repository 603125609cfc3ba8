"""Prevents garbage collection and busy threads from delaying programs with deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Exclude objects that exist on entry from garbage collection for the duration of the block.

    With numba and canopen loaded, a full collection stops every thread for 30 ms on a small computer, long
    enough for a node to skip a scan or a host to delay a SYNC. Enter the block after all setup is done.
    Objects that exist on entry and become cyclic garbage are freed after the block.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def responsive_threads() -> Iterator[None]:
    """Make computing threads yield after 0.5 ms, not Python's default of 5 ms, for the duration of the block.

    With 5 ms, a thread that receives or draws could delay a scan by more than the time needed to solve it.
    """
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
