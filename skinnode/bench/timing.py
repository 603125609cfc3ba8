"""Times functions in turn on a shared machine, and computes the ratios of their times within each round."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skinnode.files.output_file import write_text

ROUNDS: Final = 31
"""Default number of rounds; odd, so that the median is one of the measured times."""
TURN_S: Final = 4e-3
"""Duration of a function's turn in seconds: long compared with the clock resolution, short compared with a
burst of background load."""


@dataclass(frozen=True)
class Timing:
    """Median time per call (µs), and median ratio to the first function's time in the same round."""

    call_us: float
    ratio: float


def take_turns(candidates: Mapping[str, Callable[[], object]], *, rounds: int = ROUNDS) -> dict[str, Timing]:
    """Time every function in every round; return each function's median time and median ratio."""
    calls = {name: _calls_in_a_turn(function) for name, function in candidates.items()}
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, function in candidates.items():
            count = calls[name]
            start = time.perf_counter()
            for _ in range(count):
                function()
            times[name].append((time.perf_counter() - start) / count)
    reference = next(iter(times.values()))
    return {
        name: Timing(
            statistics.median(own) * 1e6,
            statistics.median(a / b for a, b in zip(own, reference, strict=True)),
        )
        for name, own in times.items()
    }


def _calls_in_a_turn(function: Callable[[], object]) -> int:
    function()  # the first call compiles kernels and fills caches
    start = time.perf_counter()
    function()
    return max(1, int(TURN_S / max(time.perf_counter() - start, 1e-7)))


def machine() -> dict[str, str]:
    """Return this machine's processor and the versions of the libraries."""
    import numba
    import numpy
    import scipy

    from skinnode import __version__

    return {
        "skinnode": __version__,
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "processor": _processor(),
        "cores": str(os.cpu_count()),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def write_json(path: Path, figures: dict[str, Any]) -> None:
    """Write benchmark results as indented JSON, with keys in their original order."""
    write_text("--json", path, json.dumps(figures, indent=2) + "\n")
