"""The command line as a user meets it: help, versions, usage errors, files that cannot be written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SKINNODE = Path(sys.executable).with_name("skinnode")


def skinnode(*arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(SKINNODE), *arguments], capture_output=True, text=True, timeout=timeout_s, check=False
    )


@pytest.mark.parametrize(
    "command", ["demo", "host", "scan", "info", "od", "nmt", "lss", "doctor", "eds", "conformance", "bench"]
)
def test_help_names_the_command(command: str) -> None:
    assert command in skinnode("--help").stdout
    done = skinnode(command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout
    assert done.stderr == ""


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numba", "scipy", "can", "canopen", "matplotlib", "numpy", "pydantic")
    code = f"import skinnode.cli.main, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version() -> None:
    import skinnode

    assert skinnode_version() == f"skinnode {skinnode.__version__}"


def skinnode_version() -> str:
    return skinnode("--version").stdout.strip()


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--patches", "0"),
        ("demo", "--patches", "17"),
        ("demo", "--seconds", "zero"),
        ("demo", "--seconds", "nan"),
        ("demo", "--no-such-option"),
        ("no-such-command",),
    ],
)
def test_wrong_usage_is_status_2_without_a_traceback(arguments: tuple[str, ...]) -> None:
    done = skinnode(*arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr.strip()


@pytest.mark.parametrize("option", ["--json", "--plot"])
def test_a_file_that_cannot_be_written_is_known_before_the_demo_starts(option: str, tmp_path: Path) -> None:
    target = tmp_path / "no such folder" / "file.png"
    done = skinnode("demo", option, str(target))
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert option in line
    assert str(target) in line
    assert "allowed" in line


def test_a_plot_of_no_known_kind_is_refused(tmp_path: Path) -> None:
    done = skinnode("demo", "--plot", str(tmp_path / "plot.doc"))
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert "png" in line
