"""What a recording lacks, and what in it is no recording, is told in a line each and by the exit status."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.cli._errors import run
from skinnode.cli.main import app
from skinnode.host import Condition, Host
from skinnode.process import clock
from skinnode.record import Recorder, replay
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .test_replay import a_hand

Table = dict[str, Any]
CHUNK_OF_P0, SUMMARY_OF_P0 = b" 185#", b" 285#"


@dataclass(frozen=True)
class Recorded:
    """The lines of a recording of p0 and p1 without a fault."""

    log: list[bytes]
    journal: list[Table]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    hand, path = a_hand(), tmp_path_factory.mktemp("whole") / "run.log"
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        end_s = clock.monotonic() + 60.0
        while min(each.assembler.scans_complete for each in host.stats().patches.values()) < 40:
            assert clock.monotonic() < end_s
            clock.sleep(0.05)
        streams = [stream.assembler for stream in host.stats().patches.values()]
    assert recorder.stats().dropped == 0
    assert not any(stream.scans_missed or stream.scans_torn for stream in streams)
    journal = path.with_suffix(".jsonl").read_text().splitlines()
    return Recorded(path.read_bytes().splitlines(keepends=True), [json.loads(line) for line in journal])


@dataclass(frozen=True)
class Played:
    """What ``skinnode replay`` said, and its status."""

    status: int
    fields: list[Table]
    faults: list[str]
    error: str
    patches: Table


Play = Callable[..., Played]


@pytest.fixture
def play(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Play:
    def play(log: list[bytes], journal: list[Any]) -> Played:
        path = tmp_path / "x.log"
        path.write_bytes(b"".join(log))
        lines = [line if isinstance(line, str) else json.dumps(line) for line in journal]
        path.with_suffix(".jsonl").write_text("\n".join([*lines, ""]))
        capsys.readouterr()
        status = run(app, ["replay", str(path), "--fast", "--json"])
        said = capsys.readouterr()
        told = [json.loads(line) for line in said.out.splitlines()]
        return Played(
            status,
            told[:-1],
            told[-1]["faults"] if told else [],
            said.err,
            told[-1]["patches"] if told else {},
        )

    return play


@pytest.mark.long
def test_a_whole_recording_has_no_fault(recorded: Recorded, play: Play) -> None:
    played = play(recorded.log, recorded.journal)
    assert (played.status, played.faults, played.error) == (0, [], "")
    assert len(played.fields) > 60
    for name, facts in played.patches.items():  # in metres, as the fields are
        fields = [field["displacement_m"] for field in played.fields if field["patch"] == name]
        assert facts["deepest_m"] == max(0.0, *(-np.array(field)[..., 2].min() for field in fields))


def test_an_error_frame_is_a_fault_as_it_is_live(recorded: Recorded, play: Play) -> None:
    whole = play(recorded.log, recorded.journal)
    middle = len(recorded.log) // 2
    before, channel = recorded.log[middle].split()[:2]
    journal = [*recorded.journal[:-1], recorded.journal[-1] | {"frames": len(recorded.log) + 1}]
    error = b" ".join((before, channel, b"20000004#0010000000000000", b"R")) + b"\n"
    played = play([*recorded.log[:middle], error, *recorded.log[middle:]], journal)
    assert (played.status, played.faults) == (1, ["can0: 1 error frame"])
    assert played.fields == whole.fields


@pytest.mark.parametrize("commanded", [True, False])
def test_a_node_that_the_host_shut_down_was_operational(
    recorded: Recorded, play: Play, tmp_path: Path, commanded: bool
) -> None:
    """Its heartbeat may arrive before the host closes the bus."""
    command = b" can0 000#8005 T\n"
    assert sum(line.endswith(command) for line in recorded.log[-20:]) == 1
    log = [line for line in recorded.log if commanded or not line.endswith(command)]
    log.append(b" ".join((log[-1].split()[0], b"can0", b"705#7F", b"R")) + b"\n")
    play(log, [*recorded.journal[:-1], recorded.journal[-1] | {"frames": len(log)}])
    replayed = replay(tmp_path / "x.log")
    assert len(list(replayed)) > 60
    assert replayed.flaws == []
    assert replayed.health("p0").condition is (Condition.OPERATIONAL if commanded else Condition.BOOTING)


def test_a_log_cut_between_two_lines_lacks_frames(recorded: Recorded, play: Play) -> None:
    kept, frames = len(recorded.log) // 2, len(recorded.log)
    played = play(recorded.log[:kept], recorded.journal)
    assert played.status == 1
    assert f"x.log has {kept} frames, but {frames} were recorded" in played.faults


def test_a_log_that_is_there_twice_has_too_many(recorded: Recorded, play: Play) -> None:
    frames = len(recorded.log)
    played = play(recorded.log * 2, recorded.journal)
    assert played.status == 1
    assert f"x.log has {2 * frames} frames, but {frames} were recorded" in played.faults


@pytest.mark.long
def test_a_recording_that_was_killed_says_how_far_it_reads(recorded: Recorded, play: Play) -> None:
    assert recorded.journal[-1]["event"] == "ended"
    whole = play(recorded.log, recorded.journal)
    played = play(recorded.log, recorded.journal[:-1])
    begin, end = (float(line[1 : line.index(b")")]) for line in (recorded.log[0], recorded.log[-1]))
    assert played.faults == [f"x.log was not ended properly: readable up to {end - begin:.1f} s"]
    assert played.status == 1
    assert played.fields == whole.fields
    assert "x.log was not ended properly: no frames" in play([], recorded.journal[:-1]).faults


def test_scans_that_are_not_there_are_a_fault_as_they_are_live(recorded: Recorded, play: Play) -> None:
    ends = [number for number, line in enumerate(recorded.log) if SUMMARY_OF_P0 in line]
    gap = range(ends[10] + 1, ends[15] + 1)
    of_p0 = {i for i in gap if CHUNK_OF_P0 in recorded.log[i] or SUMMARY_OF_P0 in recorded.log[i]}
    log = [line for number, line in enumerate(recorded.log) if number not in of_p0]
    recorded.journal[-1]["frames"], frames = len(log), recorded.journal[-1]["frames"]
    try:
        played = play(log, recorded.journal)
    finally:
        recorded.journal[-1]["frames"] = frames
    assert played.status == 1
    assert played.faults == ["p0: 5 scans missed"]


def facts_with(**changed: Any) -> Callable[[Table], Any]:
    def change(event: Table) -> Any:
        return {**event, "facts": {**event["facts"], **changed}}

    return change


@pytest.mark.parametrize(
    "change",
    [
        *(facts_with(baseline_ohm=[[ohm] * 12] * 4) for ohm in (0, -1.0, float("nan"), 10**400)),
        facts_with(lo="x"),
        facts_with(layout=3),
        lambda event: {**event, "facts": None},
        lambda event: {**event, "patch": ["p0"]},
        lambda event: {**event, "t_ns": 10**30},
        lambda event: {**event, "bus": "can9"},
        lambda event: "[" * 100_000,
    ],
)
def test_a_bad_line_costs_its_patch_alone(
    recorded: Recorded, play: Play, change: Callable[[Table], Any]
) -> None:
    whole = play(recorded.log, recorded.journal)
    number = next(i for i, e in enumerate(recorded.journal) if e.get("patch") == "p0" and "facts" in e)
    journal: list[Any] = list(recorded.journal)
    journal[number] = change(journal[number])
    played = play(recorded.log, journal)
    assert played.status == 1
    assert played.fields == [field for field in whole.fields if field["patch"] == "p1"]
    complaint, *others = played.faults
    assert complaint.startswith(f"x.jsonl line {number + 1}: ")
    assert others == ["p0: no scan could be decoded"]


@pytest.mark.parametrize("frames", ["[1]", "null", "1e999", '"x"', "-5"])
def test_a_count_of_dropped_frames_that_is_none(recorded: Recorded, play: Play, frames: str) -> None:
    line = f'{{"bus": "", "at": 0, "t_ns": 0, "event": "dropped", "frames": {frames}}}'
    played = play(recorded.log, [*recorded.journal, line])
    assert played.faults == [f"x.jsonl line {len(recorded.journal) + 1}: no event"]
    assert played.status == 1


@pytest.mark.parametrize("offset", ["Infinity", "NaN", "1e400", str(10**40), "null"])
def test_a_header_that_is_none_is_one_line(recorded: Recorded, play: Play, offset: str) -> None:
    header = {**recorded.journal[0], "wall_minus_mono_ns": "here"}
    line = json.dumps(header).replace('"here"', offset)
    played = play(recorded.log, [line, *recorded.journal[1:]])
    assert played.status == 2
    assert len(played.error.splitlines()) == 1
    assert "x.jsonl: line 1" in played.error


def test_ctrl_c_ends_a_replay_before_its_first_scan(recorded: Recorded, tmp_path: Path) -> None:
    path, kept = tmp_path / "x.log", signal.getsignal(signal.SIGINT)
    path.write_bytes(b"".join(recorded.log))
    path.with_suffix(".jsonl").write_text("\n".join(map(json.dumps, recorded.journal)))
    over = threading.Event()

    def interrupt() -> None:
        while signal.getsignal(signal.SIGINT) is kept:
            if over.wait(0.01):
                return
        os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=interrupt)
    sender.start()
    begun_s = time.monotonic()
    try:
        status = run(app, ["replay", str(path), "--speed", "0.001"])
    finally:
        over.set()
        sender.join()
    assert status == 0
    assert time.monotonic() - begun_s < 20.0  # it would play for half an hour
    halted = replay(path, speed=0.001, cancelled=lambda: True)
    assert (list(halted), halted.incomplete) == ([], None)
