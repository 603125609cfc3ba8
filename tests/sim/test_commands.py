"""``vcan-sim`` and a second process that controls it."""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vcan_sim.cli import main
from vcan_sim.control import ControlError, control_folder, running_simulator
from vcan_sim.scenes import read_scene
from vcan_sim.scenes.library import shipped_scenes

COMMAND = [sys.executable, "-c", "from vcan_sim.cli import main; main()"]
PATIENCE_S = 40.0
HAND = """
name = "gripper"

[[buses]]
name = "can0"
interface = "udp_multicast"
channel = "{channel}"

[[patches]]
name = "palm"
node_id = 4
layout = {{upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4}}
tolerances = "exact"

[[patches]]
name = "thumb"
node_id = 5
layout = {{upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4}}
tolerances = "exact"
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """A runtime folder that no other simulator uses."""
    return os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    file = tmp_path / "hand.toml"
    channel = f"239.77.{random.randrange(256)}.{random.randrange(1, 255)}"
    file.write_text(HAND.format(channel=channel))
    return file


class Simulator:
    """A simulator in a process of its own."""

    def __init__(self, environment: dict[str, str], *arguments: str) -> None:
        self.environment = environment
        self.process = subprocess.Popen(
            [*COMMAND, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        assert self.process.stdout is not None
        first = self.process.stdout.readline()
        assert "press Ctrl-C" in first, first + self.process.stdout.read()

    def end(self) -> list[str]:
        """End the simulator with Ctrl-C; the lines that it has printed since."""
        self.process.send_signal(2)
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 0, out
        return out.splitlines()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def start(environment: dict[str, str]) -> Iterator[Callable[..., Simulator]]:
    started: list[Simulator] = []

    def begin(*arguments: str) -> Simulator:
        started.append(Simulator(environment, *arguments))
        return started[-1]

    yield begin
    for simulator in started:
        simulator.kill()


Ended = tuple[int, str, str]
"""Exit status, stdout and stderr of a command."""


@pytest.fixture
def vcan_sim(
    environment: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    """Run a command in the process of the tests."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", environment["XDG_RUNTIME_DIR"])

    def run(*arguments: str) -> Ended:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    return run


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.1)


def test_inject_from_a_second_process(
    hand: Path,
    environment: dict[str, str],
    start: Callable[..., Simulator],
    vcan_sim: Callable[..., Ended],
) -> None:
    simulator = start("run", str(hand))
    done = subprocess.run(
        [*COMMAND, "inject"], capture_output=True, text=True, env=environment, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{place}: none now; nothing so far" for place in ("palm", "thumb", "can0")
    ]
    status, out, err = vcan_sim("inject", "palm:unplugged", "can0:rogue_nmt_per_s=50")
    assert (status, err) == (0, "")
    assert out.startswith("palm: unplugged now; ")
    assert "\ncan0: rogue_nmt_per_s=50.0 now; " in out

    def counted() -> bool:
        out = vcan_sim("inject")[1]
        return "palm: unplugged now; " in out and bool(
            re.search(r"1 unplugged", out) and re.search(r"[1-9]\d* rogue_nmt", out)
        )

    until(counted)
    assert vcan_sim("inject", "none")[1].startswith("palm: none now; ")
    said = simulator.end()
    assert any(line.startswith("palm: ") and "1 unplugged" in line for line in said)
    assert any(line.startswith("can0: ") and "rogue_nmt" in line for line in said)
    status, out, err = vcan_sim("inject")
    assert (status, out) == (2, "")
    assert err == "error: no simulator is running; start one with: vcan-sim run HAND.toml\n"


BAD_TEXTS = {
    "plam:unplugged": "inject: got 'plam', allowed: a patch of the hand: palm, thumb; or a bus: can0",
    "palm:lost=2": "lost: got 2.0, allowed: a fraction from 0 to 1",
    "can0:disturbed=0.1": "only the interface timed",
}


@pytest.mark.long
def test_a_bad_text_is_one_line_and_status_2(
    hand: Path, start: Callable[..., Simulator], vcan_sim: Callable[..., Ended]
) -> None:
    start(str(hand))
    for text, words in BAD_TEXTS.items():
        status, out, err = vcan_sim("inject", "thumb:silent", text)
        assert (status, out) == (2, "")
        assert err.count("\n") == 1
        assert words in err
        assert "none now" in vcan_sim("inject")[1].splitlines()[1]


@pytest.mark.long
def test_several_simulators_are_told_apart(
    hand: Path,
    environment: dict[str, str],
    start: Callable[..., Simulator],
    vcan_sim: Callable[..., Ended],
) -> None:
    first = start(str(hand))
    other = hand.with_name("other.toml")
    other.write_text(hand.read_text().replace("gripper", "foot"))
    second = start(str(other))
    status, _, err = vcan_sim("inject", "palm:silent")
    assert status == 2
    for simulator, name in ((first, "gripper"), (second, "foot")):
        assert f"{simulator.process.pid} ({name})" in err
    status, out, _ = vcan_sim("inject", "palm:silent", "--simulator", "foot")
    assert (status, out.splitlines()[0].split(";")[0]) == (0, "palm: silent now")
    out = vcan_sim("inject", "--simulator", str(first.process.pid))[1]
    assert out.startswith("palm: none now")
    second.kill()  # its socket stays, and is removed
    out = vcan_sim("inject")[1]
    assert out.startswith("palm: none now")
    folder = Path(environment["XDG_RUNTIME_DIR"]) / "vcan-sim"
    assert [path.stem for path in folder.iterdir()] == [str(first.process.pid)]
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_folder_must_be_the_users_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "vcan-sim").mkdir(mode=0o755)
    with pytest.raises(ControlError, match="mode 700"):
        control_folder()
    (tmp_path / "vcan-sim").chmod(0o700)
    assert control_folder() == tmp_path / "vcan-sim"
    with pytest.raises(ControlError, match="no simulator is running"):
        running_simulator()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "nowhere"))
    with pytest.raises(ControlError, match="nowhere"):
        control_folder()


def test_a_run_is_recorded_and_replayed(hand: Path, vcan_sim: Callable[..., Ended]) -> None:
    folder = hand.with_name("run")
    record = ["run", str(hand), "--record", str(folder), "--fault", "palm:babble_per_s=50", "--seconds", "1"]
    status, out, err = vcan_sim(*record)
    assert (status, err) == (0, "")
    assert out.splitlines()[-1] == f"recorded to {folder}"
    assert sorted(path.name for path in folder.iterdir()) == ["faults.jsonl", "trace.log", "truth.npz"]
    frames = (folder / "trace.log").read_text().splitlines()
    assert sum(" 3F0#" in line for line in frames) > 10
    for recording in (folder, folder / "trace.log"):
        status, out, err = vcan_sim("replay", str(recording), "--hand", str(hand))
        assert (status, err) == (0, "")
        assert f"sent {len(frames)} frames in " in out
    status, out, err = vcan_sim(*record)
    assert (status, out) == (2, "")
    assert err.startswith("error: --record: got ")
    status, out, err = vcan_sim("replay", str(hand.parent))
    assert (status, out) == (2, "")
    assert err.startswith("error: RECORDING: got ")


def test_scenes_that_come_with_the_simulator(vcan_sim: Callable[..., Ended]) -> None:
    status, out, err = vcan_sim("list")
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()] == ["faults", "press", "taps"]
    for path in shipped_scenes().values():
        assert read_scene(path).name in out


def test_a_mistyped_scene_is_answered_with_the_names(vcan_sim: Callable[..., Ended], hand: Path) -> None:
    status, out, err = vcan_sim(str(hand), "--scene", "prss")
    assert (status, out) == (2, "")
    assert err == "error: --scene: got 'prss', allowed: a scene file, or one of faults, press, taps\n"


def test_help_names_the_commands(vcan_sim: Callable[..., Ended]) -> None:
    status, out, _ = vcan_sim("--help")
    assert status == 0
    for name in ("run", "inject", "list", "replay"):
        assert name in out
