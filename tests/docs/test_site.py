"""The site of the documentation builds strictly, has every page, and loads nothing from outside."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

import skinnode
from skinnode.config import HandConfig
from skinnode.protocol.eds_files import REFERENCE_PROFILES

from .blocks import PAGES, REPOSITORY

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a site built in strict mode."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=REPOSITORY,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class _Loads(HTMLParser):
    """Collects what a browser fetches to show a page; links to click are not among it."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "srcset", "poster", "data") or (
                tag in ("link", "image", "use") and "href" in name
            ):
                self.found.append(value or "")
            elif name == "style":
                self.found += _in_style(value or "")

    def handle_data(self, data: str) -> None:
        if self.lasttag == "style":
            self.found += _in_style(data)


def _in_style(text: str) -> list[str]:
    return re.findall(r"""(?:url\(|@import)\s*["']?([^"')\s;]+)""", text)


def loads(site: Path) -> Iterator[tuple[Path, str]]:
    for page in site.rglob("*.html"):
        parser = _Loads()
        parser.feed(page.read_text(encoding="utf-8"))
        yield from ((page, address) for address in parser.found)
    for sheet in site.rglob("*.css"):
        yield from ((sheet, address) for address in _in_style(sheet.read_text(encoding="utf-8")))


def _is_outside(address: str) -> bool:
    return bool(re.match(r"(?!data:)\w+:|//", address))


def test_no_script_style_font_or_image_comes_from_outside(site: Path) -> None:
    found = list(loads(site))
    assert len(found) > 100
    assert [(str(page), address) for page, address in found if _is_outside(address)] == []
    # The theme's script fetches this one, from outside, for pages that have a diagram.
    assert not [
        page for page in site.rglob("*.html") if 'class="mermaid"' in page.read_text(encoding="utf-8")
    ]


def test_no_page_names_an_outside_address(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert set(re.findall(r"https?://[\w.]+", text)) <= {"http://www.w3.org"}, page


def test_every_page_is_in_the_navigation(site: Path) -> None:
    front = (site / "index.html").read_text(encoding="utf-8")
    for page in PAGES:
        assert f'href="{page.stem}.html"' in front or page.stem == "index", page.name


def test_generated_tables_have_what_they_are_made_of(site: Path) -> None:
    hand = (site / "hand-toml.html").read_text(encoding="utf-8")
    for table in HandConfig.model_json_schema()["$defs"].values():
        for key in table["properties"]:
            assert f"<code>{key}</code>" in hand, key
    wire = (site / "protocol.html").read_text(encoding="utf-8")
    for item in REFERENCE_PROFILES[0].objects():
        assert item.name in wire or f"{item.index:04X}" in wire or item.name[-1].isdigit(), item.name
    assert not re.search("generated:", hand + wire)


def test_constants_of_the_solver_are_on_their_page_with_value_and_origin(site: Path) -> None:
    page = (site / "solver-derivations.html").read_text(encoding="utf-8")
    rows = re.findall(r"<td><code>[\w.]*?([A-Z_0-9]+)</code></td>\s*<td>([^<]+)</td>\s*<td>(.+)</td>", page)
    assert len(rows) > 70
    values = {name: float(value) for name, value, _ in rows}
    assert values.items() >= {("PRIOR_DOUBT", 3.0), ("FOLDED", 250.0), ("FRAME_STEPS", 12.0)}
    assert min(len(origin) for _, _, origin in rows) > 10


def test_the_python_reference_has_every_public_name(site: Path) -> None:
    page = (site / "python.html").read_text(encoding="utf-8")
    for name in skinnode.__all__:
        if name != "__version__":
            assert re.search(rf'id="skinnode\.(?:[\w.]+\.)?{name}"', page), name


def test_a_picture_from_outside_would_be_found() -> None:
    parser = _Loads()
    parser.feed('<img src="https://example.org/a.png"><a href="https://example.org/">x</a>')
    assert parser.found == ["https://example.org/a.png"]
