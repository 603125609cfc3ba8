"""``skinnode monitor`` without a screen: for programs, and what it says where it cannot run."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skinnode.config import HandConfig
from skinnode.host import Condition, Host
from skinnode.record import Recorder, replay
from tests.commands import run_here
from vcan_sim.fleet import Fleet

from .conftest import PATIENCE_S, PROGRAM, a_hand, write_hand


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return run_here("monitor", *arguments)


@pytest.mark.long
def test_json_for_programs(tmp_path: Path, crossing_hand: HandConfig) -> None:
    """Of a process of its own, on a bus between processes."""
    command = [*PROGRAM, str(write_hand(tmp_path, crossing_hand)), "--json", "--seconds", "3"]
    with Fleet(crossing_hand):
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, stdin=subprocess.DEVNULL
        )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == 3
    newest = lines[-1]
    assert {patch["condition"] for patch in newest["patches"].values()} == {"operational"}
    assert newest["patches"]["p0"]["rate_hz"] == pytest.approx(2.5, abs=0.6)
    assert newest["buses"]["can0"]["level"] == "good"
    assert 0 < newest["latency_s"] < 1


@pytest.mark.long
@pytest.mark.parametrize("seconds", ["1", "3.2"])
def test_json_of_a_hand_that_is_not_there_is_a_fault(tmp_path: Path, seconds: str) -> None:
    done = run(str(write_hand(tmp_path, a_hand(2))), "--json", "--seconds", seconds)
    assert done.returncode == 1
    newest = json.loads(done.stdout.splitlines()[-1])
    assert {patch["condition"] for patch in newest["patches"].values()} == {"never seen"}
    assert done.stderr.splitlines() == ["fault: p0: never seen", "fault: p1: never seen"]


@pytest.mark.long
@pytest.mark.real_time
def test_json_of_a_recording(tmp_path: Path) -> None:
    hand, path = a_hand(2, sync={"period_ms": 200}), tmp_path / "run.log"
    with Fleet(hand), Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder) as host:
        for name in ("p0", "p1"):
            while host.health(name).condition is not Condition.OPERATIONAL:
                time.sleep(0.05)
        time.sleep(1.5)
    solved = len(list(replay(path)))
    done = run("--replay", str(path), "--speed", "10", "--json")
    assert done.returncode == 0, done.stderr
    newest = json.loads(done.stdout.splitlines()[-1])
    assert sum(patch["scan"] is not None for patch in newest["patches"].values()) == 2
    assert solved > 4


@pytest.mark.long
def test_a_recording_that_is_not_all_there_is_a_fault(tmp_path: Path) -> None:
    """As `skinnode replay` says of it: killed, and damaged."""
    hand, path = a_hand(1, sync={"period_ms": 100}), tmp_path / "run.log"
    with Fleet(hand), Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder):
        time.sleep(1.0)
    journal = path.with_suffix(".jsonl")
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(line for line in lines if '"ended"' not in line))
    path.write_text(path.read_text() + "no frame\n")
    done = run("--replay", str(path), "--speed", "4", "--json")
    said = [line for line in done.stderr.splitlines() if "run.log" in line]
    assert done.returncode == 1
    assert len(said) == 2
    assert said[0].startswith("fault: run.log line ")
    assert said[1].startswith("fault: run.log was not ended properly: readable up to ")
    played = run_here("replay", str(path), "--fast")
    assert played.stdout.splitlines()[1:] == said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--simulate"], "standard input and output: got no terminal, allowed: a terminal, or --json"),
        (
            ["--json"],
            "HAND.toml: got nothing, allowed: one of HAND.toml, --simulate, --replay",
        ),
        (["--json", "--simulate", "-o", "/dev/null"], "--output: got '/dev/null', allowed: a folder"),
        (["--json", "--simulate", "-o", ""], "--output: got '', allowed: a folder"),
        (["--json", "/nowhere.toml"], "nowhere.toml"),
        (["--json", "--replay", "/nowhere.log"], "nowhere"),
        (["--json", "--replay", "/x.log", "--interface", "pcan"], "--interface: got 'pcan', allowed: only"),
        (["--json", "--simulate", "--channel", "can1"], "--channel: got 'can1', allowed: only without"),
        (["--json", "--simulate", "--scene", "/nowhere.toml"], "/nowhere.toml"),
        (["--json", "--simulate", "--speed", "2"], "--speed: got 2.0, allowed: only with --replay"),
    ],
)
def test_what_cannot_run_is_one_line(arguments: list[str], said: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr


def test_without_textual_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "textual", None)
    done = run("--simulate")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "sh install.sh tui" in done.stderr


@pytest.mark.long
@pytest.mark.real_time
def test_simulated_patches_are_a_hand_to_begin_with() -> None:
    done = run("--simulate", "--json", "--seconds", "2")
    newest = json.loads(done.stdout.splitlines()[-1])
    assert set(newest["patches"]) == {"palm", "thumb", "index", "middle"}
    assert all(patch["rate_hz"] > 0 for patch in newest["patches"].values()), done.stderr


@pytest.mark.long
@pytest.mark.real_time
def test_the_simulated_patches_play_a_scene(tmp_path: Path) -> None:
    """Without a scene, a sphere presses on each patch."""
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'bodies = [{ name = "ball", shape = "sphere", radius_m = 0.01 }]\n'
        '[[touches]]\nbody = "ball"\npatch = "thumb"\nat_m = [0.016, 0.016]\n'
        "force_n = 2.0\nfrom_s = 0.1\nto_s = 60.0\n"
    )
    done = run("--simulate", "--scene", str(scene), "--json", "--seconds", "5")
    newest = json.loads(done.stdout.splitlines()[-1])["patches"]
    assert {name for name, patch in newest.items() if patch["touches"]} == {"thumb"}, done.stderr
