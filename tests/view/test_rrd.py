"""Files as the reader of the SDK sees them, compared with the fields of the host and of the replay."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.config.links import PoseConfig
from skinnode.errors import ConfigError
from skinnode.host import Host, health_watch
from skinnode.model.frames import FieldFrame
from skinnode.monitor.live_source import HostSource
from skinnode.monitor.replay_source import ReplaySource
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.view.conversion import Conversion
from skinnode.view.drawing_thread import STATE_S, DrawingThread
from skinnode.view.geometry import force_n
from skinnode.view.picture import FORCE_M_PER_N
from skinnode.view.tick import Tick
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .conftest import a_hand

EXAGGERATION = 12.0


class Rows:
    """All rows of a file by entity path; a row maps the names of its timelines and components to values."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        assert len(reader.recordings()) == len(reader.blueprints()) == 1
        self.of: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for chunk in reader.stream():
            batch = chunk.to_record_batch()
            for number in range(batch.num_rows):
                row = {
                    name: batch.column(at)[number]
                    for at, name in enumerate(batch.schema.names)
                    if "RowId" not in name
                }
                self.of[chunk.entity_path].append({"static": chunk.is_static, **row})

    def in_time(self, path: str) -> list[dict[str, Any]]:
        return sorted((row for row in self.of[path] if not row["static"]), key=lambda row: row["time"].value)

    def scans(self, path: str) -> dict[int, dict[str, Any]]:
        """Rows of an entity of a patch by the number of the scan; the first row, at rest, belongs to none."""
        return {row["scan"].as_py(): row for row in self.in_time(path) if row.get("scan") is not None}


def check_field(rows: Rows, field: FieldFrame, hand: Any, wall_minus_mono_ns: int) -> None:
    stamp = field.stamp
    assert stamp is not None
    layout = hand.patch(stamp.patch).layout.build()
    path = f"/skin/hand/{stamp.patch}"
    row = rows.scans(f"{path}/surface")[stamp.scan]
    drawn = np.array(row["Mesh3D:vertex_positions"].as_py())
    expected = layout.upper_m + EXAGGERATION * field.displacement_m
    assert drawn == pytest.approx(expected.reshape(-1, 3), rel=1e-6, abs=1e-9)
    assert row["time"].value == stamp.t_sync_ns + wall_minus_mono_ns
    arrows = rows.scans(f"{path}/contacts").get(stamp.scan, {})
    if not field.contacts and not arrows:  # as before
        return
    vectors = np.array(arrows["Arrows3D:vectors"].as_py()).reshape(-1, 3)
    expected = FORCE_M_PER_N * np.array([force_n(contact) for contact in field.contacts]).reshape(-1, 3)
    assert vectors == pytest.approx(expected, rel=1e-5, abs=1e-7)
    labels = arrows["Ellipsoids3D:labels"].as_py()
    assert [label.split()[0] for label in labels] == [f"{c.normal_force_n:.2f}" for c in field.contacts]


def test_a_live_hand_in_a_file(tmp_path: Path, sdk: None) -> None:
    from skinnode.view.drawing import HandDrawing
    from skinnode.view.outputs import Target
    from skinnode.view.stream import open_stream

    hand, path = a_hand(), tmp_path / "hand.rrd"
    fields: list[FieldFrame] = []
    with (
        VirtualClock(),
        open_stream(Target(None, path, "hand")) as stream,
        Fleet(hand) as fleet,
        Host.from_config(hand) as host,
        HostSource(host) as source,
    ):
        wall_ns = source.wall_minus_mono_ns
        drawing = HandDrawing(stream, hand, exaggeration=EXAGGERATION, wall_minus_mono_ns=wall_ns, live=True)
        every = host.fields(capacity=10_000)
        with DrawingThread(source, drawing.draw, rate_hz=200.0) as thread:
            clock.sleep(2.0)
            fleet.inject(Faults(unplugged=True), "p1")
            clock.sleep(1.0)
            fleet.inject(Faults(unplugged=True), "p0")
            clock.sleep(0.5)
        while (field := every.get(0.0)) is not None:
            fields.append(field)
    rows = Rows(path)
    assert thread.failure is None
    assert thread.counts.drawn == len(fields) > 100
    for name in ("p0", "p1"):
        surface = f"/skin/hand/{name}/surface"
        expected = [field.stamp.scan for field in fields if field.stamp and field.stamp.patch == name]
        assert sorted(rows.scans(surface)) == expected
        assert len(rows.in_time(surface)) == len(expected) + 2  # grey before the first, and when it is lost
    assert any(field.contacts for field in fields)
    for field in fields:
        check_field(rows, field, hand, wall_ns)
    static = next(row for row in rows.of["/skin/hand/p1"] if row["static"])
    assert static["Transform3D:translation"].as_py() == [pytest.approx([0.0, 0.0, 0.1])]
    events = [row["TextLog:text"].as_py()[0] for row in rows.in_time("/events")]
    assert sum("p1: " in text and "now lost" in text for text in events) == 1
    health = rows.in_time("/health")[-1]["TextDocument:text"].as_py()[0]
    assert f"Fields: {len(fields)} drawn, 0 left out, 0 dropped" in health
    assert "lost" in health
    forces = [row["Scalars:scalars"].as_py() for row in rows.in_time("/curves/force")]
    per_tick = np.array(forces)
    assert per_tick.shape[1] == 3  # two patches and the whole hand
    assert per_tick[:, 2] == pytest.approx(np.nansum(per_tick[:, :2], axis=1))
    strongest = max(sum(c.normal_force_n for c in field.contacts) for field in fields)
    assert np.nanmax(per_tick[:, :2]) == pytest.approx(strongest)
    loads = [row["Scalars:scalars"].as_py()[0] for row in rows.in_time("/curves/load")]
    assert 0.0 < max(loads) < 100.0


def test_forces_and_positions_are_those_of_the_hand_file_if_patches_are_drawn_side_by_side(
    tmp_path: Path, sdk: None
) -> None:
    from skinnode.view.drawing import HandDrawing
    from skinnode.view.outputs import Target
    from skinnode.view.stream import open_stream

    turned, path = PoseConfig(position_m=(0.0, 0.0, 0.1), rpy_rad=(np.pi, 0.0, 0.0)), tmp_path / "hand.rrd"
    hand = a_hand()
    patches = tuple(patch.model_copy(update={"pose": turned}) for patch in hand.patches)
    hand = hand.model_copy(update={"patches": patches})
    with (
        VirtualClock(),
        open_stream(Target(None, path, "hand")) as stream,
        Fleet(hand),
        Host.from_config(hand) as host,
        HostSource(host) as source,
    ):
        drawing = HandDrawing(stream, hand, exaggeration=1.0, wall_minus_mono_ns=0, live=True)
        assert drawing.placement.side_by_side
        with DrawingThread(source, drawing.draw):
            clock.sleep(4.0)
    found: dict[str, list[list[float]]] = defaultdict(list)
    for row in Rows(path).in_time("/contacts"):
        for line in row["TextDocument:text"].as_py()[0].splitlines():
            cells = [cell.strip() for cell in line.split("|")]
            if line.startswith("| p"):
                found[cells[1].partition(",")[0]].append(
                    [float(x) for x in cells[4].split(" ± ")[0].split(",")]
                )
    assert set(found) == {"p0", "p1"}
    for places_mm in found.values():  # a patch of 4 × 4 electrodes, 4 mm apart and 2 mm high, upside down
        x, y, z = np.array(places_mm).T
        assert -4.0 < x.min() <= x.max() < 16.0
        assert -16.0 < y.min() <= y.max() < 4.0
        assert z == pytest.approx(98.0, abs=0.11)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of a hand of which one patch is lost."""
    hand, path = a_hand(), tmp_path / "run.log"
    with (
        VirtualClock(),
        Fleet(hand) as fleet,
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder),
    ):
        clock.sleep(1.0)
        fleet.inject(Faults(unplugged=True), "p1")
        clock.sleep(1.0)
    return path


def changes_in(fields: list[FieldFrame]) -> list[tuple[int, str, str]]:
    """Time, patch and kind of each onset and release of a touch in a list of fields."""
    touched: dict[str, bool] = {}
    found = []
    for field in fields:
        assert field.stamp is not None
        if field.touched is not None and field.touched != touched.get(field.stamp.patch, False):
            touched[field.stamp.patch] = field.touched
            what = "touched" if field.touched else "released"
            found.append((field.stamp.t_sync_ns, field.stamp.patch, what))
    return found


@pytest.mark.long
def test_a_conversion_draws_every_field_in_the_time_of_the_recording(recording: Path) -> None:
    ticks: list[Tick] = []
    conversion = Conversion(recording)
    conversion.run(ticks.append)
    drawn = [field for tick in ticks for field in tick.fields.values()]
    expected = list(replay(recording))
    stamps = [field.stamp for field in expected]
    assert sorted((f.stamp.scan, f.stamp.patch) for f in drawn if f.stamp) == sorted(
        (stamp.scan, stamp.patch) for stamp in stamps if stamp
    )
    assert conversion.counts.drawn == len(expected) > 60
    for tick in ticks:
        times = [field.stamp.t_receive_ns for field in tick.fields.values() if field.stamp]
        assert all(tick.t_ns - 5e7 < t_ns <= tick.t_ns for t_ns in times)
    lost = [event for tick in ticks for event in tick.events if event.what == "lost"]
    assert [event.subject for event in lost] == ["p1"]
    last_ns = max(stamp.t_receive_ns for stamp in stamps if stamp and stamp.patch == "p1")
    assert 0 < lost[0].t_ns - last_ns < 1_000_000_000
    touches = [
        (event.t_ns, event.subject, event.what)
        for tick in ticks
        for event in tick.events
        if event.what in ("touched", "released")
    ]
    assert touches == changes_in(expected) != []
    states = [tick.t_ns for tick in ticks if tick.view is not None]
    gaps = np.diff(states[1:-1])
    assert len(gaps) > 2
    assert (gaps >= 1e9 * STATE_S).all()
    assert (gaps < 1e9 * STATE_S + 8e7).all()  # with the check every 50 ms and a SYNC every 25 ms


@pytest.mark.long
def test_the_events_of_a_replay_are_complete_when_it_is_over(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However fast it is: here, it is over before the health is checked for the first time."""
    monkeypatch.setattr(health_watch, "_CHECK_S", 60.0)
    with ReplaySource(replay(recording)) as source:
        while not source.over:
            time.sleep(0.01)
        events = source.events()
    touches = [(e.t_ns, e.subject, e.what) for e in events if e.what in ("touched", "released")]
    assert touches == changes_in(list(replay(recording))) != []


def view(*arguments: str) -> subprocess.CompletedProcess[str]:
    code = "from skinnode.cli.main import main; main()"
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, "view", *arguments],
        capture_output=True,
        text=True,
        timeout=60.0,
        stdin=subprocess.DEVNULL,
    )


@pytest.mark.long
def test_the_command_converts_a_recording(recording: Path, tmp_path: Path, sdk: None) -> None:
    path = tmp_path / "run.rrd"
    done = view("--replay", str(recording), "--save", str(path), "--exaggerate", str(EXAGGERATION))
    assert done.stderr == ""
    assert done.returncode == 1
    run = replay(recording)
    fields = list(run)
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"{len(fields)} fields drawn, 0 left out")
    assert "fault: p1: lost" in lines
    rows = Rows(path)
    for field in fields:
        check_field(rows, field, run.hand, run.wall_minus_mono_ns)
    again = view("--replay", str(recording), "--save", str(path))
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr.count("\n") == 1
    assert "allowed: a new file; this one already exists" in again.stderr
    assert len(Rows(path).of) == len(rows.of)  # and is as it was


@pytest.mark.long
def test_convert_draws_as_view_does_unless_told_otherwise(recording: Path, tmp_path: Path, sdk: None) -> None:
    drawn, converted = tmp_path / "drawn.rrd", tmp_path / "converted.rrd"
    view("--replay", str(recording), "--save", str(drawn))
    code = "from skinnode.cli.main import main; main()"
    arguments = [sys.executable, "-W", "error", "-c", code, "convert", str(recording), str(converted)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60.0, check=True)
    fields = len(list(replay(recording)))
    assert done.stdout.splitlines()[0] == f"{converted}: {fields} fields"
    wanted, found = Rows(drawn), Rows(converted)
    assert sorted(found.of) == sorted(wanted.of)
    for patch in ("p0", "p1"):
        path = f"/skin/hand/{patch}/surface"
        assert found.scans(path) == wanted.scans(path) != {}
    again = subprocess.run(arguments, capture_output=True, text=True, timeout=60.0, check=False)
    assert (again.returncode, "allowed: a new file; this one already exists" in again.stderr) == (2, True)


@pytest.mark.long
def test_a_damaged_recording_is_converted_as_far_as_it_goes(
    recording: Path, tmp_path: Path, sdk: None
) -> None:
    text = recording.read_text()
    recording.write_text(text[: 2 * len(text) // 3] + "no frame\n")
    done = view("--replay", str(recording), "--save", str(tmp_path / "run.rrd"))
    assert done.returncode == 1
    assert any("run.log line" in line for line in done.stdout.splitlines())
    assert Rows(tmp_path / "run.rrd").scans("/skin/hand/p0/surface")


def test_a_file_that_cannot_be_written_is_one_error(tmp_path: Path, sdk: None) -> None:
    from skinnode.view.outputs import require_new_file

    with pytest.raises(ConfigError, match=r"ends in \.rrd"):
        require_new_file(tmp_path / "x.txt")
    with pytest.raises(ConfigError, match="No such file or directory"):
        require_new_file(tmp_path / "nowhere" / "x.rrd")
    with pytest.raises(ConfigError, match="can be created"):
        require_new_file(tmp_path / ("x" * 300 + ".rrd"))
    assert list(tmp_path.iterdir()) == []
