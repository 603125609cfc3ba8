"""A test that fails while the machine stands still is run again, and listed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.lanes import some_long

ROOT = Path(__file__).parent.parent
MODULE = """
import ctypes

import pytest

made = []


@pytest.fixture(scope="module")
def shared():
    made.append(None)
    if len(made) == {fails_in_setup:d}:
        stand_still()
        raise OSError
    return len(made)


def stand_still():
    ctypes.PyDLL(None).usleep(100_000)  # no other thread of Python runs


def test_first(shared):
    if shared == 1:
        stand_still()
    assert shared == 2


def test_second(shared):
    assert shared == 2


def test_third():
    assert {third}
"""
LINE = "::test_first: nothing ran for "


def run(folder: Path, *options: str, fails_in_setup: bool = False, third: bool = True) -> tuple[int, str]:
    """Exit status and output of pytest, run with the plugin of these tests on a module of its own."""
    path = folder / "test_module.py"
    path.write_text(MODULE.format(fails_in_setup=fails_in_setup, third=third))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.stalls", "-p", "xdist"]
    command += ["-p", "no:cacheprovider", f"--rootdir={folder}", "-c", "/dev/null", *options, str(path)]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    return done.returncode, done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("workers", "fails_in_setup"),
    some_long([(0, True), (2, False)], (2, False)),
    ids=["in a fixture", "in a worker"],
)
def test_it_runs_again_with_new_fixtures(tmp_path: Path, workers: int, fails_in_setup: bool) -> None:
    options = ["-n", str(workers), "--dist", "loadfile"]
    status, output = run(tmp_path, *options, fails_in_setup=fails_in_setup)
    assert status == 0, output
    assert "3 passed" in output
    assert output.count(LINE) == 1
    assert "and run again" in output


@pytest.mark.long
def test_where_stalls_count_it_fails(tmp_path: Path) -> None:
    status, output = run(tmp_path, "-n", "0", "--stalls-count")
    assert status == 1
    assert "2 failed, 1 passed" in output  # the second shares the fixture
    assert output.count(LINE) == 1
    assert "and counted" in output


@pytest.mark.long
def test_one_that_fails_by_itself_is_not_run_again(tmp_path: Path) -> None:
    for _ in range(5):  # on a busy machine, a real stall may hit the third test
        status, output = run(tmp_path, "-n", "0", third=False)
        if "test_third: nothing ran" not in output:
            break
    assert status == 1
    assert "1 failed, 2 passed" in output
    assert "test_third: nothing ran" not in output
