"""Compares the speed and error of the posterior and of the exact inverse with and without data tests."""

from __future__ import annotations

import time
import zlib
from typing import Any, Final

import numpy as np

from skinnode.bench.trust_loads import LOADS, draw
from skinnode.bench.trust_score import deviations
from skinnode.bench.trust_signal import SCALE, CodeStream, Setting, Timeline, make
from skinnode.bench.trust_solver import host_patch
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.inputs import CodeMap

SETTING: Final = Setting("staggered", 0.5, 1e-5)
METHODS: Final = ("exact, no tests", "exact", "posterior")


def rows(seed: int) -> list[dict[str, Any]]:
    """Solve the same streams with each method; return one row of times and errors per method."""
    times: dict[str, list[float]] = {name: [] for name in METHODS}
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    worst = dict.fromkeys(METHODS, 0.0)
    for number, kind in enumerate(LOADS):
        rng = np.random.default_rng([seed, zlib.crc32(b"speed"), number])
        taken = make(SETTING, draw(kind, SETTING.layout(), rng), (), rng, Timeline())
        for name in METHODS:
            for t, (field, spent_s) in enumerate(_fields(name, taken)):
                if not taken.touched[t]:
                    continue
                truth = taken.truth_m[t]
                times[name].append(spent_s)
                errors[name].append(
                    float(np.linalg.norm(field.displacement_m - truth) / np.linalg.norm(truth))
                )
                worst[name] = max(worst[name], float(deviations(field, truth).max()))
    return [
        {
            "method": name,
            "p50_ms": 1e3 * float(np.median(times[name])),
            "p99_ms": 1e3 * float(np.percentile(times[name], 99)),
            "error": float(np.median(errors[name])),
            "worst_deviations": worst[name],
        }
        for name in METHODS
    ]


def _fields(name: str, taken: CodeStream) -> list[tuple[Any, float]]:
    """Solve every scan of a stream; return the fields and the solve times (s)."""
    found = []
    if name == METHODS[0]:
        bare = _bare(taken)
        for codes in taken.codes:
            start = time.perf_counter()
            field = bare.update_codes(codes)
            found.append((field, time.perf_counter() - start))
        return found
    patch = host_patch(taken, method=name)
    for number, codes in enumerate(taken.codes):
        start = time.perf_counter()
        field = patch.field(codes, number, 1 + number % 3)
        found.append((field, time.perf_counter() - start))
    return found


def _bare(taken: CodeStream) -> ExactTracker:
    scale = SCALE
    codes = CodeMap(
        baseline_ohm=taken.baseline_ohm,
        lo=scale.lo,
        step=scale.step,
        steps=scale.steps,
        rounding_ohm=scale.relative_std * taken.baseline_ohm,
        relative_noise=taken.stated_noise,
        gain=None,
    )
    return ExactTracker(
        taken.layout,
        operator="dogleg",
        relative_noise=taken.stated_noise,
        baseline_ohm=taken.baseline_ohm,
        codes=codes,
    )


def text(row: dict[str, Any]) -> str:
    """Format a row of the table."""
    return (
        f"  {row['method']:20}{row['p50_ms']:9.2f}{row['p99_ms']:9.2f}{100 * row['error']:9.2f}%"
        f"{row['worst_deviations']:9.3g}"
    )


HEAD: Final = f"  {'':20}{'p50 ms':>9}{'p99 ms':>9}{'error':>10}{'worst':>9}"
