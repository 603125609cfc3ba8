"""Commands, options, files, statuses and fields named on the pages exist."""

from __future__ import annotations

import importlib.util
import re
import types
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from typer.main import get_command

from skinnode.model.elastic import HertzContact, Rubber

from .blocks import DOCS, PAGES

PAGE = (DOCS / "solver.md").read_text(encoding="utf-8")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


_COMMAND = re.compile(
    r"(?:`|^|\.venv/bin/)skinnode ((?:(?:bench|hand|lss) )?[a-z]+2?)([^`\n]*)", flags=re.MULTILINE
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist_with_their_options(page: Path) -> None:
    from skinnode.cli.main import app

    commands: set[tuple[str, str | None]] = set()
    for name, rest in _COMMAND.findall(text_of(page)):
        commands |= {(name, option) for option in [None, *re.findall(r"--[a-z-]+", rest)]}
    wanted = {
        "solver.md": {("bench kernel", None), ("bench stability", None), ("bench path", "--plot")},
        "node.md": {("node", "--source"), ("eds", "--layout"), ("host", None)},
        "first-ten-minutes.md": {("scan", "--hand"), ("record", "--seconds"), ("replay", "--fast")},
    }
    assert wanted.get(page.name, set()) <= commands
    for name, option in commands:
        done = CliRunner().invoke(get_command(app), [*name.split(), "--help"])
        assert done.exit_code == 0, name
        assert option is None or option in done.output, f"{name} {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_named_exist(page: Path) -> None:
    package = DOCS.parent
    for name in set(
        re.findall(r"`((?:solve|model|cli|docs|tests|eds|examples)/[\w/.-]+\.\w+)`", text_of(page))
    ):
        assert (package / name).is_file() or (package / "skinnode" / name).is_file(), name


PICTURE = re.compile(r"!\[[^\]]{10,}\]\((?:docs/)?img/([\w.-]+)\)")
"""A picture with a text that describes it."""


def guides() -> list[str]:
    """Pages under "Guides" in the navigation."""
    nav = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8").split("- Guides:\n")[1]
    return re.findall(r"^      - .*: (\S+\.md)$", nav.split("\n  - ")[0], flags=re.MULTILINE)


def test_every_guide_has_a_picture() -> None:
    assert len(guides()) > 12
    for name in [*guides(), "index.md", "first-ten-minutes.md", "concepts.md"]:
        assert PICTURE.search(text_of(DOCS / name)), name


def test_pictures_are_small_and_each_is_shown() -> None:
    pages = "".join(text_of(page) for page in PAGES)
    files = {path.name: path for path in (DOCS / "img").iterdir()}
    assert set(PICTURE.findall(pages)) == set(files)
    for path in files.values():
        assert path.stat().st_size <= 150_000, path.name


NOT_OURS = re.compile(
    r"\b(told|whoever|dealers?|lanes?|bringers?|rivals?|tells of|comes of)\b", flags=re.IGNORECASE
)
"""Words of translated English and of earlier code; the glossary in docs/concepts.md has better words."""


@pytest.mark.parametrize("page", [*PAGES, DOCS.parent / "README.md"], ids=lambda page: page.name)
def test_prose_uses_the_words_of_the_glossary(page: Path) -> None:
    prose = re.sub(
        r"^ *```.*?^ *```$|`[^`\n]*`|doctor: [^;|]*", "", text_of(page), flags=re.MULTILINE | re.DOTALL
    )
    assert NOT_OURS.findall(prose) == []


def test_the_page_of_the_solver_stays_short() -> None:
    assert len(PAGE.split()) < 5000


def test_tables_of_measurements_have_their_markers_once() -> None:
    figures = script("figures")
    pages = "".join(text_of(page) for page in figures.PAGES)
    names = [name for tables in figures.MADE.values() for name in tables]
    for name in [*names, "wrong models"]:
        assert pages.count(f"<!-- FIGURES: {name} -->") == pages.count(f"<!-- END: {name} -->") == 1, name


def test_statuses_and_fields_of_the_table_are_those_of_the_code() -> None:
    from skinnode.model.frames import FieldFrame
    from skinnode.model.status import Status

    table = PAGE.split("## Statuses")[1].split("### Fields beside")[0]
    cells = re.findall(r"^\| ([A-Z_, ]+) \|", table, flags=re.MULTILINE)
    assert sorted(", ".join(cells).split(", ")) == sorted(status.name for status in Status)
    flags = PAGE.split("### Fields beside the status")[1].split("## Uncertainty")[0]
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
