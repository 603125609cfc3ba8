"""Measures the memory that the process occupies."""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path


def resident_mb() -> float:
    """Return the resident memory of the process, MB, after all unused memory has been freed. Linux only."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
    if trim is not None:
        trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
