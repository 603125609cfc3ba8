"""``vcan-sim`` as a user runs it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from tests.lanes import some_long
from vcan_sim.cli import main

COMMAND = [sys.executable, "-c", "from vcan_sim.cli import main; main()"]
HAND = """
[[buses]]
name = "can0"
interface = "virtual"
channel = "{channel}"

[[patches]]
name = "thumb"
node_id = 3
tolerances = "exact"

[[patches]]
name = "index"
node_id = 4
tolerances = "exact"
"""


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    file = tmp_path / "hand.toml"
    file.write_text(HAND.format(channel=uuid.uuid4().hex))
    return file


def run(argv: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(argv)
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_runs_for_the_seconds_asked_with_a_line_each(hand: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run([str(hand), "--seconds", "1.5"], capsys)
    assert (status, err) == (0, "")
    first, *progress, last = out.splitlines()
    assert "2 patches" in first
    assert "virtual" in first
    assert [float(line.split()[0]) for line in progress] == [1.0, 1.5]
    for line in progress:
        assert "thumb pre-operational 0 scans" in line  # nobody has started it
        assert "index pre-operational 0 scans" in line
    assert last.startswith("sent 0 scans")


@pytest.mark.long
@pytest.mark.parametrize("number", some_long([signal.SIGINT, signal.SIGTERM], signal.SIGINT))
def test_ends_cleanly_when_told(hand: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [*COMMAND, str(hand)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert "2 patches" in process.stdout.readline()
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert err == ""
    assert re.search(r"sent 0 scans in \d+ frames from 2 nodes\n$", out)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (HAND.replace("node_id = 4", "node_id = 3"), ["hand.toml", "patches[1].node_id", "3"]),
        (HAND + "code_bit = 16", ["hand.toml", "patches[1].code_bit", "did you mean code_bits"]),
        (HAND.replace('name = "can0"', 'name = "can0'), ["hand.toml", "line 3"]),
        (HAND.replace("virtual", "no-such-thing"), ["no-such-thing"]),
        (
            HAND + "\n[simulation]\ndepth = 1.5\n",
            ["simulation.depth", "1.5", "non-negative number below 1"],
        ),
    ],
)
def test_a_bad_hand_is_one_line_and_status_2(
    text: str, names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "hand.toml"
    file.write_text(text.format(channel="c"))
    status, out, err = run([str(file), "--seconds", "0"], capsys)
    assert status == 2
    assert out == ""
    assert err.count("\n") == 1
    for name in names:
        assert name in err


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = run([str(tmp_path / "none.toml")], capsys)
    assert status == 2
    assert err.count("\n") == 1
    assert "none.toml" in err


def test_options_replace_interface_and_channel(hand: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run([str(hand), "--channel", "elsewhere", "--seconds", "0"], capsys)
    assert status == 0
    assert "elsewhere" in out
    status, _, err = run([str(hand), "--interface", "no-such-thing", "--seconds", "0"], capsys)
    assert status == 2
    assert "no-such-thing" in err
