"""Every message is a sentence: no None, no brace left unfilled, no double space, one line for an error."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skinnode.cli._bus import Place
from skinnode.cli._errors import run
from skinnode.cli.main import app
from skinnode.cli.scan import _faults
from skinnode.config import load_hand
from skinnode.diagnose.discovery import Discovery, FoundNode
from skinnode.errors import ConfigError
from tests.commands import virtual_time
from vcan_sim.cli import app as simulator
from vcan_sim.fleet import Fleet

SMALL = "upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4"
NONE = re.compile(r"\bNone\b|\bnan\b|\{|\}|<[\w.]+ object at")
"""What no line for people contains."""
GAP = re.compile(r"\S  +\S")
"""Words with more than one space between them; columns of a table have that."""


Said = Callable[..., tuple[int, str]]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs a command as its entry point does: exit status, and everything that was printed."""

    def of(line: str, program: Any = app) -> tuple[int, str]:
        status = run(program, line.split())
        out, err = capsys.readouterr()
        return status, out + err

    return of


def check(text: str) -> None:
    for line in text.splitlines():
        assert NONE.search(line) is None, line
        if line.startswith(("error: ", "fault: ", "note: ")):
            assert GAP.search(line) is None, line
            assert line.rstrip() == line
            assert not line.endswith((":", ",", ";")), line


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working directory with hand files: of one bus, of two, one that is wrong, and other files.

    Time is virtual, because most commands wait for devices that are not there."""
    monkeypatch.chdir(tmp_path)
    buses = [f'[[buses]]\nname = "b{i}"\ninterface = "timed"\nchannel = "b{i}"\n' for i in (0, 1)]
    patch = '[[patches]]\nname = "{0}"\nnode_id = {1}\nbus = "{2}"\nlayout = {{ {3} }}\n'
    palm, thumb = patch.format("palm", 5, "b0", SMALL), patch.format("thumb", 5, "b1", SMALL)
    head = "[sync]\nperiod_ms = 50\n"
    (tmp_path / "one.toml").write_text(head + buses[0] + palm)
    (tmp_path / "two.toml").write_text("".join((head, *buses, palm, thumb)))
    (tmp_path / "wrong.toml").write_text(head + buses[0] + palm.replace("node_id = 5", "node_id = 500"))
    (tmp_path / "spelt.toml").write_text(head + buses[0].replace("timed", "vertual") + palm)
    (tmp_path / "text").write_text("no hand, no recording, no EDS\n")
    with virtual_time("b0", "b1", "nobody"):
        yield tmp_path


ON = "--interface timed --channel nobody"
NOBODY_THERE = [
    f"info 5 {ON}",
    f"info 0 {ON}",
    f"info palm {ON}",
    "info palm --hand one.toml",
    "info pinky --hand one.toml",
    "info 5 --hand two.toml",
    "info 9 --hand two.toml",
    "info 5 --hand two.toml --bus b7",
    "info 5 --bus b0",
    "info 5 --hand nowhere.toml",
    "info 5 --hand wrong.toml",
    "info 5 --hand one.toml --bitrate 5",
    "info 5 --hand one.toml --fd",
    "info 5 --hand two.toml --channel x",
    "info 5 --interface vertual",
    "info 5 --eds text --interface timed",
    f"od 5 {ON}",
    f"od 5 10 --write 3 {ON}",
    f"od 5 --write 3 {ON}",
    f"od 5 zz {ON}",
    f"od 5 1018 --dcf x.dcf {ON}",
    f"od 5 1018 --diff text {ON}",
    f"nmt all start {ON}",
    f"nmt 5 fly {ON}",
    f"lss set --node-id 5 {ON}",
    f"lss set --bit-rate 7 {ON}",
    "lss set --node-id 5 --hand two.toml",
    f"scan {ON}",
    "scan --hand two.toml",
    f"tare {ON}",
    f"tare 5 {ON}",
    "tare --hand two.toml",
    "tare pinky --hand two.toml",
    "doctor spelt.toml",
    "doctor wrong.toml --html /nowhere/x.html",
    "hand check wrong.toml",
    "hand check spelt.toml",
    "hand check text",
    "hand check nowhere.toml",
    "hand new --buses 9 --patches 2",
    "hand ros2 two.toml -o nowhere",
    "hand ros2 wrong.toml -o .",
    "host one.toml --seconds 0",
    "host spelt.toml --seconds 0",
    "host two.toml --channel x",
    "record one.toml -o text",
    "record one.toml -o /dev/null/x",
    "record one.toml -o run.txt",
    "record one.toml -o /proc/x",
    "replay text",
    "replay nowhere.log",
    "replay run.log --speed 0",
    "replay nowhere.log --hand one.toml",
    "replay nowhere.mcap",
    "resolve nowhere.log -o solved",
    "resolve text -o solved",
    "resolve run.log -o solved --set solver.method",
    "resolve run.log -o solved --set bus=can1",
    "convert",
    "convert text x.mcap",
    "convert nowhere.log x.mcap",
    "convert nowhere.log text",
    "convert nowhere.npz x.mcap",
    "convert nowhere.parquet x.npz",
    "convert nowhere.npz x.parquet --hand one.toml",
    "convert nowhere.log x.npz --hand wrong.toml",
    "bench recording --buses 0",
    "bench remote --seconds 0",
    "monitor",
    "monitor --json",
    "monitor one.toml --json --replay x.log",
    "monitor --json --simulate --speed 2",
    "monitor --json --simulate -o text",
    "monitor one.toml --json --remote hand",
    "monitor one.toml --json --router tcp/robot:7447",
    "monitor --json --remote hand --zenoh-port 80",
    "view",
    "view one.toml --web --replay x.log",
    "view --simulate --port 9000",
    "view --simulate --save text",
    "view --simulate --web --speed 2",
    "view --web --replay x.log --remote hand",
    "node --source nobody:nothing --node-id 5",
    "node --source simulated",
    "node --source simulated --node-id 5 --interface vertual --channel x",
    "node --source simulated --node-id 5 --layout nowhere.toml",
    "eds --dcf",
    "eds --node-id 5",
    "eds --layout staggered --upper-wires 3",
    "eds --code-bits 7",
    "eds -o /nowhere/x.eds",
    "eds --c /nowhere/x",
    "eds --c text",
    "eds --c . -o x.eds",
    "conformance",
    "conformance --node-id 5 --only nothing",
    f"conformance --node-id 5 {ON}",
    "demo --json /nowhere/x",
    "od",
    "nmt 5",
    "fly",
    "scan --fly",
]


@pytest.mark.parametrize("line", NOBODY_THERE)
def test_of_what_cannot_be(folder: Path, said: Said, line: str) -> None:
    status, text = said(line)
    assert status in (1, 2), text
    check(text)


@pytest.mark.parametrize(
    "line",
    [
        "nowhere.toml",
        "wrong.toml",
        "spelt.toml --seconds 0.1",
        "one.toml --fault fly",
        "one.toml --channel=",
    ],
)
def test_of_a_simulator_that_cannot_be(folder: Path, said: Said, line: str) -> None:
    status, text = said(line, simulator)
    assert status == 2
    check(text)


@pytest.mark.parametrize(
    "fault",
    ["open_upper=2", "wrong_identity", "silent", "deaf"],
)
def test_of_what_is_wrong_with_a_hand(folder: Path, said: Said, fault: str) -> None:
    hand = load_hand("one.toml")
    with Fleet(hand) as fleet:
        fleet.faults.inject(f"palm:{fault}")
        for line in (
            "host one.toml --seconds 1",
            "tare --hand one.toml",
            "doctor one.toml",
        ):
            check(said(line)[1])


def test_of_a_device_that_tells_nothing_about_itself(folder: Path) -> None:
    hand = load_hand("one.toml")
    nothing = dict.fromkeys(
        name
        for name in FoundNode.__annotations__
        if name not in ("node_id", "answers", "state", "state_known_by", "boot_ups", "duplicate")
    )
    node = FoundNode(5, True, "unknown", "no heartbeat", boot_ups=0, duplicate="", **nothing)
    place = Place(hand.buses[0], hand)
    for fault in _faults(Discovery((node,), (), False, 1.0), place):
        check(f"fault: {fault}")


def test_an_error_without_a_value_says_nothing() -> None:
    assert str(ConfigError("--x", None, "a name")) == "--x: got nothing, allowed: a name"
