"""Every command and code block of docs/ runs, in order, and prints what the page says."""

from __future__ import annotations

import os
import random
import re
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from .blocks import (
    BY_CI,
    DOCS,
    LANGUAGES,
    NOT_RUN,
    ON_VCAN,
    PAGES,
    PRINTS,
    PRINTS_EXACTLY,
    REPOSITORY,
    Block,
    Terminal,
    blocks_of,
)

GROUP = re.compile(r"239\.74\.163\.(\d+)")
"""Multicast groups of the pages and examples; each test replaces them by its own."""

MOST_NOT_RUN = 12
"""Maximum number of blocks that need hardware, root, a terminal, ROS 2 or much time."""

WIDEST = 104
"""Columns of code that fit on a page without scrolling."""

SLOWED = {"first-ten-minutes.md", "monitor.md", "recordings.md"}
"""Pages whose simulated hand scans at a third of the rate, so that a busy machine keeps up."""

_PRINTED = (PRINTS, PRINTS_EXACTLY)


def _sandbox(folder: Path, change: Callable[[str], str]) -> None:
    """Copy what a reader has in the repository, with ``change`` applied to the examples."""
    shutil.copytree(REPOSITORY / "examples", folder / "examples")
    for file in (folder / "examples").glob("*.toml"):
        file.write_text(change(file.read_text(encoding="utf-8")), encoding="utf-8")
    for name in ("eds", "tools"):
        (folder / name).symlink_to(REPOSITORY / name)
    (folder / ".venv").symlink_to(Path(sys.executable).parents[1])


def _run(blocks: list[Block], folder: Path, *, slowed: bool = False) -> None:
    network = f"239.{random.randrange(256)}.{random.randrange(256)}"

    def private(text: str) -> str:
        return GROUP.sub(rf"{network}.\1", text)

    period = "period_ms = 240" if slowed else "period_ms = 80"
    _sandbox(folder, lambda text: private(text.replace("period_ms = 80", period)))
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(folder)]),
        "PYTHONUNBUFFERED": "1",
        "COLUMNS": "120",
    }
    terminals: dict[str, Terminal] = {}
    latest: Terminal | None = None
    try:
        for block in blocks:
            code = private(block.code)
            if block.file is not None:
                (folder / block.file).write_text(code, encoding="utf-8")
            elif block.language == "sh":
                latest = terminals.setdefault(block.title, Terminal(folder, environment))
                latest.output.clear()
                for command, status in block.lines():
                    latest.run(private(command), status)
            elif block.language == "python":
                (folder / "_block.py").write_text(code, encoding="utf-8")
                latest = terminals.setdefault("python", Terminal(folder, environment))
                latest.output.clear()
                latest.run(f"{sys.executable} -W error _block.py", 0)
                assert latest.output, f"prints nothing:\n{code}"
            elif block.title in _PRINTED:
                assert latest is not None
                for line in code.splitlines():
                    latest.wait_for(line, exactly=block.title == PRINTS_EXACTLY)
        for terminal in reversed(terminals.values()):
            terminal.end()
    finally:
        for terminal in terminals.values():
            terminal.kill()


def _runs(block: Block, *, on_vcan: bool) -> bool:
    if block.title == BY_CI or block.title.startswith(NOT_RUN):
        return False
    return block.file is not None or (block.title == ON_VCAN) == on_vcan


def _to_run(page: Path, *, on_vcan: bool) -> list[Block]:
    """Blocks of a page that run here, without the output of blocks that do not run."""
    chosen, runs = [], False
    for block in blocks_of(page):
        if block.title not in _PRINTED:
            runs = _runs(block, on_vcan=on_vcan)
        if runs:
            chosen.append(block)
    return chosen


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
@pytest.mark.long
@pytest.mark.real_time
def test_blocks_of_a_page_run_in_order(page: Path, tmp_path: Path) -> None:
    _run(_to_run(page, on_vcan=False), tmp_path, slowed=page.name in SLOWED)


WITH_VCAN = [page for page in PAGES if any(block.title == ON_VCAN for block in blocks_of(page))]


@pytest.mark.vcan
@pytest.mark.parametrize("page", WITH_VCAN, ids=lambda page: page.name)
def test_blocks_of_a_page_run_on_vcan0(page: Path, tmp_path: Path) -> None:
    _run(_to_run(page, on_vcan=True), tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_is_of_a_kind_that_is_looked_at(page: Path) -> None:
    fences = len(re.findall(r"^ *```", page.read_text(encoding="utf-8"), flags=re.MULTILINE))
    blocks = blocks_of(page)
    assert fences == 2 * len(blocks)
    for block in blocks:
        known = block.title in ("", BY_CI, ON_VCAN, *_PRINTED) or block.title.startswith("terminal ")
        assert block.language in LANGUAGES, block
        assert known or block.file or block.title.startswith(NOT_RUN), block
        assert block.language == "text" or block.title not in _PRINTED, block
        assert block.language == "text" or max(map(len, block.code.splitlines())) <= WIDEST, block
        if block.language == "toml":
            tomllib.loads(block.code)


def test_few_blocks_do_not_run_and_each_says_why() -> None:
    reasons = [
        b.title.removeprefix(NOT_RUN)
        for page in PAGES
        for b in blocks_of(page)
        if b.title.startswith(NOT_RUN)
    ]
    assert all(len(reason) > 10 for reason in reasons)
    assert len(reasons) <= MOST_NOT_RUN, reasons


def test_what_ci_runs_elsewhere_is_there() -> None:
    """.ci/run takes the lines that users paste out of the README."""
    ci = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    quoted = re.findall(r"readme_line '([^']+)'", ci)
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()
    runs = [next(line for line in readme if words in line) for words in quoted]
    for page in PAGES:
        for block in blocks_of(page):
            if block.title == BY_CI:
                for line in block.code.splitlines():
                    assert line in runs or line in ci, line


def test_pages_are_found() -> None:
    assert DOCS / "index.md" in PAGES
    assert len(PAGES) > 5
