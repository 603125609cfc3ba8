"""``skinnode bench``: the figures are there, complete, and of solvers that solved."""

from __future__ import annotations

import json

import matplotlib
import pytest
from typer.testing import CliRunner

from skinnode.bench.plots.ratios import draw_solve
from skinnode.cli.bench import app
from skinnode.solve.operators.codes import OPERATORS


def figures(tmp_path, name: str) -> tuple[str, dict]:
    file, plot = tmp_path / "figures.json", tmp_path / "figures.png"
    options = ["--rounds", "1", "--json", str(file), "--plot", str(plot)]
    result = CliRunner().invoke(app, [name, *options])
    assert result.exit_code == 0, result.output
    assert plot.read_bytes().startswith(b"\x89PNG")
    return result.output, json.loads(file.read_text(encoding="utf-8"))


@pytest.mark.release
def test_kernel_compares_with_numpy(tmp_path):
    output, data = figures(tmp_path, "kernel")
    peers: dict[str, set[str]] = {}
    for row in data["rows"]:
        peers.setdefault(row["what"], set()).add(row["who"])
        assert row["us"] > 0
        assert row["ratio"] > 0
        assert row["who"] in output
        assert row["ratio"] == 1.0 or row["who"] != "compiled"
    steps = [f"step of {o}" for o in ("gauss_newton", "levenberg_marquardt", "dogleg")]
    for what in ("F + J", *steps):
        assert peers[what] >= {"compiled", "NumPy, preallocated"}
    dense = {"LAPACK dpotrf", "BLAS dtrsm", "LAPACK dpotri", "NumPy matmul"}
    assert dense <= set.union(*peers.values())
    assert all("compiled" in names for names in peers.values())


@pytest.mark.long
def test_solve_compares_with_every_peer_at_the_same_accuracy(tmp_path):
    output, data = figures(tmp_path, "solve")
    who = [row["who"] for row in data["rows"]]
    for peer in ("root hybr", "root lm", "least_squares trf", "least_squares dogbox", "least_squares lm"):
        assert f"SciPy {peer}" in who
    assert sum(name.startswith("skinnode") for name in who) == len(OPERATORS) + 1
    for row in data["rows"]:
        if row["us"] is not None:
            assert row["error"] <= data["accuracy"] == 1e-9
        assert row["who"] in output


@pytest.mark.long
def test_node_tells_how_late_it_was_and_what_a_frame_costs(tmp_path):
    """That something was measured: times are no business of a test."""
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["node", "--seconds", "0.3", "--rounds", "1", "--json", str(file)])
    assert result.exit_code == 0, result.output
    data = json.loads(file.read_text(encoding="utf-8"))
    rows = {row["what"]: row for row in data["rows"]}
    assert rows["chunk pacing, exact"]["n"] >= 99  # of three scans of a hundred chunks
    assert rows["SYNC to first chunk, exact"]["n"] >= 1  # of three
    assert rows["heartbeat on an idle bus"]["load_hz"] == 0
    assert rows["heartbeat on a full bus"]["load_hz"] > 100
    assert rows["heartbeat on a full bus"]["n"] > 0
    assert all(row["p50_ms"] <= row["p99_ms"] <= row["max_ms"] for row in rows.values())
    assert {row["what"]: row["us"] > 0 for row in data["handling"]} == dict.fromkeys(
        ("frame of somebody else", "SDO upload", "RPDO", "remote request", "SYNC and 100 chunks"), True
    )
    assert "chunk pacing, exact" in result.output


@pytest.mark.long
def test_a_solver_that_misses_the_accuracy_is_drawn_without_a_time(tmp_path):
    file = tmp_path / "solve.svg"
    rows = [
        {"who": "skinnode dogleg", "us": 20.0, "ratio": 1.0, "error": 1e-12, "tolerance": 1e-8},
        {"who": "never there", "us": None, "ratio": None, "error": 1e-3, "tolerance": 1e-15},
    ]
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        draw_solve(file, {"machine": {"cores": "2"}, "accuracy": 1e-9, "rows": rows})
    text = file.read_text(encoding="utf-8")
    assert "never there" in text
    assert "accuracy not reached" in text
    assert "20.0 µs" in text


@pytest.mark.parametrize("name", ["kernel", "solve"])
@pytest.mark.parametrize("plot", ["figures.txt", "no_such_folder/figures.png"])
def test_bad_plot_files_are_refused_before_the_work(tmp_path, monkeypatch, name, plot):
    monkeypatch.setattr(f"skinnode.bench.{name}.run", lambda _: pytest.fail("the work was done"))
    result = CliRunner().invoke(app, [name, "--plot", str(tmp_path / plot)])
    assert result.exit_code != 0
    assert "--plot" in str(result.exception)


@pytest.mark.parametrize("rounds", ["0", "many"])
def test_bad_rounds_are_refused(rounds):
    result = CliRunner().invoke(app, ["kernel", "--rounds", rounds])
    assert result.exit_code == 2
