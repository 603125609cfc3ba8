"""What the benchmarks share: a clock, rows of figures, how they are shown and written."""

from __future__ import annotations

import dataclasses
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from skinnode.cli._files import plain
from skinnode.model.layout import Float, PatchLayout


@dataclass(frozen=True, slots=True)
class Clock:
    """Times a call: the shortest of ``repeat`` runs of a few milliseconds each, so that what else the machine
    does counts as little as it can."""

    repeat: int
    run_s: float = 2e-3

    def microseconds(self, call: Callable[[], object]) -> float:
        """Time of one ``call`` in µs."""
        call()
        start = time.perf_counter()
        call()
        once_s = max(time.perf_counter() - start, 1e-7)
        number = max(1, int(self.run_s / once_s))
        shortest = float("inf")
        for _ in range(self.repeat):
            start = time.perf_counter()
            for _ in range(number):
                call()
            shortest = min(shortest, (time.perf_counter() - start) / number)
        return 1e6 * shortest


@dataclass(frozen=True, slots=True)
class Row:
    """One measured case. NaN where a figure does not apply."""

    what: str
    time_us: float
    ratio: float
    """Time over that of the case this row is compared with."""
    error: float = float("nan")
    """Relative, as the benchmark's note says."""
    evaluations: float = float("nan")
    status: str = ""


@dataclass(frozen=True, slots=True)
class Result:
    """A benchmark's figures."""

    benchmark: str
    note: str
    rows: tuple[Row, ...]
    verdicts: tuple[str, ...]
    """The ratios this project sets itself, as measured."""


def press_m(layout: PatchLayout, depth: float, centre: tuple[float, float], shear: float = 0.3) -> Float:
    """(U, N, 3) a smooth press ``depth`` heights deep, half width two pitches, for timing only."""
    away = layout.upper_m[..., :2] - np.array(centre)
    sunk = depth * layout.height_m / (1.0 + (away**2).sum(axis=-1) / (2 * layout.pitch_m) ** 2)
    return np.stack([shear * sunk, -0.5 * shear * sunk, -sunk], axis=-1)


def show(result: Result, console: Console) -> None:
    """A table and the verdicts."""
    console.print(f"{result.benchmark}: {result.note}", soft_wrap=True)
    columns = ["µs", "ratio"]
    errors = not all(np.isnan(row.error) for row in result.rows)
    statuses = any(row.status for row in result.rows)
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("")
    for column in [*columns, *(["error", "evaluations"] if errors else [])]:
        table.add_column(column, justify="right")
    if statuses:
        table.add_column("status")
    for row in result.rows:
        cells = [row.what, f"{row.time_us:.1f}", f"{row.ratio:.2f}"]
        if errors:
            cells += [_figure(row.error, ".1e"), _figure(row.evaluations, ".1f")]
        if statuses:
            cells.append(row.status)
        table.add_row(*cells)
    console.print(table)
    for verdict in result.verdicts:
        console.print(verdict, soft_wrap=True)


def _figure(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


def as_json(result: Result) -> dict[str, Any]:
    """The figures with what they were measured on."""
    machine = {
        "processor": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("skinnode", "numpy", "scipy", "numba", "pyceres")},
    }
    figures: dict[str, Any] = plain({"machine": machine, **dataclasses.asdict(result)})
    return figures


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
