"""Recordings on the real road: every interface, faults and clocks that jump while they run, `--listen`."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from typer.testing import CliRunner

from skinnode.cli.main import app
from skinnode.config import BusConfig, HandConfig, SyncConfig, load_hand, parse_hand
from skinnode.errors import BusError, ConfigError
from skinnode.host import Host
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.transport import CanPort
from tests.commands import virtual_time
from tests.conftest import BETWEEN_PROCESSES, bus_on
from tests.lanes import some_long
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .test_replay import SMALL, key

PATIENCE_S = 20.0


def hand_on(bus: BusConfig) -> HandConfig:
    table = {"name": "can0", "interface": bus.interface, "channel": bus.channel}
    patches = [{"name": f"p{i}", "node_id": 5 + i, "layout": SMALL, "tolerances": "exact"} for i in range(2)]
    return parse_hand({"buses": [table], "patches": patches, "sync": {"period_ms": 50}})


class Run:
    """A hand that is recorded, and the fields that it gave live."""

    def __init__(self, fleet: Fleet, host: Host) -> None:
        self.fleet, self.host = fleet, host
        self.live: dict[tuple[str, int], FieldFrame] = {}
        self._fields = host.fields(capacity=10_000)

    def take(self, fields: int, patch: str = "p0") -> None:
        """Wait for that many more of ``patch``."""
        wanted = self._count(patch) + fields
        end_s = clock.monotonic() + PATIENCE_S
        while self._count(patch) < wanted:
            assert clock.monotonic() < end_s
            field = self._fields.get(0.05)
            if field is not None:
                self.live[key(field)] = field

    def collect(self) -> None:
        while (field := self._fields.get(0.0)) is not None:
            self.live[key(field)] = field

    def _count(self, patch: str) -> int:
        return sum(name == patch for name, _ in self.live)


@pytest.fixture(params=["timed", *BETWEEN_PROCESSES])
def recorded_bus(request: pytest.FixtureRequest, multicast_group: str) -> BusConfig:
    """A bus in virtual time, and each interface that crosses processes."""
    return bus_on(request.param, multicast_group)


def time_of(bus: BusConfig) -> contextlib.AbstractContextManager[object]:
    """The time in which a bus runs."""
    return VirtualClock() if bus.interface == "timed" else contextlib.nullcontext()


@contextlib.contextmanager
def recorded(bus: BusConfig, path: Path) -> Iterator[Run]:
    hand = hand_on(bus)
    with (
        time_of(bus),
        Fleet(hand) as fleet,
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        run = Run(fleet, host)
        yield run
        run.collect()
    assert recorder.stats().failure is None
    assert recorder.stats().dropped == 0


def assert_same(path: Path, live: dict[tuple[str, int], FieldFrame]) -> None:
    """Every field that was solved live comes out of the recording with the same bits."""
    run = replay(path)
    again = {key(field): field for field in run}
    assert (run.log.damaged, run.complaints, run.ended) == (0, [], True)
    assert set(live) <= set(again)
    for which, field in live.items():
        other = again[which]
        assert other.displacement_m.tobytes() == field.displacement_m.tobytes(), which
        assert other.displacement_std_m.tobytes() == field.displacement_std_m.tobytes(), which
        assert other.status == field.status


@pytest.mark.long
def test_a_run_with_faults_is_the_same_again_on_every_interface(
    recorded_bus: BusConfig, tmp_path: Path
) -> None:
    """Chunks that get lost, a scan cut off by a reset, a node that is unplugged and comes back."""
    path = tmp_path / "run.log"
    with recorded(recorded_bus, path) as run:
        run.take(10)
        for faults in (Faults(lost=0.05, late=0.05, reordered=0.05), Faults(reset=1.0)):
            run.fleet.inject(faults, "p0")
            run.take(10, "p1")
            run.fleet.inject(NO_FAULTS)
            run.take(5)
        run.fleet.inject(Faults(unplugged=True), "p0")
        run.take(20, "p1")
        run.fleet.inject(NO_FAULTS)
        run.take(10)
    assert_same(path, run.live)


@pytest.mark.vcan
def test_an_interface_that_goes_down_while_it_is_recorded(tmp_path: Path) -> None:
    bus = BusConfig(name="can0", interface="socketcan", channel="vcan0")
    path = tmp_path / "run.log"
    with recorded(bus, path) as run:
        run.take(10)
        try:
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            end_s = time.monotonic() + PATIENCE_S
            while not run.host.stats().buses["can0"].outages:
                assert time.monotonic() < end_s
                time.sleep(0.05)
        finally:
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
        run.take(10)
        run.take(10, "p1")
    assert_same(path, run.live)


@pytest.mark.vcan
@pytest.mark.skipif(os.environ.get("VCAN_GUEST") != "1", reason="sets the clock: in a guest of its own only")
@pytest.mark.parametrize("jump_s", [3600, -3600])
def test_the_wall_clock_jumps_while_it_is_recorded(tmp_path: Path, jump_s: int) -> None:
    bus = BusConfig(name="can0", interface="socketcan", channel="vcan0")
    path = tmp_path / "run.log"
    begun_s = time.monotonic()
    with recorded(bus, path) as run:
        run.take(10)
        time.clock_settime(time.CLOCK_REALTIME, time.time() + jump_s)
        try:
            run.take(15)
            torn = [stream.assembler.scans_torn for stream in run.host.stats().patches.values()]
        finally:
            time.clock_settime(time.CLOCK_REALTIME, time.time() - jump_s)
        run.take(5)
    assert torn == [0, 0]
    assert_same(path, run.live)
    times_s = [field.stamp.t_receive_ns * 1e-9 for field in replay(path) if field.stamp is not None]
    assert begun_s < min(times_s)
    assert max(times_s) < time.monotonic()


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".log", ".mcap"])
def test_scans_keep_their_numbers_if_the_counter_wraps_while_no_sync_can_be_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    """The counter wraps after 4, so it tells nothing about the 12 periods or more of an outage."""
    bus = BusConfig(name="can0", interface="timed", channel=tmp_path.name)
    hand = hand_on(bus)
    hand = hand.model_copy(update={"sync": SyncConfig(period_ms=25, counter_overflow=4)})
    away, send = threading.Event(), CanPort.send

    def refusing(self: CanPort, can_id: int, *more: Any, **options: Any) -> None:
        if can_id == 0x080 and away.is_set():
            raise BusError("can0: 0x080 not sent (no buffer space)")
        send(self, can_id, *more, **options)

    monkeypatch.setattr(CanPort, "send", refusing)
    path = tmp_path / f"run{suffix}"
    with (
        VirtualClock(),
        Fleet(hand) as fleet,
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        run = Run(fleet, host)
        run.take(10)
        before = max(scan for _, scan in run.live)
        away.set()
        failed = host.stats().sync.failed
        end_s = clock.monotonic() + PATIENCE_S
        while host.stats().sync.failed < failed + 13 and clock.monotonic() < end_s:
            clock.sleep(0.01)
        away.clear()
        run.take(10)
        run.collect()
    assert max(scan for _, scan in run.live) > before + 13 + 8
    played = replay(path)
    again = {key(field): field.displacement_m.tobytes() for field in played}
    assert {which: again.get(which) for which in run.live} == {
        which: field.displacement_m.tobytes() for which, field in run.live.items()
    }
    assert played.flaws == []


@pytest.mark.long
@pytest.mark.parametrize("jump_s", some_long([3600.0, -3600.0, 0.5], -3600.0))
def test_times_in_a_recording_that_jump(tmp_path: Path, jump_s: float) -> None:
    """A clock that was set by whoever wrote the log: the scan it falls into is lost, nobody waits an hour."""
    bus = BusConfig(name="can0", interface="timed", channel=tmp_path.name + str(jump_s))
    path = tmp_path / "run.log"
    with recorded(bus, path) as run:
        run.take(30)
    lines = path.read_text().splitlines()
    half = len(lines) // 2
    moved = []
    for line in lines[half:]:
        stamp, rest = line[1:].split(")", 1)
        moved.append(f"({float(stamp) + jump_s:.6f}){rest}")
    path.write_text("\n".join([*lines[:half], *moved]) + "\n")
    begun_s = time.monotonic()
    again = {key(field) for field in replay(path, speed=2000.0)}
    assert time.monotonic() - begun_s < PATIENCE_S
    assert len(set(run.live) - again) <= 4  # the scan of either patch, and the one that tells


def test_listening_writes_what_is_heard_and_sends_nothing(any_bus: BusConfig, tmp_path: Path) -> None:
    hand, path = tmp_path / "hand.toml", tmp_path / "run.log"
    hand.write_text(
        f'[[buses]]\nname = "can0"\ninterface = "{any_bus.interface}"\nchannel = "{any_bus.channel}"\n'
        '[[patches]]\nname = "thumb"\nnode_id = 5\n'
    )
    over = threading.Event()
    sent: list[int] = []
    heard: list[int] = []

    def talk() -> None:
        with CanPort(any_bus) as port:
            while not over.wait(0.01):
                port.send(0x185, len(sent).to_bytes(8, "little"))
                sent.append(len(sent))
                while (frame := port.recv(0.0)) is not None:
                    heard.append(frame.can_id)

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        options = ["record", str(hand), "-o", str(path), "--listen", "--seconds", "1.0", "--json"]
        done = CliRunner().invoke(app, options)
    finally:
        over.set()
        talker.join()
    assert done.exit_code == 0, done.output
    numbers = [int.from_bytes(message.data, "little") for message in can.CanutilsLogReader(str(path))]
    assert len(numbers) > 30
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert heard == []
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert told[-1] == {"frames": len(numbers), "dropped": 0}
    replayed = CliRunner().invoke(app, ["replay", str(path), "--fast"])
    assert "note: the recording contains no baselines, as after skinnode record --listen; " in replayed.stdout


CHANNEL = "record"
HAND = """
[bring_up]
missing = "wait"
[sync]
period_ms = 100
[[buses]]
name = "can0"
interface = "timed"
channel = "{}"
[[patches]]
name = "thumb"
node_id = 5
layout = {{ {} }}
""".format(CHANNEL, ", ".join(f"{key} = {value}" for key, value in SMALL.items()))


@pytest.mark.parametrize("options", [[], ["--listen"]])
def test_a_recording_that_cannot_begin_leaves_nothing_in_the_way(tmp_path: Path, options: list[str]) -> None:
    hand, path = tmp_path / "hand.toml", tmp_path / "run.log"
    hand.write_text(HAND)
    asked = ["record", str(hand), "-o", str(path), "--seconds", "0.2", *options]
    done = CliRunner().invoke(app, [*asked, "--interface", "nosuch"])
    assert isinstance(done.exception, BusError)
    assert list(tmp_path.iterdir()) == [hand]
    with virtual_time(CHANNEL):
        CliRunner().invoke(app, asked)
    assert path.exists()
    assert path.with_suffix(".jsonl").exists()


def test_a_recording_that_no_node_answers_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    hand = tmp_path / "hand.toml"
    hand.write_text(HAND.replace('"wait"', '"refuse"'))
    with virtual_time(CHANNEL):
        done = CliRunner().invoke(app, ["record", str(hand), "-o", str(tmp_path / "run.log")])
    assert "no response within" in str(done.exception)
    assert list(tmp_path.iterdir()) == [hand]


def test_a_recording_without_a_field_is_a_fault_and_stays(tmp_path: Path) -> None:
    hand, path = tmp_path / "hand.toml", tmp_path / "run.log"
    hand.write_text(HAND)
    with virtual_time(CHANNEL):
        done = CliRunner().invoke(app, ["record", str(hand), "-o", str(path), "--seconds", "1"])
    assert done.exit_code == 1
    assert done.stdout.splitlines()[-1] == "fault: thumb: never seen at the end"
    assert list(replay(path)) == []


def test_a_folder_that_is_not_there_is_made(tmp_path: Path) -> None:
    hand, folder = tmp_path / "hand.toml", tmp_path / "runs" / "today"
    hand.write_text(HAND)
    asked = ["record", str(hand), "-o", str(folder), "--listen", "--seconds", "0.1"]
    with virtual_time(CHANNEL):
        done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0, done.output
    assert sorted(file.suffix for file in folder.iterdir()) == [".jsonl", ".log"]


def test_what_cannot_be_a_folder_is_one_line(tmp_path: Path) -> None:
    hand, taken = tmp_path / "hand.toml", tmp_path / "taken"
    hand.write_text(HAND)
    taken.touch()
    too_long = tmp_path / ("x" * 300)
    for name in (taken, taken / "below", tmp_path / "run.txt", too_long, too_long.with_suffix(".log")):
        done = CliRunner().invoke(app, ["record", str(hand), "-o", str(name)])
        said = str(done.exception)
        assert said.startswith(f"recording: got '{str(name)[:150]}")  # long ones are shown in part
        assert "', allowed: a folder " in said


def test_an_empty_name_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("hand.toml").write_text(HAND)
    done = CliRunner().invoke(app, ["record", "hand.toml", "-o", ""])
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception) == (
        "recording: got '', allowed: a folder (created if needed), or a file ending in .log, .blf or .mcap"
    )
    assert list(tmp_path.iterdir()) == [tmp_path / "hand.toml"]


@pytest.mark.parametrize("name", ["", ".", "/"])
def test_what_has_no_name_is_no_recording(name: str) -> None:
    with pytest.raises(
        ConfigError, match=r"^recording: got '[./]', allowed: a file ending in .log, .blf, .asc or .mcap$"
    ):
        replay(name)


@pytest.mark.long
def test_two_logs_of_one_name_in_a_folder_have_a_journal_each(tmp_path: Path) -> None:
    hand = hand_on(BusConfig(interface="timed", channel="two-logs"))
    live: dict[str, set[tuple[str, int]]] = {}
    for suffix in (".log", ".blf"):
        with (
            VirtualClock(),
            Fleet(hand),
            Recorder(hand, tmp_path / f"run{suffix}") as recorder,
            Host.from_config(hand, tap=recorder) as host,
        ):
            fields = host.fields(capacity=1000)
            clock.sleep(0.4 if suffix == ".log" else 0.8)
        live[suffix] = set()
        while (field := fields.get(0.0)) is not None:
            live[suffix].add(key(field))
    for suffix, wanted in live.items():
        run = replay(tmp_path / f"run{suffix}")
        assert {key(field) for field in run} >= wanted > set()
        assert run.flaws == []  # such as a journal of another number of frames


@pytest.mark.long
def test_scans_that_were_skipped_are_noted_as_a_replay_counts_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand, path = tmp_path / "hand.toml", tmp_path / "run.log"
    hand.write_text(HAND.replace("period_ms = 100", "period_ms = 25"))
    solve = ScanSolver.solve

    def slowly(self: ScanSolver, *arguments: Any) -> Any:
        clock.sleep(0.1)
        return solve(self, *arguments)

    with VirtualClock(), Fleet(load_hand(hand)), monkeypatch.context() as patched:
        patched.setattr(ScanSolver, "solve", slowly)
        done = CliRunner().invoke(app, ["record", str(hand), "-o", str(path), "--seconds", "2"])
    run = replay(path)
    solved = len(list(run))
    skipped = run.patch_stats()["thumb"].skipped
    assert skipped > solved
    (note,) = [line for line in done.stdout.splitlines() if "skipped in favour of newer" in line]
    expected = r"note: thumb: (\d+) scans skipped in favour of newer scans; their frames were recorded"
    found = re.fullmatch(expected, note)
    assert found is not None
    assert abs(int(found[1]) - skipped) <= 1  # a scan may be skipped while the host closes
