"""A live run and its replay give the same bits; recordings that were killed or damaged are read."""

from __future__ import annotations

import dataclasses
import json
import random
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from skinnode.cli._contacts import contact_tables
from skinnode.cli.main import app
from skinnode.config import BringUpConfig, HandConfig, load_hand, parse_hand
from skinnode.errors import ConfigError
from skinnode.host import Condition, Host
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import FrameLog, LoggedFrame
from skinnode.transport.frame_log_reader import FrameLogReader
from tests.lanes import some_long
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
T_NS = 1_790_000_000_000_000_000


def a_hand() -> HandConfig:
    """A hand of two patches on a bus of its own in virtual time."""
    bus = {"name": "can0", "interface": "timed", "channel": uuid.uuid4().hex[:8]}
    patches = [{"name": f"p{i}", "node_id": 5 + i, "layout": SMALL, "tolerances": "exact"} for i in range(2)]
    return parse_hand({"buses": [bus], "patches": patches, "sync": {"period_ms": 25}})


def key(field: FieldFrame) -> tuple[str, int]:
    assert field.stamp is not None
    return field.stamp.patch, field.stamp.scan


@pytest.mark.parametrize(
    ("suffix", "unchecked"),
    some_long(
        [(".log", ()), (".blf", ()), (".mcap", ()), (".log", ("p0", "p1")), (".log", ("p1",))],
        (".log", ()),
        (".log", ("p1",)),
    ),
    ids=["log", "blf", "mcap", "all nodes of revision 1.0", "one node of revision 1.0"],
)
def test_a_replay_gives_the_bits_of_the_live_run(
    tmp_path: Path, suffix: str, unchecked: tuple[str, ...]
) -> None:
    hand, path = a_hand(), tmp_path / f"run{suffix}"
    live: dict[tuple[str, int], FieldFrame] = {}
    fleet = Fleet(hand, unchecked=unchecked)
    with (
        VirtualClock(),
        fleet,
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        fields = host.fields(capacity=1000)
        end_s = clock.monotonic() + 2.0
        while clock.monotonic() < end_s:
            field = fields.get(0.1)
            if field is not None:
                live[key(field)] = field
    assert len(live) > 40
    assert recorder.stats().failure is None
    assert recorder.stats().dropped == 0
    if unchecked == ("p0", "p1"):  # as the hosts wrote it that knew no checks
        journal = path.with_suffix(".jsonl")
        text = journal.read_text()
        assert text.count('"checked": false, ') == 2
        journal.write_text(text.replace('"checked": false, ', ""))
    run = replay(path)
    again = {key(field): field for field in run}
    assert (run.log.damaged, run.complaints, run.ended, run.incomplete) == (0, [], True, None)
    assert set(again) >= set(live)
    for which, field in live.items():
        other = again[which]
        assert other.displacement_m.tobytes() == field.displacement_m.tobytes(), which
        assert other.displacement_std_m.tobytes() == field.displacement_std_m.tobytes(), which
        assert other.residual.tobytes() == field.residual.tobytes()
        assert (other.status, other.method, other.noise_factor) == (
            field.status,
            field.method,
            field.noise_factor,
        )
        assert field.stamp is not None
        assert other.stamp is not None
        assert (other.stamp.counter, other.stamp.device_time_us) == (
            field.stamp.counter,
            field.stamp.device_time_us,
        )
        assert abs(other.stamp.t_receive_ns - field.stamp.t_receive_ns) <= 2000
    with pytest.raises(ConfigError, match="exists"):
        Recorder(hand, path)


@pytest.mark.long
def test_health_follows_the_heartbeat_period_of_the_nodes(tmp_path: Path) -> None:
    """A guest keeps the period that the bus's master has set, whatever its hand file says."""
    hand, path = a_hand(), tmp_path / "run.log"
    slow = hand.model_copy(update={"bring_up": BringUpConfig(heartbeat_ms=1000)})
    with (
        VirtualClock(),
        Fleet(slow),
        Recorder(slow, path) as recorder,
        Host.from_config(slow, tap=recorder),
    ):
        clock.sleep(2.5)
    first, *events = path.with_suffix(".jsonl").read_text().splitlines(keepends=True)
    header = json.loads(first)
    assert header["hand"].pop("bring_up") == {"heartbeat_ms": 1000}
    path.with_suffix(".jsonl").write_text("".join([json.dumps(header), "\n", *events]))
    run = replay(path)
    conditions = [run.health(field.stamp.patch).condition for field in run if field.stamp is not None]
    assert len(conditions) > 100
    assert Condition.LOST not in conditions


def test_python_can_reads_what_was_written(tmp_path: Path) -> None:
    frames = [
        Frame(0x185, bytes(range(8)), T_NS),
        Frame(0x80, b"\x07", T_NS + 1_000_000),
        Frame(0x1ABCDE01, b"\x01", T_NS + 2_000_000, extended=True),
        Frame(0x705, b"", T_NS + 3_000_000, remote=True),
        Frame(0x186, bytes(64), T_NS + 4_000_000, fd=True),
    ]
    readers = {".log": can.CanutilsLogReader, ".blf": can.BLFReader}
    for suffix, reader in readers.items():
        path = tmp_path / f"x{suffix}"
        log = FrameLog(path, ("can0",))
        for number, frame in enumerate(frames):
            log.write(LoggedFrame(frame, "can0", number % 2 == 1))
            log.flush(to_disk=False)
        log.close()
        messages = list(reader(path))
        assert [bytes(m.data) for m in messages] == [f.data for f in frames]
        assert [m.arbitration_id for m in messages] == [f.can_id for f in frames]
        assert [m.is_fd for m in messages] == [f.fd for f in frames]
        assert [not m.is_rx for m in messages] == [False, True, False, True, False]
        times_s = [f.t_ns * 1e-9 for f in frames]
        np.testing.assert_allclose([m.timestamp for m in messages], times_s, rtol=0, atol=2e-6)
        ours = FrameLogReader(path)
        assert [(g.frame._replace(t_ns=0), g.sent) for g in ours] == [
            (f._replace(t_ns=0), number % 2 == 1) for number, f in enumerate(frames)
        ]
        assert ours.damaged == 0


CHILD = """
import sys, time
from skinnode.transport.frame import Frame
from skinnode.config import parse_hand
from skinnode.record import Recorder
hand = parse_hand({"buses": [{}], "patches": [{"name": "p", "node_id": 5}]})
recorder = Recorder(hand, sys.argv[1])
print("go", flush=True)
for number in range(1_000_000):
    recorder.received("can0", [Frame(0x185, number.to_bytes(8, "little"), time.monotonic_ns())])
    if number % 4 == 0:
        print(number, time.monotonic_ns(), flush=True)
    time.sleep(0.0005)
"""


@pytest.mark.parametrize("suffix", [".log", ".blf"])
@pytest.mark.long
def test_killed_at_any_moment_it_reads_up_to_the_last_second(tmp_path: Path, suffix: str) -> None:
    for attempt in range(5):
        path = tmp_path / f"run{attempt}{suffix}"
        with subprocess.Popen(
            [sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "go\n"
            time.sleep(random.uniform(0.0, 1.5))
            child.send_signal(signal.SIGKILL)
            killed_ns = time.monotonic_ns()
            told = [line.split() for line in child.stdout.read().splitlines()]
        run = replay(path)
        assert not run.ended
        assert list(run) == []
        numbers = [int.from_bytes(g.frame.data, "little") for g in FrameLogReader(path)]
        assert numbers == list(range(len(numbers)))
        whole = [line for line in told if len(line) == 2]
        due = [int(n) for n, t_ns in whole[:-1] if int(t_ns) < killed_ns - 1_000_000_000]
        assert len(numbers) > max(due, default=-1)


def written(path: Path, frames: int) -> bytes:
    log = FrameLog(path, ("can0",))
    for number in range(frames):
        log.write(
            LoggedFrame(Frame(0x185, number.to_bytes(8, "little"), T_NS + number * 1000), "can0", False)
        )
        if number % 50 == 49:
            log.flush(to_disk=False)
    log.close()
    return path.read_bytes()


SWALLOWED = (472, 600, 2844, 3034, 3564, 3780)
"""Seeds of garbage that became a frame with a wrong length, which swallowed all later containers."""
GARBAGE = (
    b"\xff" * 100,
    b"LOBJ" * 25,
    *(random.Random(seed).randbytes(64) for seed in (*SWALLOWED, *range(20))),
)


@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_garbage_costs_what_it_covers_and_is_counted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    whole = written(path, 500)
    at = len(whole) // 2
    for garbage in GARBAGE:
        path.write_bytes(whole[:at] + garbage + whole[at + len(garbage) :])
        reader = FrameLogReader(path)
        numbers = {int.from_bytes(g.frame.data, "little") for g in reader}
        assert reader.damaged > 0
        assert str(reader.damages[0]).startswith("line" if suffix == ".log" else "offset")
        assert len(numbers & set(range(500))) >= 390  # two containers of 50 frames at most
        assert {0, 499} <= numbers


@pytest.mark.parametrize("suffix", [".log", ".blf"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_is_in_a_file_nothing_is_raised(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    path = tmp_path / f"{uuid.uuid4().hex}{suffix}"
    content = bytearray(written(path, 120))
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(0, len(content)))
        length = data.draw(st.integers(0, 40))
        content[at : at + length] = data.draw(st.binary(max_size=40))
    content = content[: data.draw(st.integers(0, len(content)))]
    path.write_bytes(content)
    reader = FrameLogReader(path)
    for logged in reader:
        assert len(logged.frame.data) <= 64


FULL = """
import resource, sys, time
from skinnode.transport.frame import Frame
from skinnode.config import parse_hand
from skinnode.record import Recorder
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
hand = parse_hand({"buses": [{}], "patches": [{"name": "p", "node_id": 5}]})
for path in sys.argv[1:]:
    with Recorder(hand, path) as recorder:
        for number in range(20_000):
            recorder.received("can0", [Frame(0x185, number.to_bytes(8, "little"), time.monotonic_ns())])
    stats = recorder.stats()
    assert stats.failure is not None and "disk" in stats.failure, stats
    print(f"that was {path}", file=sys.stderr)
"""


@pytest.mark.long
def test_a_full_disk_is_one_line_and_nobody_is_held_up(tmp_path: Path) -> None:
    paths = [tmp_path / f"{kind}.{kind}" for kind in ("log", "blf", "mcap")]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", FULL, *map(str, paths)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert lines[1::2] == [f"that was {path}" for path in paths]
    assert len(lines) == 2 * len(paths)
    assert all("recording ended, because writing to the disk failed" in line for line in lines[::2])
    for path in paths:
        assert list(replay(path)) == []


@pytest.mark.long
def test_contacts_and_forces_are_in_the_json_of_host_and_replay(tmp_path: Path) -> None:
    file, path = tmp_path / "hand.toml", tmp_path / "run.log"
    sizes = ", ".join(f"{name} = {value}" for name, value in SMALL.items())
    file.write_text(
        f'[[buses]]\nname = "can0"\ninterface = "timed"\nchannel = "{uuid.uuid4().hex}"\n'
        '[sync]\nperiod_ms = 25\n[solver]\nmethod = "posterior"\n[simulation]\ncycle_s = 2.0\n'
        f'[[patches]]\nname = "p0"\nnode_id = 5\nlayout = {{ preset = "staggered", {sizes} }}\n'
        'tolerances = "exact"\n'
    )
    hand = load_hand(file)
    live: dict[int, FieldFrame] = {}
    with VirtualClock(), Fleet(hand):
        with Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder) as host:
            fields, end_s = host.fields(capacity=1000), clock.monotonic() + 2.0
            while clock.monotonic() < end_s:
                field = fields.get(0.1)
                if field is not None and field.stamp is not None:
                    live[field.stamp.scan] = field
        seconds = CliRunner().invoke(app, ["host", str(file), "--json", "--seconds", "2"]).stdout
    played = CliRunner().invoke(app, ["replay", str(path), "--fast", "--json"]).stdout
    tables = [table for line in played.splitlines() if "scan" in (table := json.loads(line))]
    compared = 0
    for table in tables:
        field = live.get(table["scan"])
        if field is None or not field.contacts:
            continue
        for told, contact in zip(table["contacts"], field.contacts, strict=True):
            assert told["normal_force_n"] == contact.normal_force_n  # bit by bit
            assert told["normal_force_std_n"] == contact.normal_force_std_n
            assert told["shear_force_n"] == contact.shear_force_n.tolist()
            assert told["shear_force_std_n"] == contact.shear_force_std_n.tolist()
            assert (told["area_m2"], told["area_std_m2"]) == (contact.area_m2, contact.area_std_m2)
            assert told["centroid_m"] == contact.centroid_m.tolist()
            assert told["centroid_std_m"] == contact.centroid_std_m.tolist()
            compared += 1
    assert compared > 5
    newest = [json.loads(line) for line in seconds.splitlines() if "patches" in line][-1]
    found = newest["patches"]["p0"]["contacts"]
    assert isinstance(found, list)
    assert all(contact["normal_force_n"] > 0 for contact in found)


def test_contacts_are_unknown_before_the_first_field_and_none_if_nothing_touches(tmp_path: Path) -> None:
    assert contact_tables(None) is None
    hand, path = a_hand(), tmp_path / "run.log"
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        field = host.fields().get(5.0)
    assert field is not None
    assert field.method == "exact"
    assert contact_tables(dataclasses.replace(field, contacts=())) == []
    assert contact_tables(field) is not None
