"""What ``skinnode view`` says where it cannot run: one line, exit status 2."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path
from unittest import mock

import pytest

from skinnode.view import viewer_process
from tests.commands import run_here


def run(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    with mock.patch.dict(os.environ, {**kept, **variables}, clear=True):
        return run_here("view", *arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            [],
            "HAND.toml: got nothing, allowed: one of HAND.toml, --simulate, --replay",
        ),
        (["--simulate", "--replay", "x.log"], "--simulate: got both it and --replay"),
        (["--simulate"], "display: got none, allowed: a graphical session, or --web, or --save FILE.rrd"),
        (["/nowhere.toml", "--web"], "nowhere.toml"),
        (["--replay", "/nowhere.log", "--web"], "nowhere"),
        (["--replay", "/nowhere.log", "--save", "x.rrd"], "nowhere"),
        (
            ["--replay", "/nowhere.log", "--save", "x.rrd", "--seconds", "2"],
            "--seconds: got 2.0, allowed: with --replay and --save only together with --speed",
        ),
        (["--replay", "/nowhere.log", "--save", "x.rrd", "--rate", "2"], "--rate: got 2.0, allowed: with"),
        (["--simulate", "--speed", "2", "--web"], "--speed: got 2.0, allowed: only with --replay"),
        (["--simulate", "--channel", "can1", "--web"], "--channel: got 'can1', allowed: only without"),
        (
            ["/nowhere.toml", "--scene", "press", "--web"],
            "--scene: got 'press', allowed: only with --simulate",
        ),
        (
            ["--simulate", "--scene", "nothing", "--web"],
            "--scene: got 'nothing', allowed: a scene file, or one",
        ),
        (["--simulate", "--port", "9000"], "--port: got 9000, allowed: only with --web"),
        (["--simulate", "--address", "0.0.0.0"], "--address: got '0.0.0.0', allowed: only with --web"),
        (["--simulate", "--web", "--address", "nowhere at all"], "port: got 'nowhere at all:9090', allowed"),
        (["--simulate", "--web", "--port", "0"], "--port"),
        (["--simulate", "--rate", "0"], "--rate"),
        (["--simulate", "--rate", "nan"], "--rate"),
        (["--simulate", "--exaggerate", "-1"], "--exaggerate"),
        (["--simulate", "--save", ""], "--save: got '', allowed: a file name that ends in .rrd"),
        (["--simulate", "--save", "/nowhere/x.rrd"], "a file that can be created (No such file"),
        (["--simulate", "--save", "/proc/x.rrd"], "a file that can be created ("),
    ],
)
def test_what_cannot_run_is_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sdk: None
) -> None:
    monkeypatch.chdir(tmp_path)  # other cases, which may run at the same time, create the file for a moment
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr
    assert not Path("x.rrd").exists()


def test_a_hand_that_cannot_run_leaves_no_file(tmp_path: Path, sdk: None) -> None:
    """The next attempt would be refused because of it."""
    hand, saved = tmp_path / "hand.toml", tmp_path / "hand.rrd"
    hand.write_text(
        '[[buses]]\nname = "can0"\ninterface = "socketcan"\nchannel = "no_such_bus"\n'
        '[[patches]]\nname = "p0"\nnode_id = 5\ntolerances = "exact"\n'
        "layout = { upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4 }\n"
    )
    for _ in range(2):
        done = run(str(hand), "--save", str(saved))
        assert (done.returncode, done.stdout) == (2, "")
        assert "no_such_bus" in done.stderr
        assert not saved.exists()


def test_a_port_in_use_is_one_line(sdk: None) -> None:
    with socket.socket() as used:
        used.bind(("127.0.0.1", 0))
        used.listen()
        port = used.getsockname()[1]
        for taken in (port, port - 1):  # the page, and the data at the next port
            done = run("--simulate", "--web", "--port", str(taken))
            assert (done.returncode, done.stdout) == (2, "")
            assert done.stderr == (
                f"error: port: got '127.0.0.1:{port}', allowed: a free port (Address already in use)\n"
            )


def test_without_the_sdk_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_process, "find_spec", lambda name: None)
    done = run("--simulate")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "error: skinnode view: got no package rerun-sdk, "
        "allowed: the package rerun-sdk (sh install.sh view)\n"
    )


def test_a_display_that_does_not_exist_is_one_line(sdk: None) -> None:
    done = run("--simulate", DISPLAY=":99")
    assert (done.returncode, done.stdout) == (2, "")
    errors = [
        line for line in done.stderr.splitlines() if not line.startswith("node ")
    ]  # from the host's log
    assert len(errors) == 1
    assert errors[0].startswith("error: the viewer ended: ")
