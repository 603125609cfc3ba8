"""The map of CONTRIBUTING.md against the packages, the import contracts and the files it names."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
ROWS = re.findall(r"^\| (\d+) \| `skinnode/([\w.]+)` \|", TEXT, flags=re.MULTILINE)


def contract(word: str) -> dict[str, list[str]]:
    (found,) = [each for each in CONTRACTS if word in each["name"]]
    return found


def test_every_package_is_on_the_map_once() -> None:
    packages = {path.parent.name for path in (ROOT / "skinnode").glob("*/__init__.py")}
    assert sorted(name.removesuffix(".py") for _, name in ROWS) == sorted(packages | {"errors"})


def test_layers_of_the_map_are_those_of_the_contract() -> None:
    layers = [
        {name.strip("() ") for name in re.split(r"[|:]", layer)} - {"moved"}
        for layer in contract("Layers")["layers"]
    ]
    drawn = [
        {name.removesuffix(".py") for number, name in ROWS if int(number) == n + 1}
        for n in range(len(layers))
    ]
    assert drawn == layers


def test_users_of_the_simulator_are_those_of_the_contract() -> None:
    allowed = {
        line.split(" -> ")[0].replace(".", "/") + ".py"
        for line in contract("does not know")["ignore_imports"]
    }
    sentence = re.split(r"only\s+in\s+these\s+files:", TEXT)[1].split("\n\n")[0]
    named = {
        str(path.relative_to(ROOT))
        for pattern in re.findall(r"`([\w/*.]+)`", sentence)
        for path in ROOT.glob(pattern)
    }
    assert allowed <= named
    importing = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "skinnode").rglob("*.py")
        if re.search(r"^\s*(from|import) vcan_sim", path.read_text("utf-8"), flags=re.MULTILINE)
    }
    assert importing == allowed


def test_files_and_folders_named_exist() -> None:
    named = re.findall(r"`((?:skinnode|vcan_sim|tests|tools|docs|eds)/[\w/.*-]*)`", TEXT)
    assert len(named) > 40
    for name in set(named):
        if "NAME" not in name:
            assert list(ROOT.glob(name.rstrip("/"))), name


def test_every_package_says_how_its_data_flow() -> None:
    for path in (ROOT / "skinnode").glob("**/__init__.py"):
        assert path.read_text("utf-8").startswith(('"""', 'r"""')), path


def test_hooks_of_a_commit_are_programs_of_the_environment() -> None:
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    assert repository["repo"] == "local"
    for hook in repository["hooks"]:
        assert hook["entry"].startswith((".venv/bin/", "tools/")), hook["id"]


def additions() -> dict[str, tuple[str, list[str]]]:
    """Example and files under *always* of each kind of addition, by heading."""
    part = TEXT.split("## Where do I add …")[1].split("\n## ")[0]
    found = {}
    for section in part.split("\n### ")[1:]:
        lines = dict(re.findall(r"^- (\w+): (.*?)(?=\n- |\Z)", section, flags=re.MULTILINE | re.DOTALL))
        names = re.findall(r"`((?:skinnode|vcan_sim|docs|examples)/[\w/.-]+\.\w+)`", lines["Always"])
        found[section.splitlines()[0]] = lines["Example"].strip(" `\n"), names
    return found


@pytest.mark.parametrize("heading", additions())
def test_files_of_an_addition_mention_the_example(heading: str) -> None:
    example, names = additions()[heading]
    assert names
    for name in names:
        path = ROOT / name.replace("NAME", example)
        text = path.read_text("utf-8")
        assert path.stem == example or example.lower() in text.lower(), name
