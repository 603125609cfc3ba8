"""Measures the process's memory use."""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path


def resident_mb() -> float:
    """Free all unused memory and return the process's resident memory (MB). Linux only."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
    if trim is not None:
        trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
