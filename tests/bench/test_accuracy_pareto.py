"""``skinnode bench accuracy --only pareto``: which method is best at which noise, and the plot of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skinnode.bench import accuracy_pareto as bench
from skinnode.bench.accuracy_past import Phase
from skinnode.bench.plots import pareto as plot
from skinnode.cli.bench import app


def rows(*points: tuple[str, float, float], **case) -> list[dict]:
    case = {"sigma": 1e-3, "motion": "held", "family": "all"} | case
    return [case | {"method": method, "ms": ms, "error": error} for method, ms, error in points]


def test_the_front_has_the_methods_that_no_other_outdoes_in_both_error_and_time():
    points = ("exact", 0.1, 0.9), ("cells", 1.0, 0.3), ("discs", 3.0, 0.1), ("cells, past", 4.0, 0.2)
    other = rows(("cells, past", 0.01, 0.01), sigma=1e-4)  # competes with none of those
    found = bench.mark_front([*rows(*points), *other])
    assert [row["front"] for row in found] == [True, True, True, False, True]
    assert bench.outdone({"pareto": found}) == {"cells, past": [1e-3]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command writes for a sphere that is held and then slides, at a noise of 1e-3."""
    phases = (
        Phase("rest", 1, 0.0), Phase("onset", 1, 0.85), Phase("hold", 11, 0.85), Phase("slide", 4, 0.85, 1.0),
    )  # fmt: skip
    made = tmp_path_factory.mktemp("pareto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "PHASES", phases)
        patch.setattr(bench, "FAMILIES", ("sphere",))
        patch.setattr(bench, "SIGMAS", (1e-3,))
        files = "--json", str(made / "pareto.json"), "--plot", str(made / "pareto.png")
        result = CliRunner().invoke(app, ["accuracy", "--only", "pareto", "--scenes", "1", *files])
    must = json.loads((made / "pareto.json").read_text())["must"]
    assert result.exit_code == (0 if all(row["reached"] for row in must) else 1), result.output
    (made / "printed.txt").write_text(result.output)
    return made


@pytest.fixture(scope="module")
def figures(folder: Path) -> dict:
    return json.loads((folder / "pareto.json").read_text())


@pytest.mark.long
def test_in_noise_discs_and_earlier_frames_reduce_the_error_of_a_held_body(figures):
    held = {row["method"]: row for row in bench.pooled(figures, 1e-3, "held")}
    assert held["exact"]["error"] > 2.0 * held["cells"]["error"]
    assert held["discs"]["error"] < held["cells"]["error"]
    assert held["discs, past"]["error"] < held["discs"]["error"]
    assert {row["frames"] for row in held.values()} == {11}
    assert {row["frames"] for row in bench.pooled(figures, 1e-3, "moving")} == {4}
    assert all(row["ms"] > 0.0 for row in figures["pareto"])


@pytest.mark.long
def test_the_table_has_a_line_for_each_method_and_motion(folder, figures):
    printed = (folder / "printed.txt").read_text()
    for row in figures["pareto"]:
        (line,) = (
            x for x in printed.splitlines() if f" {row['motion']:7} {row['method']}  " in x and "1e-03" in x
        )
        assert line.startswith("*") == row["front"]
        assert f"{row['ms']:.2f}" in line
        assert f"{row['error']:.1%}" in line


@pytest.mark.long
def test_the_plot_has_a_mark_for_each_method(folder, figures):
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    picture = imread(folder / "pareto.png")[..., :3]
    for _, colour, _ in plot.MARKS.values():
        near = np.abs(picture - to_rgb(colour)).max(axis=-1) < 0.02
        assert near.sum() > 100
