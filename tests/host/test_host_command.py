"""``skinnode host`` as its user meets it: two processes on a bus, Ctrl-C, exit statuses, one-line errors."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import tomllib
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from skinnode.cli._run_report import faults_and_notes, final_state_text, operational_text
from skinnode.cli.main import main
from skinnode.config import BusConfig, HandConfig, load_hand, parse_hand
from skinnode.host import Host
from skinnode.process import clock
from skinnode.transport import CanPort
from skinnode.transport.receiver import drain
from tests.commands import Output, run_until_signal
from vcan_sim.commands.run import _too_slow
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet
from vcan_sim.sensor import SimulatedPatch

from .conftest import SMALL, eventually

pytestmark = pytest.mark.system_time

TWO_ROLES: Any = {
    "buses": [
        {"name": "can0", "interface": "virtual", "channel": "a"},
        {"name": "can1", "interface": "virtual", "channel": "b", "role": "guest", "guest_sends": "sdo"},
    ],
    "sync": {"period_ms": 80},
    "patches": [{"name": "palm", "node_id": 1}, {"name": "heel", "node_id": 1, "bus": "can1"}],
}
HOST = [sys.executable, "-W", "error", "-c", "from skinnode.cli.main import main; main()", "host"]
SIMULATOR = [sys.executable, "-W", "error", "-c", "from vcan_sim.cli import main; main()"]
PATIENCE_S = 60.0
TABLE = """
[[buses]]
name = "can0"
interface = "{interface}"
channel = "{channel}"

[sync]
period_ms = 200

[[patches]]
name = "thumb"
node_id = 11
tolerances = "exact"
layout = {layout}

[[patches]]
name = "index"
node_id = 12
tolerances = "exact"
layout = {layout}
"""
LAYOUT = "{ " + ", ".join(f"{key} = {value}" for key, value in SMALL.items()) + " }"


def write_hand(folder: Path, interface: str, channel: str) -> Path:
    path = folder / "hand.toml"
    path.write_text(TABLE.format(interface=interface, channel=channel, layout=LAYOUT))
    return path


class Process:
    """A command with its output as it comes."""

    def __init__(self, command: list[str]) -> None:
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        self.lines.extend(line.rstrip("\n") for line in self.child.stdout)

    def says(self, text: str) -> bool:
        """Whether a line with ``text`` comes."""
        return eventually(
            lambda: any(text in line for line in self.lines) or self.child.poll() is not None, PATIENCE_S
        ) and any(text in line for line in self.lines)

    def end(self, number: int | None = None) -> tuple[int, str]:
        """Exit status and stderr, after signal ``number``."""
        if number is not None:
            self.child.send_signal(number)
        try:
            status = self.child.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
            raise
        finally:
            self._reader.join()
            assert self.child.stderr is not None
            errors = self.child.stderr.read()
            self.child.stderr.close()
            assert self.child.stdout is not None
            self.child.stdout.close()
        return status, errors


@contextmanager
def process(command: list[str]) -> Iterator[Process]:
    running = Process(command)
    try:
        yield running
    finally:
        if running.child.poll() is None:
            running.end(signal.SIGKILL)


@pytest.fixture
def shared(tmp_path: Path, crossing_bus: BusConfig) -> tuple[Path, BusConfig]:
    """A hand on a bus that crosses processes."""
    bus = crossing_bus
    return write_hand(tmp_path, bus.interface, bus.channel), bus


def heartbeats(bus: BusConfig) -> dict[int, int]:
    """The newest state that each node says in the next second."""
    with CanPort(bus) as port:
        return {
            frame.can_id - 0x700: frame.data[0] for frame in drain(port, 1.0) if frame.can_id & 0x780 == 0x700
        }


@pytest.mark.real_time
def test_two_processes_on_one_bus(shared: tuple[Path, BusConfig]) -> None:
    path, bus = shared
    with process([*SIMULATOR, str(path)]) as simulator, process([*HOST, str(path), "--json"]) as host:
        assert host.says('"elapsed_s"')
        assert eventually(lambda: sum('"elapsed_s"' in line for line in host.lines) >= 2)
        assert host.end(signal.SIGINT) == (0, ""), host.lines[-3:]
        last = json.loads([line for line in host.lines if "elapsed_s" in line][-1])
        assert set(last["patches"]) == {"thumb", "index"}
        for patch in last["patches"].values():
            assert patch["condition"] == "operational"
            assert patch["solved"] > 0
            assert patch["torn"] == patch["missed"] == patch["chunks_lost"] == 0
        assert json.loads(host.lines[-1]) == {"note": "nodes are pre-operational"}
        assert heartbeats(bus) == {11: 127, 12: 127}
        status, errors = simulator.end(signal.SIGTERM)
        assert (status, errors) == (0, "")


@pytest.mark.long
def test_host_that_is_killed_is_followed_by_another(shared: tuple[Path, BusConfig]) -> None:
    """The nodes go on without it; the next one takes them up."""
    path, bus = shared
    with Fleet(load_hand(path)):
        with process([*HOST, str(path)]) as killed:
            assert killed.says("thumb operational")
            killed.end(signal.SIGKILL)
        assert heartbeats(bus) == {11: 5, 12: 5}
        arguments = ["host", str(path), "--json"]
        done = run_until_signal(signal.SIGINT, *arguments, when=lambda said: said.has('"elapsed_s"', 2))
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.count('"elapsed_s"') >= 2


def test_interrupted_while_it_waits_for_nodes(shared: tuple[Path, BusConfig]) -> None:
    path, bus = shared
    with CanPort(bus) as listener:
        done = run_until_signal(signal.SIGINT, "host", str(path), when=lambda _: listener.recv(PATIENCE_S))
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.long
def test_wrong_length_is_one_line_and_status_2(shared: tuple[Path, BusConfig]) -> None:
    path, bus = shared

    def disturb(said: Output) -> None:
        assert said.has("operational on can0")
        with CanPort(bus) as stranger:
            stranger.send(0x18B, bytes(7))
        assert said.has(" s  can0", 2)

    with Fleet(load_hand(path)):
        done = run_until_signal(signal.SIGINT, "host", str(path), when=disturb)
    line = "COB-ID 0x18B: got 7 bytes (00 00 00 00 00 00 00), allowed: 8 bytes (chunk)"
    assert done.returncode == 2
    rest = "further malformed frames with this COB-ID are counted but not logged"
    assert done.stderr.splitlines() == [f"can0: {line}; {rest}"]
    assert done.stdout.splitlines()[-1] == "nodes are pre-operational"


def test_patches_that_vanish_are_named_and_status_1(shared: tuple[Path, BusConfig]) -> None:
    path, _ = shared
    with Fleet(load_hand(path)) as fleet:

        def vanish(said: Output) -> None:
            assert said.has("thumb operational")
            fleet.inject(Faults(unplugged=True))
            assert said.has(
                "thumb lost (no heartbeat from node 11 for "
            )  # the reason, whatever the condition

        done = run_until_signal(signal.SIGINT, "host", str(path), when=vanish)
    assert done.returncode == 1
    lost = {f"node {node} is lost: no heartbeat" for node in ("11 (thumb)", "12 (index)")}
    assert set(done.stderr.splitlines()) <= lost
    for patch in ("thumb", "index"):
        assert f"fault: {patch}: lost at the end" in done.stdout.splitlines()


@pytest.mark.long
@pytest.mark.real_time
def test_summaries_that_are_lost_are_said_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_hand(tmp_path, "virtual", "lossy")
    path.write_text(path.read_text().replace("period_ms = 200", "period_ms = 50"))
    for _ in range(10):
        with Fleet(load_hand(path), faults=Faults(summary_lost=0.5)):
            status = run(str(path), "--seconds", "2")
        said = capsys.readouterr().out
        if "could not keep up" not in said:  # which would explain the losses
            break
    assert status == 1
    faults = [line for line in said.splitlines() if line.startswith("fault: ")]
    for patch in ("thumb", "index"):
        assert any(re.fullmatch(f"fault: {patch}: [0-9]+ summaries lost", line) for line in faults)


def run(*arguments: str) -> int:
    """Exit status of ``skinnode host`` in this process."""
    with pytest.raises(SystemExit) as caught:
        main(["host", *arguments])
    return int(caught.value.code or 0)


@pytest.fixture
def error_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run ``skinnode host`` with these arguments, which it cannot: the one line that it says."""

    def error(*arguments: str) -> str:
        assert run(*arguments) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        return lines[0]

    return error


def test_no_node_answers(error_of: Callable[..., str], tmp_path: Path, hand: HandConfig) -> None:
    channel = hand.buses[0].channel
    assert error_of(str(write_hand(tmp_path, "virtual", channel))) == (
        f"error: can0: interface 'virtual', channel '{channel}': no response within "
        "3 s from any node: 11 (thumb), 12 (index); "
        "the interface 'virtual' connects only nodes in the same process"
    )


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "node_id = 12",
            "node_id = 11",
            ":18:1: patches[1].node_id: got 11, allowed: a value that patches[0] does not use",
        ),
        (
            "node_id = 12",
            'node_id = 12\neds = "none.eds"',
            ":19:1: patches[1].eds: got 'none.eds', "
            "allowed: the path of an EDS file; there is no file {folder}/none.eds",
        ),
        (
            "period_ms = 200",
            "periode_ms = 200",
            ":8:1: sync.periode_ms: got an unknown key, allowed: a key of this table "
            "(did you mean period_ms?): period_ms, counter_overflow, stagger_ms",
        ),
        (
            "period_ms = 200",
            "period_ms 200",
            ": line 8, column 11: got 'period_ms 200', "
            "allowed: TOML (Expected '=' after a key in a key/value pair)",
        ),
        (
            "period_ms = 200",
            'period_ms = "200"',
            ":8:1: sync.period_ms: got '200', allowed: an integer from 1 to 60000",
        ),
    ],
)
def test_hand_file_that_cannot_be_used(
    error_of: Callable[..., str], tmp_path: Path, old: str, new: str, line: str
) -> None:
    path = write_hand(tmp_path, "virtual", "none")
    path.write_text(path.read_text().replace(old, new))
    assert error_of(str(path)) == f"error: {path}{line.format(folder=tmp_path)}"


def test_no_such_file(error_of: Callable[..., str], tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    assert error_of(str(path)) == (
        f"error: hand file: got '{path}', allowed: a file that can be read (No such file or directory)"
    )


def test_interface_that_does_not_open(error_of: Callable[..., str], tmp_path: Path) -> None:
    path = write_hand(tmp_path, "socketcan", "nocan0")
    line = error_of(str(path))
    assert re.fullmatch(
        r"error: can0: interface 'socketcan', channel 'nocan0': cannot be opened \(.+\), allowed: .+", line
    )
    assert error_of(str(path), "--interface", "smoke-signal").startswith(
        "error: can0: interface 'smoke-signal', channel 'nocan0': no such interface, allowed: "
    )


def test_option_out_of_range_is_the_users_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(str(write_hand(tmp_path, "virtual", "none")), "--seconds", "-1") == 2
    assert "--seconds" in capsys.readouterr().err


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--interface", "--channel", "--seconds", "--json"))


def test_what_is_said_of_a_master_that_is_a_guest_too() -> None:
    """Nothing that holds for one of its buses alone."""
    assert final_state_text(parse_hand(TWO_ROLES)) == (
        "nodes on can0 are pre-operational; nodes on can1 are left to their master"
    )


def test_who_is_awaited_is_not_called_operational(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(bring_up={"missing": "wait"})
    with Fleet(hand.model_copy(update={"patches": hand.patches[:1]})), Host.from_config(hand) as host:
        assert operational_text(host) == f"1 of 2 patches of {hand.name!r} operational (p1 never seen)"


class Busy:
    """A patch whose next reading keeps the computer of its node busy for ``busy_s``."""

    def __init__(self, patch: SimulatedPatch) -> None:
        self._patch, self.busy_s = patch, 0.0

    def read(self, t_ns: int) -> Any:
        busy_s, self.busy_s = self.busy_s, 0.0
        clock.sleep(busy_s)
        return self._patch.read(t_ns)


HELD_UP_S = 0.65
"""Time for which a busy computer keeps its nodes: three SYNC periods."""

SLOW_HEARTBEATS = "\n[bring_up]\nheartbeat_ms = 800\n"
"""Nodes that are silent for two seconds are not lost."""


def held_up_until(source: Busy, said: Callable[[], bool]) -> bool:
    """Hold a node up until ``said`` is true; again if nothing came of it, as after a stall of the machine."""
    for _ in range(10):
        source.busy_s = HELD_UP_S
        if eventually(said, 3.0):
            return True
    return False


@pytest.mark.long
@pytest.mark.real_time
def test_an_overrun_that_was_taken_back_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer that is too slow for its nodes is no fault of the skin."""
    table = TABLE.format(interface="virtual", channel=uuid.uuid4().hex, layout=LAYOUT)
    hand = parse_hand(tomllib.loads(table + SLOW_HEARTBEATS))
    sources: list[Busy] = []

    def wire_up(patch: SimulatedPatch) -> Busy:
        sources.append(Busy(patch))
        return sources[-1]

    with Fleet(hand, wire_up=wire_up) as fleet, Host.from_config(hand) as host:

        def missed() -> bool:
            return (
                host.health("thumb").slow_overruns > 0 < host.stats().patches["thumb"].assembler.scans_missed
            )

        def faulty_and_a_note() -> bool:
            faults, notes = faults_and_notes(host)
            return not faults and any("faulty at the end: EMCY 0x8110" in note for note in notes)

        before = fleet.report()
        assert eventually(lambda: host.stats().patches["thumb"].solved > 3)
        assert held_up_until(sources[0], missed)
        assert "the computer running the node is too slow" in host.health("thumb").emergency_text
        assert eventually(lambda: faults_and_notes(host)[0] == [])
        notes = faults_and_notes(host)[1]
        assert any("because the computer running the node could not keep up" in note for note in notes), notes
        monkeypatch.setattr("skinnode.cli._run_report._OVERRUN_S", 0.0)  # it is not waited for
        monkeypatch.setattr("skinnode.cli._run_report._OVERRUN_SYNCS", 0)
        assert held_up_until(sources[0], faulty_and_a_note)
        monkeypatch.undo()
        after = fleet.report()
        line = _too_slow(before, after)
        assert re.match(r"vcan-sim: this machine is too busy: \d+ of \d+ scans in the last second", line)
        assert _too_slow(after, after) == ""
        fleet.inject(Faults(corrupted=0.5), "thumb")  # nothing that a slow computer would do
        assert eventually(lambda: host.stats().patches["thumb"].assembler.scans_corrupt > 0)
        fleet.inject(NO_FAULTS, "thumb")
        faults, _ = faults_and_notes(host)
        assert any(fault.startswith("thumb:") and "discarded by" in fault for fault in faults), faults


@pytest.mark.long
def test_the_emergency_of_a_faulty_patch_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, channel = tmp_path / "hand.toml", uuid.uuid4().hex
    path.write_text(TABLE.format(interface="virtual", channel=channel, layout=LAYOUT))
    with Fleet(load_hand(path)) as fleet:
        fleet.inject(Faults(open_upper=2), "thumb")
        with pytest.raises(SystemExit) as ended:
            main(["host", str(path), "--seconds", "2"])
    assert ended.value.code == 1
    said = capsys.readouterr().out
    emergency = "EMCY 0x5000 wire open or shorted: upper wire open 2"
    assert f"fault: thumb: faulty at the end: {emergency}" in said
    assert f"thumb faulty ({emergency})  " in said  # in the lines of each second, too


def test_noise_that_is_not_as_in_the_hand_file_is_reported(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(1, simulation={"converter_noise": 1e-4, "depth": 0})
    with Fleet(hand), Host.from_config(hand) as host:

        def report() -> list[str]:
            return [note for note in faults_and_notes(host)[1] if note.startswith("p0: noise is ")]

        assert eventually(lambda: bool(report()))
        found = re.fullmatch(r"p0: noise is (\S+), relative_noise in the hand file is 3.0e-06", report()[0])
        assert found is not None
        assert float(found[1]) == pytest.approx(1e-4, rel=0.4)
        assert not any("noise" in fault for fault in faults_and_notes(host)[0])
