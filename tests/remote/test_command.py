"""``skinnode host --publish`` as its user meets it, and the one line that says why it cannot run."""

from __future__ import annotations

import importlib.util
import socket
import threading
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

import skinnode as sk
from skinnode.cli.main import main
from skinnode.config import load_hand
from skinnode.errors import ConfigError
from tests.remote.conftest import Process
from vcan_sim.fleet import Fleet

pytestmark = pytest.mark.system_time

TABLE = """
name = "right hand"
[[buses]]
name = "can0"
interface = "virtual"
channel = "{channel}"

[[patches]]
name = "thumb"
node_id = 11
tolerances = "exact"
layout = {{ upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4 }}
"""


@pytest.fixture
def hand_file(tmp_path: Path) -> Path:
    path = tmp_path / "hand.toml"
    path.write_text(TABLE.format(channel=uuid.uuid4().hex[:8]))
    return path


def said(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(["host", *arguments])
    return int(str(ended.value.code or 0)), capsys.readouterr().err


@pytest.mark.long
def test_a_program_uses_the_hand_of_the_command(
    hand_file: Path, port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    scans: list[int] = []

    def use() -> None:
        with sk.connect("right hand", port=port, timeout_s=60.0) as hand:
            for field in hand.fields(timeout_s=30.0):
                assert field.stamp is not None
                scans.append(field.stamp.scan)
                if len(scans) == 5:
                    hand.tare("thumb")
                    return

    program = threading.Thread(target=use)
    program.start()
    options = ["--publish", "--commands", "--zenoh-port", str(port), "--seconds", "5"]
    with Fleet(load_hand(hand_file)), pytest.raises(SystemExit) as ended:
        main(["host", str(hand_file), *options])
    program.join(60.0)
    notes = capsys.readouterr()
    assert len(scans) == 5
    assert "published as 'right hand', with commands" in notes.out + notes.err
    assert ended.value.code in (0, 1)  # 1 if this computer was too slow for the simulated nodes


@pytest.mark.long
def test_a_second_daemon_is_refused_before_it_opens_a_bus(
    start: Callable[..., Process], hand_file: Path, port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    start(name="right hand").wait_until_up()
    status, text = said([str(hand_file), "--publish", "--zenoh-port", str(port)], capsys)
    assert status == 2
    assert f"{hand_file}:2:" in text
    assert "name: got 'right hand', allowed: a hand that no other daemon publishes" in text
    assert text.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--commands"], "--commands: got no --publish, allowed: only with --publish"),
        (["--router", "tcp/robot:7447"], "--router: got 'tcp/robot:7447', allowed: only with --publish"),
        (["--zenoh-port", "9000"], "--zenoh-port: got 9000, allowed: only with --publish"),
        (["--publish", "--zenoh-port", "80"], "--zenoh-port: got 80, allowed: an integer from 1024 to 65520"),
        (["--publish", "--listen", "robot"], "--listen: got 'robot', allowed: an endpoint such as tcp/"),
        (["--publish", "--commands", "--listen", "tcp/0.0.0.0:7447"], "--commands: got tcp/0.0.0.0:7447"),
        (
            ["--publish", "--zenoh-config", "/nowhere"],
            "--zenoh-config: got '/nowhere', allowed: a Zenoh conf",
        ),
        (
            ["--publish", "--listen", "tls/127.0.0.1:7450"],
            "--listen: got 'tls/127.0.0.1:7450', allowed: a free",
        ),
    ],
)
def test_a_wrong_option_is_one_line(
    hand_file: Path, port: int, options: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if options[0] == "--publish" and "--zenoh-port" not in options:
        options = [*options, "--zenoh-port", str(port)]
    status, text = said([str(hand_file), *options], capsys)
    assert (status, text.count("\n")) == (2, 1)
    assert line in text


def test_ports_in_use_are_one_line(hand_file: Path, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    taken = [socket.create_server(("127.0.0.1", port + i)) for i in range(16)]
    status, text = said([str(hand_file), "--publish", "--zenoh-port", str(port)], capsys)
    for each in taken:
        each.close()
    assert (status, text.count("\n")) == (2, 1)
    assert f"--zenoh-port: got {port}, allowed: a free port from {port} to {port + 15}" in text
    with socket.create_server(("127.0.0.1", port)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        free = [str(hand_file), "--publish", "--zenoh-port", str(port), "--listen", endpoint]
        status, text = said(free, capsys)
    assert (status, text.count("\n")) == (2, 1)
    assert f"--listen: got '{endpoint}', allowed: a free endpoint" in text


def test_a_missing_extra_is_one_line(
    hand_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "skinnode.remote.session.find_spec", lambda name: None if name == "zenoh" else find_spec(name)
    )
    status, text = said([str(hand_file), "--publish"], capsys)
    assert status == 2
    assert text == (
        "error: --publish: got no package eclipse-zenoh, allowed: the packages of the zenoh extra "
        "(install: sh install.sh zenoh)\n"
    )
    with pytest.raises(ConfigError, match="connect: got no package eclipse-zenoh"):
        sk.connect("right hand")
