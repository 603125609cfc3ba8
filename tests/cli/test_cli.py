"""The command line as a user meets it: help, versions, usage errors, files that cannot be written."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import typer.main
import typer.testing

from skinnode import cli
from skinnode.cli.main import app as skinnode_app
from vcan_sim.cli import app as simulator_app

from ..commands import run_here

SKINNODE = Path(sys.executable).with_name("skinnode")


def skinnode(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The installed command, in a process of its own."""
    return subprocess.run(
        [str(SKINNODE), *arguments], capture_output=True, text=True, timeout=60, check=False
    )


@functools.cache
def help_of_all() -> str:
    return skinnode("--help").stdout


COMMANDS = sorted(path.stem for path in Path(cli.__file__).parent.glob("[a-z]*.py") if path.stem != "main")
PAGE = (Path(__file__).parents[2] / "docs" / "commands.md").read_text()


@pytest.mark.parametrize("command", COMMANDS)
def test_help_and_page_name_the_command(command: str) -> None:
    assert f" {command} " in help_of_all()
    assert f"skinnode {command}" in PAGE
    done = run_here(command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout
    assert done.stderr == ""


def leaves(command: Any) -> Iterator[Any]:
    for inner in getattr(command, "commands", {}).values():
        yield from leaves(inner)
    if not hasattr(command, "commands"):
        yield command


LEAVES = [leaf for app in (skinnode_app, simulator_app) for leaf in leaves(typer.main.get_command(app))]


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.callback.__name__)
def test_help_breaks_lines_only_where_the_terminal_ends(
    leaf: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Paragraphs of a docstring are one line on a wide terminal; an option without a value shows no type."""
    monkeypatch.setenv("COLUMNS", "2000")
    leaf.main(["--help"], standalone_mode=False)
    shown = capsys.readouterr().out
    assert "<bool>" not in shown
    for paragraph in re.split(r"\n\s*\n", inspect.getdoc(leaf.callback) or ""):
        assert " ".join(paragraph.split()) in shown


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numba", "scipy", "can", "canopen", "matplotlib", "numpy", "pydantic")
    code = f"import skinnode.cli.main, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_diagnoses_or_simulates_loads_no_solver() -> None:
    """Numba and the solver take half a second; a node, the doctor and `skinnode scan` need neither."""
    code = (
        "import importlib, pkgutil, sys, skinnode.diagnose, skinnode.node, vcan_sim.fleet\n"
        "for found in pkgutil.walk_packages(skinnode.diagnose.__path__, 'skinnode.diagnose.'):\n"
        "    importlib.import_module(found.name)\n"
        "print([name for name in ('numba', 'skinnode.solve') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version() -> None:
    import skinnode

    assert skinnode_version() == f"skinnode {skinnode.__version__}"


def skinnode_version() -> str:
    return skinnode("--version").stdout.strip()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("demo --patches 0", "skinnode demo: --patches: got '0', allowed: an integer from 1 to 16"),
        ("demo --patches 17", "skinnode demo: --patches: got '17', allowed: an integer from 1 to 16"),
        ("demo --seconds zero", "skinnode demo: --seconds: got 'zero', allowed: a number from 1.0 to 3600.0"),
        ("demo --seconds nan", "skinnode demo: --seconds: got 'nan', allowed: a number from 1.0 to 3600.0"),
        (
            "scan --bitrat 1",
            "skinnode scan: no such option: --bitrat (Possible options: --bitrate",
        ),
        ("replay x.log --fast --speed 2", "--speed: got 2.0, allowed: no speed with --fast"),
        (
            "convert x.log y.npz --frames-only",
            "--frames-only: got 'y.npz', allowed: only with an .mcap target",
        ),
        ("scan --bitrate x", "skinnode scan: --bitrate: got 'x', allowed: an integer"),
        ("scan --bitrate 5", "--bitrate: got 5, allowed: a bit rate from 10000 to 1000000"),
        ("doctor x.toml --bitrate 5", "--bitrate: got 5, allowed: only without a hand file"),
        ("doctor x.toml --fd", "--fd: got yes, allowed: only without a hand file"),
        ("scan --hand x.toml --fd", "--fd: got yes, allowed: only without a hand file"),
        (
            "info",
            "skinnode info: NODE: got nothing, allowed: node-ID, or the name of a patch in the --hand file",
        ),
        (
            "node",
            "skinnode node: --source: got nothing, allowed: source of the resistances: MODULE:NAME, or a",
        ),
        (
            "host hand.toml --seconds -1",
            "skinnode host: --seconds: got '-1', allowed: a non-negative number of seconds",
        ),
        (
            "node --source simulated --seconds inf",
            "skinnode node: --seconds: got 'inf', allowed: a non-negative number",
        ),
        (
            "record hand.toml x --seconds nan",
            "skinnode record: --seconds: got 'nan', allowed: a non-negative number",
        ),
        ("record x.toml -o . --format asc", "skinnode record: --format: got 'asc', allowed: log or blf"),
        ("conformance --only ,", "--only: got ',', allowed: an area"),
        ("conformance --node-id 4 --eds no.eds", "--eds: got 'no.eds', allowed: a file that can be read"),
        (
            "lss set --serial -4",
            "skinnode lss set: --serial: got '-4', allowed: an integer from 0 to 4294967295",
        ),
        ("no-such-command", "skinnode: no such command 'no-such-command'"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(arguments: str, line: str) -> None:
    done = run_here(*arguments.split())
    assert done.returncode == 2
    assert done.stdout == ""
    (said,) = done.stderr.splitlines()
    assert said.startswith(f"error: {line}")


@pytest.mark.long
def test_wrong_usage_of_the_installed_command() -> None:
    done = skinnode("scan", "--bitrate", "x")
    said = "error: skinnode scan: --bitrate: got 'x', allowed: an integer\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)


def test_a_group_without_a_command_shows_its_help() -> None:
    done = run_here("lss")
    assert done.returncode == 2
    assert "list" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_completion_is_written_for_the_shell() -> None:
    """What ``skinnode --install-completion`` installs; ``--show-completion`` prints it by itself."""
    script = completion(_SKINNODE_COMPLETE="source_bash")
    assert "_SKINNODE_COMPLETE=complete_bash" in script
    variables = {"_SKINNODE_COMPLETE": "complete_bash", "COMP_WORDS": "skinnode do", "COMP_CWORD": "1"}
    asked = completion(**variables)
    assert asked.split() == ["doctor"]
    installed = subprocess.run(
        [str(SKINNODE)], capture_output=True, text=True, env={**os.environ, **variables}
    )
    assert installed.stdout == asked


HAND = """
[[buses]]
name = "left"
[[buses]]
name = "right"
channel = "can1"
[[patches]]
name = "thumb"
node_id = 11
bus = "left"
[[patches]]
name = "palm"
node_id = 12
bus = "right"
"""


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("skinnode info ", [str(node_id) for node_id in range(1, 128)]),  # no hand anywhere
        ("skinnode od 12", ["12", "120", "121", "122", "123", "124", "125", "126", "127"]),
        ("skinnode nmt a", ["all"]),
        ("skinnode info --hand two.toml ", ["11", "12", "thumb", "palm"]),
        ("skinnode od --hand two.toml --bus right ", ["12", "palm"]),
        ("skinnode nmt --hand two.toml t", ["thumb"]),
        ("skinnode lss set --hand two.toml --node-id ", ["11", "12"]),
        ("skinnode info --hand broken.toml 9", ["9", *map(str, range(90, 100))]),
    ],
)
def test_nodes_are_offered_where_one_is_asked_for(tmp_path: Path, words: str, offered: list[str]) -> None:
    (tmp_path / "two.toml").write_text(HAND)
    (tmp_path / "broken.toml").write_text("[[patches]")
    assert offers(words, tmp_path) == offered


def test_nodes_are_those_of_the_hand_that_lies_there(tmp_path: Path) -> None:
    (tmp_path / "hand.toml").write_text(HAND)
    assert offers("skinnode info ", tmp_path) == ["11", "12"]  # by name only with --hand


def test_the_simulator_is_completed_too(tmp_path: Path) -> None:
    program = "vcan-sim"
    script = completion(program, _VCAN_SIM_COMPLETE="source_bash")
    assert "_VCAN_SIM_COMPLETE=complete_bash" in script
    assert offers("vcan-sim --fa", tmp_path, program) == ["--fault"]


def offers(words: str, folder: Path, program: str = "skinnode") -> list[str]:
    """What a shell offers for the last word of a line."""
    variable = f"_{program.upper().replace('-', '_')}_COMPLETE"
    count = str(len(words.split(" ")) - 1)
    asked = {variable: "complete_bash", "COMP_WORDS": words, "COMP_CWORD": count}
    return completion(program, folder, **asked).split()


def completion(program: str = "skinnode", folder: Path | None = None, **environment: str) -> str:
    with mock.patch.dict(os.environ, environment), contextlib.chdir(folder or Path.cwd()):
        return run_here(program=program).stdout


@pytest.mark.parametrize("option", ["--json", "--plot"])
def test_a_file_that_cannot_be_written_is_known_before_the_demo_starts(option: str, tmp_path: Path) -> None:
    target = tmp_path / "no such folder" / "file.png"
    done = run_here("demo", option, str(target))
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert option in line
    assert str(target) in line
    assert "allowed" in line


def test_a_plot_of_no_known_kind_is_refused(tmp_path: Path) -> None:
    done = run_here("demo", "--plot", str(tmp_path / "plot.doc"))
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert "png" in line
