"""The comparison of two commits sees every difference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tools.compare.__main__ import report
from tools.compare.speed import rows_of

OLD = {
    "a: x: position": np.array([1.0, np.nan, -4.0]),
    "a: x: status": np.array([0, 1]),
    "b: y: z": np.zeros(2),
}


def compared(tmp_path: Path, new: dict[str, Any], rtol: float = 0.0) -> tuple[list[str], bool]:
    for name, arrays in (("old", OLD), ("new", new)):
        np.savez(tmp_path / f"{name}.npz", **arrays)
    lines = list(report(np.load(tmp_path / "old.npz"), np.load(tmp_path / "new.npz"), rtol))
    return [line for line, _ in lines], all(allowed for _, allowed in lines)


def test_equal(tmp_path: Path) -> None:
    lines, fine = compared(tmp_path, dict(OLD))
    assert fine
    assert [line.split()[0] for line in lines] == ["a", "b"]
    assert all(line.endswith("equal") and line.split()[3] == line.split()[4] for line in lines)


LAST_BIT = {**OLD, "a: x: position": np.array([1.0, np.nan, np.nextafter(-4.0, 0.0)])}
ELSEWHERE_NAN = {**OLD, "a: x: position": np.array([np.nan, 1.0, -4.0])}
ANOTHER_STATUS = {**OLD, "a: x: status": np.array([0, 2])}
ANOTHER_TYPE = {**OLD, "b: y: z": np.zeros(2, np.float32)}
NEGATIVE_ZERO = {**OLD, "b: y: z": -np.zeros(2)}
LESS = {name: array for name, array in OLD.items() if name != "b: y: z"}
MORE = {**OLD, "b: y: more": np.zeros(1)}


@pytest.mark.parametrize(
    "new", [LAST_BIT, ELSEWHERE_NAN, ANOTHER_STATUS, ANOTHER_TYPE, LESS, MORE, NEGATIVE_ZERO]
)
def test_a_difference_is_named(tmp_path: Path, new: dict[str, Any]) -> None:
    lines, fine = compared(tmp_path, new)
    assert not fine
    assert sum("1 differ" in line for line in lines) == 1
    assert sum(line.startswith("  ") for line in lines) == 1


@pytest.mark.parametrize(
    ("new", "allowed"), [(LAST_BIT, True), (ELSEWHERE_NAN, False), (ANOTHER_STATUS, False), (LESS, False)]
)
def test_a_tolerance_is_of_finite_floats(tmp_path: Path, new: dict[str, Any], allowed: bool) -> None:
    assert compared(tmp_path, new, 1e-12)[1] is allowed


def test_every_time_of_a_report_is_compared() -> None:
    """Rows by their names, times further down by their place; nothing that describes the machine."""
    times = rows_of(
        {
            "benchmark": "path",
            "machine": {"tick_us": 1.0},
            "rows": [{"name": "step", "compiled_us": 2.0, "error": 1e-9}],
            "settings": [{"layout": "aligned", "operators": {"dogleg": [{"runtime_ms": 3.0}]}}],
            "buses": [{"published_ms": {"p50": 4.0, "p99": 5.0}}],
        }
    )
    assert times == {
        "step compiled_us": 2.0,
        "settings 0 operators dogleg 0 runtime_ms": 3.0,
        "buses 0 published_ms p50": 4.0,
        "buses 0 published_ms p99": 5.0,
    }
