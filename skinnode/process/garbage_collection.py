"""Keeps garbage collection and busy threads from delaying a program with deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Make garbage collection skip the objects that exist on entry, for the length of the block.

    The objects that numba and canopen load make a full collection take 30 ms on a small computer, and it
    stops every thread: long enough for a node to skip a scan or a host to delay a SYNC. Enter the block when
    all is set up. Objects that exist on entry and become cyclic garbage are freed after the block.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def responsive_threads() -> Iterator[None]:
    """Make a computing thread give way after 0.5 ms instead of Python's 5 ms, for the length of the block.

    With 5 ms, a thread that receives or draws could delay a scan for longer than solving it takes.
    """
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
