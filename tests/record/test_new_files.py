"""New files of recordings and conversions: full disks, other commands, entries that cannot be written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.record import Recorder, convert
from skinnode.record.convert import TARGETS
from skinnode.record.log_files import LogFiles
from skinnode.record.open_recording import open_recording
from skinnode.transport.frame import Frame


def a_hand(*buses: str) -> HandConfig:
    names = buses or ("can0",)
    patches = [{"name": f"p{i}", "node_id": 5, "bus": name} for i, name in enumerate(names)]
    return parse_hand({"buses": [{"name": n, "channel": f"c{n}"} for n in names], "patches": patches})


def a_frame(number: int) -> Frame:
    return Frame(0x185, number.to_bytes(8, "little"), number * 1_000_000)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mcap"])
@pytest.mark.parametrize(
    "buses", [("bus1", "can_left"), ("a b", "bus0", "a-b"), ("bus1", "can_left", "bus2", "can_right")]
)
def test_each_bus_keeps_its_frames(tmp_path: Path, buses: tuple[str, ...], suffix: str) -> None:
    hand, path = a_hand(*buses), tmp_path / f"run{suffix}"
    with Recorder(hand, path) as recorder:
        for number in range(3 * len(buses)):
            recorder.received(buses[number % len(buses)], [a_frame(number)])
    recording = open_recording(path)
    found: dict[str | None, list[int]] = {}
    for logged in recording.frames:
        found.setdefault(recording.channels.bus(logged.channel), []).append(logged.frame.data[0])
    assert found == {name: [i, i + len(buses), i + 2 * len(buses)] for i, name in enumerate(buses)}
    if suffix == ".log":  # a foreign reader tells the buses apart, and a plain name is kept
        channels = [message.channel for message in can.CanutilsLogReader(path)][: len(buses)]
        assert len(set(channels)) == len(buses)
        assert {name for name in buses if name.startswith("bus")} <= set(channels)


CONVERT = """
import resource, sys
from pathlib import Path
from can.io.asc import ASCWriter
from skinnode.record.convert import convert
ASCWriter.FORMAT_DATE = "%Y"  # a date with milliseconds of one to three digits would change the size
source = Path(sys.argv[1])
for suffix in sys.argv[2:]:
    for number, less in enumerate((1, 10)):  # 10: with python-can's last line, or a part of the index
        whole, cut = source.with_name(f"whole{number}{suffix}"), source.with_name(f"cut{number}{suffix}")
        convert(source, whole, frames_only=True)
        size = whole.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - less, resource.RLIM_INFINITY))
        try:
            convert(source, cut, frames_only=True)
            print(f"{cut.name}: converted")
        except OSError:
            pass
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        print(*(path.name for path in source.parent.iterdir() if path.name.startswith("cut")))
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source" / "run.log"
    path.parent.mkdir()
    with Recorder(a_hand(), path) as recorder:
        recorder.received("can0", [a_frame(number) for number in range(4000)])
    return path


@pytest.mark.long
def test_a_disk_that_is_full_at_the_end_of_a_conversion_is_an_error(source: Path) -> None:
    targets = [suffix for suffix in TARGETS if suffix != ".log"]
    with Recorder(a_hand(), source.with_name("run.mcap")) as recorder:
        recorder.received("can0", [a_frame(number) for number in range(4000)])
    for path, suffixes in ((source, targets), (source.with_name("run.mcap"), [".mcap", ".log"])):
        done = subprocess.run(
            [sys.executable, "-c", CONVERT, str(path), *suffixes],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        assert done.stdout.split() == []
        for whole in source.parent.glob("whole*"):
            whole.unlink()


RECORD = """
import resource, sys
from pathlib import Path
from skinnode.config import parse_hand
from skinnode.record import Recorder
from skinnode.transport.frame import Frame
hand = parse_hand({"buses": [{}], "patches": [{"name": "p", "node_id": 5}]})
frames = [Frame(0x185, bytes(8), number) for number in range(1000)]
def recorded(name):
    with Recorder(hand, Path(sys.argv[1], name)) as recorder:
        recorder.received("can0", frames)
    return recorder
size = recorded("whole.mcap").path.stat().st_size
resource.setrlimit(resource.RLIMIT_FSIZE, (size - 200, size))
stats = recorded("cut.mcap").stats()
assert stats.frames == 1000, stats
assert stats.failure is not None and "writing to the disk failed" in stats.failure, stats
"""


@pytest.mark.long
def test_a_disk_that_is_full_at_the_end_of_a_recording_is_reported(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", RECORD, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert "recording ended, because writing to the disk failed" in line


@pytest.mark.parametrize("suffix", [suffix for suffix in TARGETS if suffix != ".log"])
def test_a_conversion_never_deletes_the_file_of_another_command(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    target, opened = tmp_path / f"x{suffix}", convert.open_recording

    def while_another_command_creates_the_target(path: Path) -> Any:
        target.write_bytes(b"the other command's")
        return opened(path)

    monkeypatch.setattr(convert, "open_recording", while_another_command_creates_the_target)
    with pytest.raises(ConfigError, match="this one already exists and is not overwritten"):
        convert.convert(source, target)
    assert [path for path in tmp_path.iterdir() if path.is_file()] == [target]
    assert target.read_bytes() == b"the other command's"


@pytest.mark.parametrize("suffix", [".log", ".mcap"])
def test_the_frames_of_an_entry_that_cannot_be_written_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    """The frame after the second of five cannot be written; an event follows."""
    hand, path = a_hand(), tmp_path / f"run{suffix}"
    with Recorder(hand, path) as recorder:
        write = type(recorder._file).write

        def refusing(self: LogFiles, bus: str, frame: Frame, **more: Any) -> None:
            if frame.data == b"bad":
                raise ZeroDivisionError("of the file")
            write(self, bus, frame, **more)  # type: ignore[arg-type]

        monkeypatch.setattr(type(recorder._file), "write", refusing)
        batch = [a_frame(1), a_frame(2), Frame(0x185, b"bad", 3_000_000), a_frame(4), a_frame(5)]
        recorder.received("can0", batch)
        recorder.withheld("p0")
        recorder.received("can0", [a_frame(6)])
    assert (recorder.stats().frames, recorder.stats().dropped) == (3, 3)
    recording = open_recording(path)
    assert [logged.frame.data[0] for logged in recording.frames] == [1, 2, 6]
    events = {event["event"]: event for event in recording.events}
    assert events["withheld"]["at"] == 2  # a replay applies it after the two frames that are in the log
    assert events["dropped"]["frames"] == 3
    assert json.loads(recording.lines[-1])["frames"] == 3


def test_a_full_queue_loses_frames_but_no_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay without an event would decode all later scans with the wrong baseline."""
    with Recorder(a_hand(), tmp_path / "run.log") as recorder:
        recorder.received("can0", [a_frame(1)])
        monkeypatch.setattr("skinnode.record.recorder.CAPACITY", 0)
        recorder.received("can0", [a_frame(2)])
        recorder.withheld("p0")
    assert (recorder.stats().frames, recorder.stats().dropped) == (1, 1)
    _, *events = (tmp_path / "run.jsonl").read_text().splitlines()
    assert [json.loads(line)["event"] for line in events] == ["withheld", "dropped", "ended"]


def test_an_event_that_cannot_be_written_is_no_lost_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Recorder(a_hand(), tmp_path / "run.log") as recorder:
        recorder.received("can0", [a_frame(1)])
        with monkeypatch.context() as patched:
            patched.setattr(Recorder, "_write_event", lambda *_, **__: 1 / 0)
            recorder.withheld("p0")
            recorder.received("can0", [a_frame(2)])
            recorder.close()
    stats = recorder.stats()
    assert (stats.frames, stats.dropped, stats.failure) == (2, 0, None)
