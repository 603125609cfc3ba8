"""Starves a soak test of CPU time with child processes that run busy loops."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Final

_NICE: Final = -5
"""Nice value of the child processes. A child process that is not permitted to set it inherits the parent's
nice value."""
_CHILDREN_PER_PROCESSOR: Final = 3
_LONGEST_S: Final = 30.0
"""Maximum lifetime of a child process, in s. A child also exits when its parent has exited."""

_BUSY: Final = """
import os, sys, time
parent, end_s = os.getppid(), time.monotonic() + float(sys.argv[1])
while time.monotonic() < end_s and os.getppid() == parent:
    for _ in range(100_000):
        pass
"""


@contextlib.contextmanager
def starved_processor() -> Iterator[int]:
    """Keep all processors busy during the ``with`` block. Yields the number of child processes."""
    count = _CHILDREN_PER_PROCESSOR * len(os.sched_getaffinity(0))
    children: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            command = [sys.executable, "-S", "-c", _BUSY, str(_LONGEST_S)]
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL)
            children.append(child)
            with contextlib.suppress(OSError):  # an ordinary user may not increase a process's priority
                os.setpriority(os.PRIO_PROCESS, child.pid, _NICE)
        yield count
    finally:
        for child in children:
            child.kill()
        for child in children:
            child.wait()
