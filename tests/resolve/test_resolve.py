"""Recordings solved again: the same bytes as a serial run, with any workers, also if some are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from skinnode.cli.main import app
from skinnode.config import HandConfig, load_hand, parse_hand
from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.record import Recorder, replay
from skinnode.record.convert import convert
from skinnode.record.open_recording import open_recording
from skinnode.resolve import processes, units
from skinnode.resolve.identity import identity
from skinnode.resolve.part_files import PartFiles
from skinnode.resolve.plan import make_plan
from skinnode.resolve.recording import recording_at
from skinnode.resolve.run import WORK_FOLDER, run, work_folder
from skinnode.resolve.scan_capture import Capture, CapturedScan
from skinnode.resolve.settings import variants
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .conftest import SMALL


class InTurn(Closing):
    """Runs the units in this process, one after the other."""

    def __init__(self, count: int, folder: Path) -> None:
        self.count, self._folder, self._waiting = count, folder, list[units.Unit]()

    def submit(self, unit: units.Unit) -> None:
        self._waiting.append(unit)

    def finished(self, timeout_s: float) -> list[str]:
        return [units.run_unit(self._waiting.pop(0), str(self._folder), identity(), "this process")]

    def close(self) -> None:
        pass


@pytest.fixture
def in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command solves in this process: a process takes more than a second of CPU time to load."""
    monkeypatch.setattr(processes, "Processes", InTurn)


def resolve(*arguments: object, status: int = 0) -> Any:
    done = CliRunner().invoke(app, ["resolve", *map(str, arguments), "--json"])
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout)["results"]


def refusal(*arguments: object) -> str:
    """The line of a command that is refused, which leaves nothing behind."""
    done = CliRunner().invoke(app, ["resolve", *map(str, arguments)])
    assert isinstance(done.exception, SkinError), done.output
    assert "\n" not in str(done.exception)
    return str(done.exception)


def messages_in(path: Path | str) -> list[tuple[object, ...]]:
    """Messages of an MCAP file in file order, as rosbags reads them, without the CPU times of the fields."""
    found: list[tuple[object, ...]] = []
    with AnyReader([Path(path)]) as bag:
        for connection, t_ns, raw in bag.messages():
            content: object = bytes(raw)
            if connection.topic.endswith("/field_info"):
                message: Any = bag.deserialize(raw, connection.msgtype)
                content = repr(
                    {name: value for name, value in vars(message).items() if name != "solve_time_s"}
                )
            found.append((connection.topic, t_ns, content))
    return found


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        *(pytest.param(*each, marks=pytest.mark.long) for each in (("mcap", 2), ("mcap", 1), ("parquet", 2))),
        ("parquet", 1),
    ],
)
def test_the_file_is_the_one_that_convert_writes(
    recording: Path, tmp_path: Path, kind: str, count: int
) -> None:
    wanted = tmp_path / f"wanted.{kind}"
    convert(recording, wanted)
    (result,) = resolve(recording, "-o", tmp_path / "out", "--format", kind, "--processes", count)
    if kind == "mcap":  # contains the time that each solve took
        assert messages_in(result["file"]) == messages_in(wanted)
    else:
        assert Path(result["file"]).read_bytes() == wanted.read_bytes()
    assert os.listdir(tmp_path / "out") == [f"run.{kind}"]
    assert result["fields"] == len(list(replay(recording))) > 250
    assert result["faults"] == result["notes"] == []


@pytest.mark.long
def test_the_file_of_a_damaged_recording_is_the_one_that_convert_writes(
    recording: Path, tmp_path: Path, in_turn: None
) -> None:
    """It says that frames are missing, so that events take effect by their times."""
    bad, wanted = tmp_path / "bad.log", tmp_path / "wanted.mcap"
    lines = recording.read_bytes().splitlines(keepends=True)
    lines[len(lines) // 2 : len(lines) // 2 + 60] = [b"garbage\n"]
    bad.write_bytes(b"".join(lines))
    bad.with_suffix(".jsonl").write_bytes(recording.with_suffix(".jsonl").read_bytes())
    convert(bad, wanted)
    options = ("--format", "mcap", "--processes", 1)
    (result,) = resolve(bad, "-o", tmp_path / "out", *options, status=1)
    assert messages_in(result["file"]) == messages_in(wanted)
    assert any("was repaired" in note for note in convert(wanted, tmp_path / "x.npz").notes)


def solved_live(recording: Path, **solver: object) -> dict[tuple[str, int], bytes]:
    """Replay with other options in the journal, as a host with these options would have solved the scans."""
    copy = recording.with_name("changed.log")
    first, *rest = recording.with_suffix(".jsonl").read_text().splitlines(keepends=True)
    header = json.loads(first)
    header["hand"]["solver"] = solver
    copy.write_bytes(recording.read_bytes())
    copy.with_suffix(".jsonl").write_text(json.dumps(header) + "\n" + "".join(rest))
    fields = {}
    for field in replay(copy):
        assert field.stamp is not None
        fields[field.stamp.patch, field.stamp.scan] = field.displacement_m.tobytes()
    return fields


@pytest.mark.long
def test_a_sweep_has_a_file_and_a_line_for_each_value(recording: Path, tmp_path: Path, in_turn: None) -> None:
    results = resolve(recording, "-o", tmp_path, "--set", "solver.method=exact,posterior", "--processes", 1)
    assert [each["settings"] for each in results] == [{"solver.method": m} for m in ("exact", "posterior")]
    for result in results:
        method = result["settings"]["solver.method"]
        assert Path(result["file"]).name == f"run-method={method}.parquet"
        table = pq.read_table(result["file"]).to_pylist()
        wanted = solved_live(recording, method=method)
        found = {(row["patch"], row["scan"]): np.array(row["displacement_m"]).tobytes() for row in table}
        assert found == wanted
        assert result["touched"] == sum(row["touched"] == 1 for row in table) > 20
        assert result["untrusted"] == sum(not row["trusted"] for row in table)
        assert result["contacts"] == sum(len(row["contacts"]) for row in table)
        assert {row["method"] for row in table if not all(row["held"])} <= {method}


@pytest.mark.long
def test_a_calibration_of_one_patch_changes_its_forces_only(recording: Path, tmp_path: Path) -> None:
    key = "patches.p1.calibration.young_pa"
    results = resolve(recording, "-o", tmp_path, "--set", f"{key}=1e6,2e6", "--processes", 1)
    soft, hard = (pq.read_table(each["file"]).to_pylist() for each in results)
    forces = 0
    for row, other in zip(soft, hard, strict=True):
        assert row["displacement_m"] == other["displacement_m"]
        for contact, twin in zip(row["contacts"], other["contacts"], strict=True):
            ratio = twin["normal_force_n"] / contact["normal_force_n"]
            assert ratio == pytest.approx(2.0 if row["patch"] == "p1" else 1.0, rel=1e-9)
            forces += row["patch"] == "p1"
    assert forces > 10


@pytest.mark.long
def test_a_replay_of_a_result_gives_its_fields(recording: Path, tmp_path: Path, in_turn: None) -> None:
    """The journal of the MCAP file contains the options with which it was solved."""
    setting = "solver.method=posterior"
    (result,) = resolve(recording, "-o", tmp_path, "--format", "mcap", "--set", setting, "--processes", 1)
    wanted = solved_live(recording, method="posterior")
    found = {}
    for field in replay(result["file"]):
        assert field.stamp is not None
        found[field.stamp.patch, field.stamp.scan] = field.displacement_m.tobytes()
    assert found == wanted


def job_of(recording: Path, folder: Path, count: int = 2) -> Any:
    (job,) = make_plan([recording_at(recording, None)], [()], folder, ".parquet", count)
    return job


@pytest.mark.long
def test_processes_that_are_killed_change_nothing(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One or two of them, while they work."""
    wanted = tmp_path / "wanted.parquet"
    convert(recording, wanted)
    started: list[processes.SpawnProcess] = []
    start = processes.Processes._start

    def watched(self: processes.Processes) -> Any:
        child = start(self)
        started.append(child.process)
        return child

    monkeypatch.setattr(processes.Processes, "_start", watched)
    killed = 0
    with work_folder(tmp_path) as folder, processes.Processes(2, folder) as workers:

        def kill(done: int, total: int, newest: str) -> None:
            nonlocal killed
            busy = [child for child in workers._children if child.unit is not None]
            if busy and killed < 2:
                busy[0].process.kill()
                killed += 1

        (summary,) = run([job_of(recording, tmp_path)], workers, PartFiles(folder), kill)
    assert killed > 0
    assert len(started) > 2  # others have taken their place
    assert (tmp_path / "run.parquet").read_bytes() == wanted.read_bytes()
    assert summary.sums.fields == len(list(replay(recording)))


def test_a_unit_that_kills_every_process_is_named(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = processes.Processes._start

    def killed(self: processes.Processes) -> Any:
        child = start(self)
        child.process.kill()
        return child

    monkeypatch.setattr(processes.Processes, "_start", killed)
    named = pytest.raises(SkinError, match=r"run\.log: its process ended 3 times \(.*-9\); .*--processes")
    with work_folder(tmp_path) as folder, processes.Processes(1, folder) as workers, named:
        run([job_of(recording, tmp_path, 1)], workers, PartFiles(folder), lambda *_: None)


def test_parts_of_another_version_are_not_used(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, job = PartFiles(tmp_path), job_of(recording, tmp_path)
    every = len(job.units(parts))
    with parts.new(job.captures[0].key) as part:
        part.summary = None
    assert len(job_of(recording, tmp_path).units(parts)) == every - 1
    monkeypatch.setattr(units, "_identity", {"skinnode": "another version"})
    assert len(job_of(recording, tmp_path).units(parts)) == every


@pytest.mark.long
def test_the_order_of_the_fields_does_not_depend_on_how_the_buses_are_divided(recording: Path) -> None:
    """A command may continue with another number of processes, and then reads parts of both divisions."""
    opened, hand = recording_at(recording, None)
    divisions = [[("can0", "can1")], [("can0",), ("can1",)]]
    places = []
    for division in divisions:
        scans = [
            item
            for buses in division
            for item in Capture(opened, hand, buses)
            if isinstance(item, CapturedScan)
        ]
        places.append({(scan.patch, scan.stamp.scan): scan.place for scan in scans})
    assert places[0] == places[1]
    assert len(set(places[0].values())) == len(places[0]) > 250


def foreign(recording: Path, folder: Path, lines: str = "") -> tuple[Path, Path]:
    """Write the recording as another master's log, and a hand file with ``lines`` in each patch."""
    opened = open_recording(recording)
    opened.frames.close()
    hand: HandConfig = opened.header.hand
    log, plan = folder / "other.log", folder / "hand.toml"
    log.write_bytes(recording.read_bytes())
    sizes = ", ".join(f"{key} = {value}" for key, value in {"upper_wires": 4, "upper_electrodes": 4}.items())
    text = "".join(f'[[buses]]\nname = "{bus.name}"\nchannel = "{bus.name}"\n' for bus in hand.buses)
    for patch in hand.patches:
        text += f'[[patches]]\nname = "{patch.name}"\nnode_id = {patch.node_id}\nbus = "{patch.bus}"\n{lines}'
        text += f'tolerances = "exact"\nlayout = {{ {sizes}, lower_wires = 12, lower_electrodes = 4 }}\n'
    plan.write_text(text + "[sync]\nperiod_ms = 25\n")
    return log, plan


@pytest.mark.long
def test_parts_of_another_baseline_are_not_used(recording: Path, tmp_path: Path) -> None:
    """Neither by the next run, nor by a worker of this run that sees the new file."""
    layout = PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=12, lower_electrodes=4
    )
    at_rest_ohm = resistance_ohm(layout, layout.upper_m)
    np.savetxt(tmp_path / "rest.txt", at_rest_ohm)
    log, plan = foreign(recording, tmp_path, 'baseline = "rest.txt"\n')

    def planned() -> Any:
        (job,) = make_plan([recording_at(log, load_hand(plan))], [()], tmp_path, ".parquet", 1)
        return job

    parts, job = PartFiles(tmp_path), planned()
    units.run_unit(job.captures[0], str(tmp_path), identity(), "a worker")
    assert planned().units(parts) == [*job.solves, job.write]
    np.savetxt(tmp_path / "rest.txt", 1.1 * at_rest_ohm)
    changed = planned()
    assert changed.units(parts) == [*changed.captures, *changed.solves, changed.write]
    assert not {unit.key for unit in job.units(parts)} & {unit.key for unit in changed.units(parts)}
    with pytest.raises(SkinError, match="is not the file that the command started with"):
        units.run_unit(job.solves[0], str(tmp_path), identity(), "a worker")
    (tmp_path / "rest.txt").unlink()
    with pytest.raises(SkinError, match=r"rest\.txt: cannot be read"):
        units.run_unit(changed.solves[0], str(tmp_path), identity(), "a worker")


@pytest.mark.long
def test_a_layout_file_is_found_from_any_folder(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name is relative to the folder of the command, and not to that of a worker."""
    layout = PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=12, lower_electrodes=4
    )
    np.savez(
        tmp_path / "layout.npz",
        upper_m=layout.upper_m,
        lower_m=layout.lower_m,
        resistivity_ohm_per_m=layout.resistivity_ohm_per_m,
    )
    monkeypatch.chdir(tmp_path)
    changed = variants(['patches.p0.layout={file="layout.npz"}'])
    (job,) = make_plan([recording_at(recording, None)], changed, tmp_path, ".parquet", 1)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    units.run_unit(job.captures[0], str(tmp_path), identity(), "a worker")
    assert job.captures[0].finished(PartFiles(tmp_path))


@pytest.mark.long
def test_the_layout_that_a_node_has_supplied_can_be_replaced(tmp_path: Path, in_turn: None) -> None:
    def a_hand(**layout: object) -> HandConfig:
        bus = {"name": "can0", "interface": "timed", "channel": "supplied"}
        patch = {"name": "p0", "node_id": 5, "layout": {**SMALL, **layout}, "tolerances": "exact"}
        return parse_hand({"buses": [bus], "patches": [patch], "sync": {"period_ms": 25}})

    high, hand, log = a_hand(height_m=3e-3), a_hand(coordinates="node"), tmp_path / "run.log"
    with (
        VirtualClock(),
        Fleet(high),
        Recorder(hand, log) as recorder,
        Host.from_config(hand, tap=recorder),
    ):
        clock.sleep(0.5)

    def rest_m(folder: str, *options: str) -> Any:
        (result,) = resolve(log, "-o", tmp_path / folder, "--format", "mcap", "--processes", 1, *options)
        run = replay(result["file"])
        assert len(list(run)) == result["fields"] > 5
        return run.layout("p0").upper_m

    planned_m = hand.patches[0].layout.build().upper_m
    np.testing.assert_allclose(rest_m("own"), planned_m + np.array([0.0, 0.0, 1e-3]), rtol=0, atol=1e-8)
    preset = ("--set", "patches.p0.layout.coordinates=preset")
    np.testing.assert_array_equal(rest_m("preset", *preset), planned_m)
    height = ("--set", "patches.*.layout.height_m=4e-3")
    np.testing.assert_allclose(
        rest_m("higher", *preset, *height), planned_m + np.array([0.0, 0.0, 2e-3]), atol=1e-12
    )
    assert "only with patches.p0.layout.coordinates=preset" in refusal(log, "-o", tmp_path / "x", *height)


_KILLED = """
import os, signal
from skinnode.cli.main import main
from skinnode.record.parquet_file import ParquetFile
from skinnode.resolve import processes
from tests.resolve.test_resolve import InTurn
ParquetFile.close = lambda table: os.kill(os.getpid(), signal.SIGKILL)
processes.Processes = InTurn
main()
"""
"""The command, which is killed before the first file of results is complete."""


@pytest.mark.long
def test_a_command_killed_while_it_writes_a_result_leaves_only_the_work_folder(
    recording: Path, tmp_path: Path, in_turn: None
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", _KILLED, "resolve", str(recording), "-o", str(out), "--processes", "1"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], check=False, timeout=120.0)
    assert done.returncode == -signal.SIGKILL
    assert os.listdir(out) == [WORK_FOLDER]
    resolve(recording, "-o", out, "--processes", 1)
    assert os.listdir(out) == ["run.parquet"]


class Killed(BaseException):
    """Stands in for SIGKILL."""


@pytest.mark.long
def test_a_command_killed_at_any_rename_of_its_result_continues(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before and after the renames of the result and of its part, whichever is first."""
    replace, kills = os.replace, 0
    synced: list[str] = []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    def killing(source: Path, target: Path) -> None:
        nonlocal kills
        of_result = Path(target).name in ("run.parquet", f"{job.write.key}.part")
        if of_result:
            assert str(source) in synced  # complete on disk before it gets its name
            for done in (False, True):
                if (Path(target).name, done) not in spared:
                    spared.add((Path(target).name, done))
                    kills += 1
                    if done:
                        replace(source, target)
                    raise Killed
        replace(source, target)

    with work_folder(tmp_path / "out") as folder:
        job = job_of(recording, tmp_path / "out", 1)
        spared: set[tuple[str, bool]] = set()
        monkeypatch.setattr(os, "replace", killing)
        monkeypatch.setattr(os, "fsync", watched)
        for _ in range(10):
            with suppress(Killed):
                (summary,) = run([job], InTurn(1, folder), PartFiles(folder), lambda *_: None)
                break
        monkeypatch.undo()
    assert kills == 4
    assert os.listdir(tmp_path / "out") == ["run.parquet"]
    assert pq.read_table(tmp_path / "out" / "run.parquet").num_rows == summary.sums.fields > 250


def test_results_of_long_settings_have_different_names(recording: Path, tmp_path: Path) -> None:
    gains = [f"[{', '.join(['1.000000000000000000000000000000001'] * 3)}, {last}]" for last in ("1.0", "1.1")]
    chosen = variants([f"patches.p0.calibration.upper_gain={','.join(gains)}"])
    jobs = make_plan([recording_at(recording, None)], chosen, tmp_path, ".parquet", 1)
    assert len({job.write.target for job in jobs}) == 2
    assert all(len(job.write.target.name) <= 128 for job in jobs)


COMMAND = [sys.executable, "-c", "from skinnode.cli.main import main; main()", "resolve"]


@pytest.mark.long
def test_a_killed_command_continues_where_it_was(recording: Path, tmp_path: Path) -> None:
    wanted = tmp_path / "wanted.parquet"
    convert(recording, wanted)
    out = tmp_path / "out"
    arguments = [str(recording), "-o", str(out), "--processes", "1"]
    with subprocess.Popen([*COMMAND, *arguments]) as child:
        end_s = time.monotonic() + 60.0
        while not (parts := sorted(out.glob(f"{WORK_FOLDER}/*.part"))) or len(parts) < 5:  # a patch is solved
            assert time.monotonic() < end_s
            assert child.poll() is None
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
    before = {part: part.stat().st_mtime_ns for part in parts}
    assert not (out / "run.parquet").exists()
    job, files = job_of(recording, out, 1), PartFiles(out / WORK_FOLDER)
    assert len(job.units(files)) < len([*job.captures, *job.solves, job.write])
    assert {part: part.stat().st_mtime_ns for part in parts} == before
    (result,) = resolve(*arguments)
    assert (out / "run.parquet").read_bytes() == wanted.read_bytes()
    assert os.listdir(out) == ["run.parquet"]
    assert result["fields"] == len(list(replay(recording)))


@pytest.mark.long
def test_unknown_deviations_do_not_lower_the_mean(recording: Path, tmp_path: Path, in_turn: None) -> None:
    """In the second half of the recording, all chunks are missing."""
    lossy = tmp_path / "lossy.log"
    lines = recording.read_text().splitlines(keepends=True)
    middle = len(lines) // 2
    kept = [line for line in lines[middle:] if not line.split()[2].startswith(("185#", "186#", "187#"))]
    lossy.write_text("".join(lines[:middle] + kept))
    lossy.with_suffix(".jsonl").write_bytes(recording.with_suffix(".jsonl").read_bytes())
    (result,) = resolve(lossy, "-o", tmp_path, "--processes", 1, status=1)
    table = pq.read_table(result["file"]).to_pylist()
    medians = np.array([np.median(np.array(row["displacement_std_m"]).reshape(-1, 3)[:, 2]) for row in table])
    known = np.isfinite(medians)
    assert 0.1 < known.mean() < 0.9
    assert result["mean_std_m"] == pytest.approx(medians[known].mean(), rel=1e-9)


def test_two_commands_do_not_share_a_folder(recording: Path, tmp_path: Path) -> None:
    with work_folder(tmp_path):
        said = refusal(recording, "-o", tmp_path)
    assert "allowed: a folder that no other skinnode resolve is using" in said


@pytest.mark.long
def test_a_damaged_recording_is_solved_and_named(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.log"
    data = recording.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    journal = recording.with_suffix(".jsonl").read_text().splitlines(keepends=True)
    cut.with_suffix(".jsonl").write_text("".join(journal[:-1]))
    (result,) = resolve(cut, "-o", tmp_path / "out", "--processes", 2, status=1)
    played = replay(cut)
    assert result["fields"] == len(list(played)) > 50
    assert result["faults"][:2] == played.flaws[:2]
    assert any("not ended properly" in fault for fault in result["faults"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["--set", "solver.metod=exact"],
            "solver.metod: got an unknown key, allowed: a key of this table (did",
        ),
        (["--set", "solver.method=fast"], "solver.method: got 'fast', allowed: auto or exact or posterior"),
        pytest.param(
            ["--set", "method=exact"],
            "--set: got 'method', allowed: solver.KEY, or patches.NAME.KEY",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "solver.method"],
            "--set: got 'solver.method', allowed: KEY=VALUE",
            marks=pytest.mark.long,
        ),
        pytest.param(["--set", "solver.deadline_us=100"], "allowed: no time limit", marks=pytest.mark.long),
        (["--set", "patches.p9.relative_noise=1e-5"], "allowed: a patch of the recording: p0, p1, p2; or *"),
        pytest.param(
            ["--set", "patches.p0.node_id=9"],
            "--set: got 'patches.p0.node_id', allowed: solver.KEY",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "solver.drift=wire", "--set", "solver.drift=none"],
            "solver.drift only once",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "solver.method=exact", "--set", "solver.drift=wire"],
            "cannot be solved with these settings",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "solver.max_std_m=1e-3,0.001"],
            "values that differ; these have the same effect as max_std_m=1e-3",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "solver.method=exact,exact"],
            "values that differ; these have the same effect as method=exact",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--set", "patches.*.relative_noise=0"],
            "patches[0].relative_noise: got 0, allowed: a number of at least",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--processes", "1", "--scheduler", "tcp://127.0.0.1:1"],
            "allowed: only without --scheduler",
            marks=pytest.mark.long,
        ),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line(
    recording: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    assert said in refusal(recording, "-o", tmp_path / "out", *options)
    if "cannot be solved" not in said:
        assert not (tmp_path / "out").exists()


def test_files_that_cannot_be_used_are_one_line(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "other.log").write_text("(1.000000) can0 185#00 R\n")
    (tmp_path / "x.txt").write_text("no recording")
    out = tmp_path / "out"
    assert "allowed: a journal next to the log" in refusal(tmp_path / "other.log", "-o", out)
    assert "allowed: a file ending in" in refusal(tmp_path / "x.txt", "-o", out)
    twin = tmp_path / "run.log"
    for suffix in (".log", ".jsonl"):
        twin.with_suffix(suffix).write_bytes(recording.with_suffix(suffix).read_bytes())
    assert "allowed: recordings whose names differ" in refusal(recording, twin, "-o", out)
    assert not out.exists()
    out.mkdir()
    (out / "run.parquet").write_text("mine")
    assert "allowed: a new file; this one already exists" in refusal(recording, "-o", out)
    assert (out / "run.parquet").read_text() == "mine"


def test_a_recording_that_changes_meanwhile_is_refused(recording: Path, tmp_path: Path) -> None:
    twin = tmp_path / "twin.log"
    for suffix in (".log", ".jsonl"):
        twin.with_suffix(suffix).write_bytes(recording.with_suffix(suffix).read_bytes())
    known, hand = recording_at(twin, None)
    twin.write_bytes(recording.read_bytes() + b"\n")
    with pytest.raises(SkinError, match="is not the file that the command started with"):
        known.opened(hand)


@pytest.mark.long
def test_a_log_of_another_master_is_solved_with_the_hand_file(
    recording: Path, tmp_path: Path, in_turn: None
) -> None:
    log, plan = foreign(recording, tmp_path)
    arguments = ["--hand", plan, "--processes", 2, "-o", tmp_path / "out"]
    (result,) = resolve(log, *arguments, status=0)
    wanted = tmp_path / "wanted.parquet"
    convert(log, wanted, hand=load_hand(plan))
    assert Path(result["file"]).read_bytes() == wanted.read_bytes()
    assert len(result["notes"]) == 3
