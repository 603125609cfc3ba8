"""Logs that another program recorded: no journal, no direction, the channel names of its own interface."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skinnode.cli.main import app
from skinnode.config import HandConfig, SyncConfig, load_hand
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.record.convert import convert
from tests.lanes import some_long
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .test_replay import a_hand

HAND = """
[sync]
period_ms = 25
[[buses]]
name = "left"
channel = "{channel}"
"""
PATCH = """
[[patches]]
name = "{name}"
node_id = {node_id}
bus = "left"
layout = {{ upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4 }}
tolerances = "exact"
"""


def record(path: Path, hand: HandConfig, seconds: float) -> Path:
    """Record a hand in virtual time."""
    with VirtualClock(), Fleet(hand), Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder):
        clock.sleep(seconds)
    assert recorder.stats().failure is None
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which the host solved every scan."""
    path = record(tmp_path_factory.mktemp("foreign") / "run.log", a_hand(), 1.5)
    journal = path.with_suffix(".jsonl").read_text()
    assert "overtaken" not in journal
    assert "polled" not in journal
    return path


def foreign(recorded: Path, folder: Path, channel: str = "can3") -> Path:
    """The log as ``candump -L`` writes it."""
    path = folder / "candump.log"
    lines = [line.rsplit(" ", 1)[0] for line in recorded.read_text().splitlines()]
    path.write_text("".join(f"{line.replace(' can0 ', f' {channel} ')}\n" for line in lines))
    return path


def hand_file(folder: Path, recorded: Path | None = None, channel: str = "can3") -> HandConfig:
    """A hand file; with the baselines of the journal of ``recorded`` if it is given."""
    text, facts = HAND.format(channel=channel), {}
    if recorded is not None:
        for line in recorded.with_suffix(".jsonl").read_text().splitlines()[1:]:
            event = json.loads(line)
            if "facts" in event:
                facts[event["patch"]] = event["facts"]["baseline_ohm"]
    for name, node_id in (("p0", 5), ("p1", 6)):
        text += PATCH.format(name=name, node_id=node_id)
        if name in facts:
            table = "\n".join(" ".join(map(repr, row)) for row in facts[name])
            (folder / f"{name}.txt").write_text(table + "\n")
            text += f'baseline = "{name}.txt"\n'
    (folder / "hand.toml").write_text(text)
    return load_hand(folder / "hand.toml")


def by_time(fields: list[FieldFrame], offset_ns: int) -> dict[tuple[str, int], FieldFrame]:
    found = {}
    for field in fields:
        assert field.stamp is not None
        found[field.stamp.patch, round((field.stamp.t_receive_ns + offset_ns) / 1000)] = field
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    "channel", some_long(["can3", "left", "vcan7"], "can3"), ids=["its channel", "its name", "the only bus"]
)
def test_with_the_baselines_it_gives_the_fields_of_the_host(
    recorded: Path, tmp_path: Path, channel: str
) -> None:
    hand = hand_file(tmp_path, recorded)
    ours = replay(recorded)
    wanted = by_time(list(ours), ours.wall_minus_mono_ns)
    run = replay(foreign(recorded, tmp_path, channel), hand=hand)
    found = by_time(list(run), 0)
    assert (run.flaws, run.notes, run.strange) == ([], (), 0)
    assert set(wanted) <= set(found)
    assert len(wanted) > 40
    worst_m = max(
        abs(found[which].displacement_m - field.displacement_m).max() for which, field in wanted.items()
    )
    assert worst_m < 1e-12  # the same codes and baselines; the solver may have begun with another scan


@pytest.mark.long
def test_a_sync_missing_from_the_log_changes_no_scan_number(tmp_path: Path) -> None:
    """Its counter was that of a SYNC one round before."""
    sync = SyncConfig(period_ms=25, counter_overflow=8)
    path = record(tmp_path / "run.log", a_hand().model_copy(update={"sync": sync}), 0.8)
    log, own = foreign(path, tmp_path), hand_file(tmp_path).model_copy(update={"sync": sync})
    whole = [field.stamp for field in replay(log, hand=own)]
    lines = log.read_text().splitlines(keepends=True)
    lost = [number for number, line in enumerate(lines) if " 080#" in line][15]
    log.write_text("".join(lines[:lost] + lines[lost + 1 :]))
    found = [field.stamp for field in replay(log, hand=own)]
    assert [(one.patch, one.scan) for one in found if one] == [(one.patch, one.scan) for one in whole if one]
    times = [one.t_sync_ns for one in found if one]
    assert times.count(0) in (1, 2)  # one for each patch that sent this scan
    assert all(t_ns in (0, one.t_sync_ns) for t_ns, one in zip(times, whole, strict=True) if one)


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".log", ".mcap"])
def test_a_hand_file_never_replaces_a_journal(recorded: Path, tmp_path: Path, suffix: str) -> None:
    """The journal knows the baselines and what the host decided; without it, other fields would result."""
    path = recorded if suffix == ".log" else tmp_path / "run.mcap"
    if suffix == ".mcap":
        convert(recorded, path)
    with pytest.raises(
        ConfigError, match=r"^--hand: got 'run\.\w+', allowed: only for a log without a journal"
    ):
        replay(path, hand=hand_file(tmp_path))


@pytest.mark.long
def test_frames_of_another_bus_are_left_out(recorded: Path, tmp_path: Path) -> None:
    """The only bus is that of the first frame; another channel has other content."""
    hand = hand_file(tmp_path, recorded)
    wanted = [field.displacement_m.tobytes() for field in replay(foreign(recorded, tmp_path), hand=hand)]
    log = foreign(recorded, tmp_path, "vcan7")
    lines = log.read_text().splitlines()
    others = [f"{line.split(' ')[0]} vcan8 185#0011223344556677" for line in lines]
    log.write_text("".join(f"{line}\n{other}\n" for line, other in zip(lines, others, strict=True)))
    run = replay(log, hand=hand)
    assert [field.displacement_m.tobytes() for field in run] == wanted
    assert run.strange == len(lines)
    for target, frames_only in (("x.log", False), ("x.mcap", False), ("y.mcap", True)):
        done = convert(log, tmp_path / target, hand=hand, frames_only=frames_only)
        assert done.frames == len(lines)
        assert done.faults == (f"{len(lines)} frames on channels not used by any bus of the hand",)


@pytest.mark.long
def test_without_baselines_it_says_so_and_is_close(recorded: Path, tmp_path: Path) -> None:
    ours = replay(recorded)
    wanted = by_time(list(ours), ours.wall_minus_mono_ns)
    run = replay(foreign(recorded, tmp_path), hand=hand_file(tmp_path))
    found = by_time(list(run), 0)
    assert [note.partition(":")[0] for note in run.notes] == ["p0", "p1"]
    deepest_m = max(abs(field.displacement_m).max() for field in wanted.values())
    worst_m = max(
        abs(found[which].displacement_m - field.displacement_m).max() for which, field in wanted.items()
    )
    assert worst_m < 0.02 * deepest_m


def test_a_node_that_restarts_is_decoded_again(recorded: Path, tmp_path: Path) -> None:
    hand = hand_file(tmp_path, recorded)
    log = foreign(recorded, tmp_path)
    lines = log.read_text().splitlines()
    half = len(lines) // 2
    stamp = lines[half].split(" ")[0]
    log.write_text("\n".join([*lines[:half], f"{stamp} can3 705#00", *lines[half:]]) + "\n")
    run = replay(log, hand=hand)
    times_ns = [
        field.stamp.t_receive_ns for field in run if field.stamp is not None and field.stamp.patch == "p0"
    ]
    assert max(times_ns) > float(stamp.strip("()")) * 1e9 + 0.2e9
    assert run.flaws == []


@pytest.mark.long
def test_a_new_baseline_is_not_guessed(tmp_path: Path) -> None:
    """p0 is tared; a log does not contain its new baseline. p1 goes on."""
    hand, path = a_hand(), tmp_path / "run.log"
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        clock.sleep(0.5)
        host.tare("p0")
        tared_ns = clock.time_ns()
        clock.sleep(0.7)
    run = replay(foreign(path, tmp_path), hand=hand_file(tmp_path, path))
    last_ns = dict.fromkeys(("p0", "p1"), 0)
    for field in run:
        assert field.stamp is not None
        last_ns[field.stamp.patch] = field.stamp.t_receive_ns
    assert 0 < last_ns["p0"] < tared_ns < last_ns["p1"]
    assert [flaw for flaw in run.flaws if "its baseline changed" in flaw] == [
        "p0: its baseline changed; its later scans cannot be solved, "
        "because the log does not contain the new baseline"
    ]


@pytest.mark.long
def test_the_command_reads_and_converts_it(recorded: Path, tmp_path: Path) -> None:
    hand_file(tmp_path)
    log, hand, target = foreign(recorded, tmp_path), str(tmp_path / "hand.toml"), tmp_path / "x.mcap"
    done = CliRunner().invoke(app, ["replay", str(log), "--fast", "--hand", hand])
    assert "note: p0: no baseline file in the hand file; assumed the undeformed layout" in done.stdout
    assert "p0  solved " in done.stdout
    done = CliRunner().invoke(app, ["convert", str(log), str(target), "--hand", hand])
    assert done.exit_code == 0, done.output
    again = replay(target, hand=load_hand(hand))
    plain = replay(log, hand=load_hand(hand))
    np.testing.assert_array_equal(
        [field.displacement_m for field in again], [field.displacement_m for field in plain]
    )
    done = CliRunner().invoke(app, ["replay", str(log)])
    assert "for a log without a journal, give --hand" in str(done.exception)
