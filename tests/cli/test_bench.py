"""``skinnode bench``: the figures are there, complete, and of solvers that solved."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from skinnode.cli.bench import app


def figures(tmp_path, name: str) -> tuple[str, dict]:
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(app, [name, "--rounds", "1", "--json", str(file)])
    assert result.exit_code == 0, result.output
    return result.output, json.loads(file.read_text(encoding="utf-8"))


def test_kernel_compares_with_numpy(tmp_path):
    output, data = figures(tmp_path, "kernel")
    what = {row["what"] for row in data["rows"]}
    assert what == {"F + J", *(f"step of {o}" for o in ("gauss_newton", "levenberg_marquardt", "dogleg"))}
    for row in data["rows"]:
        assert row["us"] > 0
        assert row["ratio"] > 0
        assert row["who"] in output
    assert [row["ratio"] for row in data["rows"] if row["who"] == "compiled"] == [1.0] * 4


def test_solve_compares_with_every_peer_at_the_same_accuracy(tmp_path):
    output, data = figures(tmp_path, "solve")
    who = [row["who"] for row in data["rows"]]
    for peer in ("root hybr", "root lm", "least_squares trf", "least_squares dogbox", "least_squares lm"):
        assert f"SciPy {peer}" in who
    assert sum(name.startswith("skinnode") for name in who) == 4
    for row in data["rows"]:
        if row["us"] is not None:
            assert row["error"] <= data["accuracy"] == 1e-9
        assert row["who"] in output


@pytest.mark.parametrize("rounds", ["0", "many"])
def test_bad_rounds_are_refused(rounds):
    result = CliRunner().invoke(app, ["kernel", "--rounds", rounds])
    assert result.exit_code == 2
