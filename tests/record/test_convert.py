"""Conversions: nothing is lost where nothing is said to be, and tables hold what a replay computes."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from skinnode.cli.main import app
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.model.forward import resistance_ohm
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.record.convert import convert
from skinnode.record.journal import Header
from skinnode.record.log_files import LogFiles
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import FrameLog
from skinnode.transport.frame_log_reader import FrameLogReader
from tests.lanes import some_long
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import START_WALL_NS, VirtualClock

from .test_replay import T_NS, a_hand


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    hand, path = a_hand(), tmp_path_factory.mktemp("convert") / "run.log"
    with VirtualClock(), Fleet(hand), Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder):
        clock.sleep(1.5)
    assert recorder.stats().failure is None
    return path


def bits(path: Path) -> list[tuple[object, ...]]:
    return [
        (f.stamp.patch, f.stamp.scan, f.displacement_m.tobytes(), f.displacement_std_m.tobytes())
        for f in replay(path)
        if f.stamp is not None
    ]


@pytest.mark.long
@pytest.mark.parametrize("through", some_long([".mcap", ".blf", ".asc"], ".mcap"))
def test_a_recording_comes_back_byte_for_byte(recorded: Path, tmp_path: Path, through: str) -> None:
    middle, back = tmp_path / f"middle{through}", tmp_path / "back" / "run.log"
    back.parent.mkdir()
    there = convert(recorded, middle)
    again = convert(middle, back)
    assert there.faults == again.faults == ()
    assert there.frames == again.frames > 500
    assert back.read_bytes() == recorded.read_bytes()
    assert back.with_suffix(".jsonl").read_bytes() == recorded.with_suffix(".jsonl").read_bytes()
    assert bits(middle) == bits(recorded)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_a_log_without_frames_is_no_damaged_one(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    FrameLog(path, ("can0",)).close()
    reader = FrameLogReader(path)
    assert list(reader) == []
    assert reader.damages == []


@pytest.mark.long
def test_a_log_next_to_its_source_shares_the_journal(recorded: Path, tmp_path: Path) -> None:
    source = tmp_path / "run.log"
    for suffix in (".log", ".jsonl"):
        source.with_suffix(suffix).write_bytes(recorded.with_suffix(suffix).read_bytes())
    convert(source, tmp_path / "run.blf")
    assert bits(tmp_path / "run.blf") == bits(recorded)
    with pytest.raises(ConfigError, match="exists"):
        convert(source, tmp_path / "run.blf")
    assert source.with_suffix(".jsonl").read_bytes() == recorded.with_suffix(".jsonl").read_bytes()
    (tmp_path / "x.log").write_text("(1.000000) can0 185#00 R\n")
    (tmp_path / "x.jsonl").write_text("no journal\n")
    with pytest.raises(ConfigError, match="the header of a recording's journal"):
        convert(tmp_path / "x.log", tmp_path / "x.blf")
    assert (tmp_path / "x.jsonl").exists()
    assert not (tmp_path / "x.blf").exists()


def test_frames_of_every_kind_survive_each_format(tmp_path: Path) -> None:
    """Error frames lose their content in ASC, which says so."""
    hand, source = a_hand(), tmp_path / "run.log"
    rng = random.Random(5)
    log = LogFiles(source, hand)
    log.write_line(Header(hand, "", 0).line(), 0)
    for number in range(200):
        fd, remote = rng.random() < 0.3, rng.random() < 0.1
        data = (
            b""
            if remote and not fd
            else rng.randbytes(rng.choice((1, 8, 12, 64)) if fd else rng.randrange(9))
        )
        extended = rng.random() < 0.3
        can_id = rng.randrange(1 << 29 if extended else 1 << 11)
        frame = Frame(can_id, data, T_NS + number * 123_000, remote and not fd, False, extended, fd)
        log.write("can0", frame, sent=rng.random() < 0.5, log_ns=0)
    log.write("can0", Frame(4, bytes(8), T_NS + 10**9, error=True), sent=False, log_ns=0)
    log.close()
    wanted = list(FrameLogReader(source))
    assert len(wanted) == 201
    for through in (".mcap", ".blf", ".asc"):
        folder = tmp_path / through[1:]
        folder.mkdir()
        done = convert(source, folder / f"x{through}", frames_only=True)
        assert ("error frames" in "".join(done.notes)) == (through == ".asc")
        convert(folder / f"x{through}", folder / "back.log")
        found = list(FrameLogReader(folder / "back.log"))
        if through == ".asc":
            assert found[:-1] == wanted[:-1]
            assert found[-1].frame.error
        else:
            assert found == wanted


@pytest.mark.long
def test_an_mcap_file_gets_the_fields_that_a_replay_computes(recorded: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    target = tmp_path / "x.mcap"
    done = convert(recorded, target)
    found = []
    with AnyReader([target]) as bag:
        for connection, _, raw in bag.messages():
            message: Any = bag.deserialize(raw, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/PointCloud2":
                found.append(np.frombuffer(message.data.tobytes(), "<f4").reshape(4, 4, -1)[..., 3:6])
    wanted = [field.displacement_m.astype("f4") for field in replay(recorded)]
    assert done.fields == len(found) == len(wanted) > 20
    for each in wanted:
        assert any(np.array_equal(each, other) for other in found)
    plain = convert(recorded, tmp_path / "plain.mcap", frames_only=True)
    assert (plain.frames, plain.fields) == (done.frames, 0)


@pytest.mark.long
def test_a_table_holds_the_fields_and_the_resistances(recorded: Path, tmp_path: Path) -> None:
    done = convert(recorded, tmp_path / "x.parquet")
    table = pq.read_table(tmp_path / "x.parquet").to_pylist()
    fields = list(replay(recorded))
    layout = a_hand().patches[0].layout.build()
    assert done.fields == len(table) == len(fields)
    explained = 0
    for row, field in zip(table, fields, strict=True):
        stamp = field.stamp
        assert stamp is not None
        assert (row["patch"], row["scan"], row["t_receive_ns"]) == (
            stamp.patch,
            stamp.scan,
            stamp.t_receive_ns,
        )
        assert 0 < row["time_ns"] - START_WALL_NS < 10e9
        assert np.array(row["displacement_m"]).tobytes() == field.displacement_m.tobytes()
        assert np.array(row["displacement_std_m"]).tobytes() == field.displacement_std_m.tobytes()
        assert [each["normal_force_n"] for each in row["contacts"]] == [
            c.normal_force_n for c in field.contacts
        ]
        measured = np.array(row["resistance_ohm"]).reshape(4, 12)
        if field.trusted and np.isfinite(measured).all():  # the forward model explains the resistances
            model = resistance_ohm(layout, layout.upper_m + field.displacement_m)
            np.testing.assert_allclose(measured, model, rtol=2e-3)
            explained += 1
    assert explained > 20


@pytest.mark.long
def test_npz_and_parquet_hold_the_same(recorded: Path, tmp_path: Path) -> None:
    convert(recorded, tmp_path / "x.parquet")
    convert(recorded, tmp_path / "x.npz")
    convert(tmp_path / "x.parquet", tmp_path / "y.npz")
    there = convert(tmp_path / "x.npz", tmp_path / "z.parquet")
    assert there.notes == ("x.npz contains no contacts or faults",)
    with np.load(tmp_path / "x.npz") as x, np.load(tmp_path / "y.npz") as y:
        assert x.files == y.files
        for name in x.files:
            np.testing.assert_array_equal(x[name], y[name])
        assert x["p0/displacement_m"].shape[1:] == (4, 4, 3)
        assert x["p0/resistance_ohm"].shape[1:] == (4, 12)
        of_p0 = [field for field in replay(recorded) if field.stamp is not None and field.stamp.patch == "p0"]
        assert x["p0/displacement_m"].tobytes() == np.stack([f.displacement_m for f in of_p0]).tobytes()
        assert x["p0/touched"].tolist() == [-1 if f.touched is None else int(f.touched) for f in of_p0]
        assert {0, 1} & set(x["p0/touched"].tolist())
        assert x["p0/distrust"].tolist() == [field.distrust or "" for field in of_p0]
    x_rows = pq.read_table(tmp_path / "x.parquet").sort_by(
        [("patch", "ascending"), ("t_receive_ns", "ascending")]
    )
    z_rows = pq.read_table(tmp_path / "z.parquet").sort_by(
        [("patch", "ascending"), ("t_receive_ns", "ascending")]
    )
    plain = [name for name in x_rows.column_names if name not in ("contacts", "faults")]
    for name in plain:
        left, right = x_rows[name].combine_chunks(), z_rows[name].combine_chunks()
        flat = [each.flatten() if hasattr(each, "flatten") else each for each in (left, right)]
        np.testing.assert_array_equal(*(each.to_numpy(zero_copy_only=False) for each in flat))


def test_what_cannot_be_converted_is_one_line_and_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    convert(recorded, tmp_path / "x.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "newer.npz", format=np.array("skinnode fields 2"), hand=np.array(""))
    (tmp_path / "text.parquet").write_text("no table")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "x.npz").read_bytes()[:-3000])
    (tmp_path / "none.log").write_text("(1.000000) can0 185#00 R\n")
    before = sorted(tmp_path.iterdir())
    for source, target, says in (
        (
            tmp_path / "x.npz",
            "y.mcap",
            "allowed: a file ending in .parquet or .npz; a field table contains",
        ),
        (recorded, "y.txt", "allowed: a file ending in .log, .blf, .asc, .mcap, .parquet, .npz or .rrd"),
        (tmp_path / "x.npz", "y.rrd", "allowed: a file ending in .parquet or .npz; a field table contains"),
        (recorded, "x.npz", "allowed: a new file; this one already exists and is not overwritten"),
        (recorded, "no/y.npz", "allowed: a file in an existing folder"),
        (tmp_path / "other.npz", "y.parquet", "allowed: an NPZ file of fields written by skinnode convert"),
        (
            tmp_path / "newer.npz",
            "y.parquet",
            "format: got 'skinnode fields 2', allowed: 'skinnode fields 1'",
        ),
        (tmp_path / "text.parquet", "y.npz", "allowed: a Parquet file"),
        (tmp_path / "cut.npz", "y.parquet", "allowed: an "),
        (tmp_path / "none.log", "y.mcap", "for a log without a journal, give --hand"),
        (tmp_path / "missing.log", "y.npz", "/missing.log', allowed: a file that can be read"),
        (tmp_path / "missing.mcap", "y.log", "a file that can be read (No such file or directory)"),
    ):
        done = CliRunner().invoke(app, ["convert", str(source), str(tmp_path / target)])
        assert isinstance(done.exception, ConfigError), (source, done.output)
        assert says in str(done.exception)
        assert "\n" not in str(done.exception)
        assert sorted(tmp_path.iterdir()) == before


def test_a_missing_viewer_is_said_of_the_target(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinnode.view.viewer_process.find_spec", lambda name: None)
    done = CliRunner().invoke(app, ["convert", str(recorded), str(tmp_path / "run.rrd")])
    assert str(done.exception).startswith("target: got no package rerun-sdk, allowed: ")


@pytest.mark.long
def test_a_damaged_source_is_converted_as_far_as_it_is_whole(recorded: Path, tmp_path: Path) -> None:
    source, target = tmp_path / "run.log", tmp_path / "x.mcap"
    source.write_bytes(recorded.read_bytes()[:-500])
    source.with_suffix(".jsonl").write_bytes(recorded.with_suffix(".jsonl").read_bytes())
    done = CliRunner().invoke(app, ["convert", str(source), str(target), "--json"])
    assert done.exit_code == 1
    told = json.loads(done.stdout)
    assert any("truncated" in fault for fault in told["faults"])
    assert told["frames"] == sum(1 for _ in FrameLogReader(source))


@pytest.mark.long
@pytest.mark.parametrize("target", some_long(["run.blf", "x.log", "x.asc", "x.mcap"], "x.mcap"))
def test_the_copy_of_a_damaged_log_gives_the_fields_of_that_log(
    recorded: Path, tmp_path: Path, target: str
) -> None:
    """Frames are lost before the baselines are known: the numbers of frames in the journal no longer hold."""
    source, copy, beside = tmp_path / "run.log", tmp_path / target, tmp_path / "run.jsonl"
    lines = recorded.read_bytes().splitlines(keepends=True)
    lines[1:41] = [b"\0" * 40 + b"\n"]
    source.write_bytes(b"".join(lines))
    beside.write_bytes(recorded.with_suffix(".jsonl").read_bytes())
    wanted = bits(source)
    assert len(wanted) > 20
    done = convert(source, copy)
    assert any("no frame" in fault for fault in done.faults)
    assert bits(copy) == wanted
    again = convert(copy, tmp_path / "again.npz")
    assert any("was repaired" in note for note in again.notes)
    assert beside.read_bytes() == recorded.with_suffix(".jsonl").read_bytes()
    assert bits(source) == wanted
