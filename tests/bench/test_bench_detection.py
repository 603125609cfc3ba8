"""``skinnode bench accuracy --only detection``: every table, lines judged as they say."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from skinnode.bench import accuracy_detection as bench
from skinnode.cli.bench import app


def test_lines_are_judged_by_their_limits() -> None:
    load = {"layout": "staggered", "height": 0.5, "drift": "steady", "depth": 0.02}
    rest = {"noise": 1e-3, "drift": "none", "set_per_hour": 1.0, "hours": 100.0}
    figures = {
        "found": [
            load | {"kind": "blunt sphere", "within": [0.1, 0.5, 0.96, 0.99]},
            load | {"kind": "blunt sphere", "within": [0.1, 0.5, 0.94, 0.99]},
            load | {"kind": "small sphere", "within": [0.0, 0.0, 0.0, 0.0]},  # not required
        ],
        "alarms": [rest | {"alarms": 120}, rest | {"alarms": 140}],
        "slow": [{"what": "held press", "depth": 0.02, "drift": "walk", "kept": False}],
        "time": {"mean_us": 19.0},
    }
    must = bench.requirements(figures)
    assert [row["reached"] for row in must] == [True, False, True, False, False, True]
    assert [row["absolute"] for row in must] == 5 * [False] + [True]


@pytest.mark.long
def test_the_command_prints_and_writes_every_table(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(bench, "LAYOUTS", (("staggered", 0.5),))
    monkeypatch.setattr(bench, "DRIFTS", ("steady",))
    monkeypatch.setattr(bench, "FAMILIES", (("blunt sphere", 0.02), ("small sphere", 0.02), ("dent", 0.05)))
    monkeypatch.setattr(bench, "RAMPS_S", (1.0,))
    monkeypatch.setattr(bench, "HOLD_S", 20.0)
    file, picture = tmp_path / "figures.json", tmp_path / "roc.png"
    options = ["--only", "detection", "--seed", "2", "--presses", "8", "--hours", "0.05"]
    result = CliRunner().invoke(app, ["accuracy", *options, "--json", str(file), "--plot", str(picture)])
    figures = json.loads(file.read_text(encoding="utf-8"))
    reached = all(row["reached"] for row in figures["must"] if not row["absolute"])
    assert result.exit_code == (0 if reached else 1), result.output
    assert picture.stat().st_size > 10_000
    sphere, small, dent = figures["found"]
    assert sphere["within"][2] == dent["within"][2] == 1.0
    assert small["within"][2] < 0.5
    assert small["signal"] < bench.REACHABLE < sphere["signal"]
    for row in figures["roc"]:
        assert row["known load"] == sorted(row["known load"])
        assert row["one frame"] == sorted(row["one frame"])
    for row in figures["must"]:
        assert row["what"] in result.output
