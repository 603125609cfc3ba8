"""What the pages of docs/ say exists, runs, and has the value it prints."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from typer.main import get_command

from skinnode.model.elastic import HertzContact, Rubber

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.glob("*.md"))
PAGE = (DOCS / "solver.md").read_text(encoding="utf-8")
GROUP = "239.74.163.4"
"""Where the nodes of the pages are; a test gives them a group of their own."""


def anchor(heading: str) -> str:
    """As GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_of_a_page_run_in_order(page: Path, tmp_path: Path, multicast_group: str) -> None:
    """Python that begins with a file's name is that file, other Python runs and prints something. Of the
    commands, nodes run beside what follows, and data sheets are written."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(DOCS.parent), str(tmp_path)])}
    beside: list[subprocess.Popen[str]] = []
    try:
        for language, block in re.findall(r"```(\w+)\n(.*?)```", text_of(page), flags=re.DOTALL):
            code = block.replace(GROUP, multicast_group)
            named = re.match(r"# (\w+\.py)\n", code)
            if language == "python" and named:
                (tmp_path / named[1]).write_text(code)
            elif language == "python":
                done = subprocess.run(
                    [sys.executable, "-W", "error", "-c", code],
                    capture_output=True,
                    text=True,
                    timeout=100,
                    cwd=tmp_path,
                    env=environment,
                )
                assert done.returncode == 0, done.stderr
                assert done.stdout
            elif language == "sh":
                for line in code.splitlines():
                    command = [str(Path(sys.executable).with_name("skinnode")), *line.split()[1:]]
                    if line.startswith("skinnode node"):
                        node = subprocess.Popen(
                            command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
                        )
                        beside.append(node)
                        assert node.stdout is not None
                        assert "Ctrl-C ends" in node.stdout.readline()
                    elif line.startswith("skinnode eds"):
                        subprocess.run(command, cwd=tmp_path, env=environment, check=True, timeout=60)
    finally:
        for node in beside:
            node.terminate()
            node.communicate(timeout=20)
    assert [node.returncode for node in beside] == [0] * len(beside)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist_with_their_options(page: Path) -> None:
    from skinnode.cli.main import app

    lines = re.findall(r"(?:`|^|\.venv/bin/)skinnode ([^`\n]+)", text_of(page), flags=re.MULTILINE)
    commands: set[tuple[str, str | None]] = set()
    for line in lines:
        found = re.match(r"(?:bench )?[a-z]+", line)
        assert found, line
        commands |= {(found[0], option) for option in [None, *re.findall(r"--[a-z-]+", line)]}
    wanted = {
        "solver.md": {("bench kernel", None), ("bench stability", None), ("bench path", "--plot")},
        "node.md": {("node", "--source"), ("eds", "--layout"), ("host", None)},
    }
    assert wanted.get(page.name, set()) <= commands
    for name, option in commands:
        done = CliRunner().invoke(get_command(app), [*name.split(), "--help"])
        assert done.exit_code == 0, name
        assert option is None or option in done.output, f"{name} {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    text = text_of(page)
    headings = {anchor(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)}
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings, target
        elif not target.startswith("http"):
            assert (DOCS / target).is_file(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_named_exist(page: Path) -> None:
    package = DOCS.parent
    for name in set(
        re.findall(r"`((?:solve|model|cli|docs|tests|eds|examples)/[\w/.-]+\.\w+)`", text_of(page))
    ):
        assert (package / name).is_file() or (package / "skinnode" / name).is_file(), name


def test_constants_have_the_values_printed() -> None:
    rows = re.findall(r"^\| `(\w+)\.([A-Z_0-9]+)` \| ([^|]+) \|", PAGE, flags=re.MULTILINE)
    assert len(rows) > 40
    for module, name, value in rows:
        found = getattr(importlib.import_module(f"skinnode.solve.{module}"), name)
        assert found == pytest.approx(float(value), rel=1e-12), f"{module}.{name}"


def test_statuses_and_fields_of_the_table_are_those_of_the_code() -> None:
    from skinnode.model.frames import FieldFrame
    from skinnode.model.status import Status

    table = PAGE.split("### Statuses")[1].split("### Flags")[0]
    cells = re.findall(r"^\| ([A-Z_, ]+) \|", table, flags=re.MULTILINE)
    assert sorted(", ".join(cells).split(", ")) == sorted(status.name for status in Status)
    flags = PAGE.split("### Flags beside the status")[1].split("### What a deviation means")[0]
    for name in re.findall(r"^\| `(\w+)", flags, flags=re.MULTILINE):
        assert name in FieldFrame.__dataclass_fields__, name


def script(name: str) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_bonded_layer_is_a_half_space_when_thick_and_reynolds_film_when_thin() -> None:
    wrong = script("wrong_models")
    rubber = Rubber()
    points = np.array([[0.0, 0.0], [2e-3, 1e-3], [9e-3, 4e-3]])
    hertz = HertzContact(rubber, radius_m=0.1, indentation_m=6e-4)
    pressed = hertz.peak_pressure_pa * wrong.hertz_displacement(
        points, np.zeros(2), hertz.contact_radius_m, 1.0, rubber
    )
    np.testing.assert_allclose(pressed, hertz.displacement_m(points), atol=0.01 * 6e-4)
    # a film between a wall and a free surface: flux t³/3G, speed of the surface t²/2G of the gradient
    k, t, g = np.array([3e-3, 1e-2]), 1.0, 2.0
    along, normal = wrong.layer_response(k, t, g)
    np.testing.assert_allclose(along, k * t**2 / (2 * g), rtol=1e-3)
    np.testing.assert_allclose(normal, -(k**2) * t**3 / (3 * g), rtol=1e-3)
