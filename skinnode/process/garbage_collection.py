"""Prevents garbage collection and busy threads from delaying programs with deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Exclude objects that exist on entry from garbage collection for the duration of the block.

    If numba and canopen are loaded, a full collection on a small computer stops every thread for 30 ms. A
    node could then miss a scan, or a host could delay a SYNC. Enter the block after all setup has been
    completed. Objects that exist on entry and become cyclic garbage are freed only after the block.
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

    With the default, a thread that receives frames or updates the screen could delay a scan for longer than
    its solution takes.
    """
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
