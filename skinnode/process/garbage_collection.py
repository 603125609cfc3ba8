"""Context managers that keep garbage collection and busy threads from delaying time-critical code."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_long_collections() -> Iterator[None]:
    """Exclude all existing objects from garbage collection during the ``with`` block.

    With numba and canopen loaded, a full collection stops all threads for 30 ms on a small computer, during
    which a node can miss a scan or a SYNC can be late. Enter the block once set-up is complete. Existing
    objects that become cyclic garbage during the block are freed after it.

    If the program has already excluded objects, with an outer block or with :func:`gc.freeze`, all objects
    stay excluded after the block, because the outer block may not have ended.
    """
    gc.collect()
    nested = gc.get_freeze_count() > 0
    gc.freeze()
    try:
        yield
    finally:
        if not nested:
            gc.unfreeze()


@contextmanager
def responsive_threads() -> Iterator[None]:
    """Set the thread switch interval to 0.5 ms during the ``with`` block.

    With Python's default of 5 ms, a thread that receives frames or updates the screen could delay the solver
    for longer than it takes to solve a scan.
    """
    kept = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(kept)
