"""The README's programs run, and the page of commands lists every command."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()
COMMANDS = (Path(__file__).parents[1] / "docs" / "commands.md").read_text()


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.long
def test_the_first_example_prints_what_it_claims() -> None:
    done = subprocess.run(
        [sys.executable, "-c", python_blocks()[0]], capture_output=True, text=True, timeout=100, check=True
    )
    error, _, status = done.stdout.splitlines()[0].partition(" ")
    assert float(error) < 1e-6 * 150e-6  # the press of 150 µm is recovered to a millionth
    assert "CONVERGED" in status
    assert done.stdout.splitlines()[1].endswith("True")


def test_pages_and_pictures_of_the_front_page_are_there() -> None:
    linked = re.findall(r"\]\(([\w./-]+)\)", README)
    assert {"docs/img/hand.png", "docs/commands.md", "CONTRIBUTING.md"} <= set(linked)
    for name in linked:
        assert (Path(__file__).parents[1] / name).is_file(), name


@pytest.mark.long
def test_commands_of_the_table_exist() -> None:
    commands = set(re.findall(r"\| `(skinnode|vcan-sim)(?: (\w+))?", COMMANDS))
    assert ("skinnode", "demo") in commands
    for program, command in commands:
        arguments = [str(Path(sys.executable).with_name(program)), *filter(None, [command]), "--help"]
        if program == "vcan-sim":
            arguments = [arguments[0], "--help"]
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr


def test_the_table_has_every_command() -> None:
    from typer.main import get_command

    from skinnode.cli.main import app

    rows = [line for line in COMMANDS.splitlines() if line.startswith("| `")]
    for name, command in get_command(app).commands.items():
        words = [f"{name} {inner}" for inner in getattr(command, "commands", {})] or [name]
        for word in words:
            assert any(word in row for row in rows), word


@pytest.mark.long
@pytest.mark.real_time
def test_the_second_example_runs_against_simulated_patches(multicast_group: str) -> None:
    folder = Path(__file__).parents[1]
    simulator = subprocess.Popen(
        [str(Path(sys.executable).with_name("vcan-sim")), "examples/hand.toml", "--channel", multicast_group],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        code = python_blocks()[1].replace('.toml")', f'.toml", channel="{multicast_group}")').rstrip()
        code += "\n        if field.stamp.scan >= 12:\n            break\n"
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == 0, done.stderr
        patches = {line.split()[0] for line in done.stdout.splitlines()}
        assert patches == {"thumb", "index", "middle", "palm"}
    finally:
        simulator.terminate()
        simulator.communicate(timeout=20)
