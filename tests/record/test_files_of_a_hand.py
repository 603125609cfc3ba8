"""Hands with data in files are recorded with these data: layout files, and baselines of silent guests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.record import Recorder, replay
from skinnode.record.convert import convert
from skinnode.record.replay import Replay
from skinnode.remote.description import Description
from skinnode.resolve.recording import recording_at
from skinnode.resolve.settings import apply, variants
from tests.lanes import some_long
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .test_replay import a_hand, key

FILE = "palm.npz"
LAYOUT = PatchLayout.preset("staggered", pitch_m=8e-3, height_m=4e-3, upper_wires=3, upper_electrodes=4)


def with_layout_file(folder: Path) -> HandConfig:
    """p0 has 3 x 12 wires, a pitch of 8 mm and a height of 4 mm, as in its layout file; p1 has no file."""
    np.savez(folder / FILE, upper_m=LAYOUT.upper_m, lower_m=LAYOUT.lower_m, resistivity_ohm_per_m=2e7)
    table = a_hand().model_dump(mode="json", exclude_defaults=True)
    table["patches"][0] |= {"layout": {"file": FILE}, "calibration": {"upper_gain": [1.0, 1.01, 1.0]}}
    return parse_hand(table, folder=folder)


def taken(host: Host, seconds: float) -> Iterator[FieldFrame]:
    fields, end_s = host.fields(capacity=1000), clock.monotonic() + seconds
    while clock.monotonic() < end_s:
        field = fields.get(0.1)
        if field is not None:
            yield field


Recorded = tuple[Path, dict[tuple[str, int], bytes]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("files")
    hand, path = with_layout_file(folder), folder / "run.log"
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        live = {key(field): field.displacement_m.tobytes() for field in taken(host, 1.5)}
    assert recorder.stats().failure is None
    assert {patch for patch, _ in live} == {"p0", "p1"}
    (folder / FILE).rename(folder / f"kept-{FILE}")  # a recording needs no other file
    return path, live


@pytest.mark.long
@pytest.mark.parametrize("suffix", some_long([".log", ".mcap"], ".mcap"))
def test_a_layout_file_is_in_the_recording(recorded: Recorded, tmp_path: Path, suffix: str) -> None:
    path, live = recorded
    if suffix == ".mcap":
        path = tmp_path / "run.mcap"
        convert(recorded[0], path)
    run = replay(path)
    found = {key(field): field.displacement_m.tobytes() for field in run}
    assert run.flaws == []
    assert {which: found.get(which) for which in live} == live
    for layout in (run.hand.patch("p0").layout.build(), run.layout("p0")):
        assert layout.upper_m.tobytes() == LAYOUT.upper_m.tobytes()
        assert layout.lower_m.tobytes() == LAYOUT.lower_m.tobytes()
        assert (layout.resistivity_ohm_per_m, layout.name) == (2e7, "palm")


def as_an_older_version_wrote_it(path: Path, folder: Path) -> Path:
    """Return a copy of a recording whose journal lacks the layout of p0 and its file."""
    copy = folder / "run.log"
    copy.write_bytes(path.read_bytes())
    lines = [json.loads(line) for line in path.with_suffix(".jsonl").read_text().splitlines()]
    del lines[0]["hand"]["patches"][0]["layout"]["electrodes"]
    del lines[0]["hand"]["patches"][0]["calibration"]  # older versions could not read it back
    assert all(line["facts"]["layout"] is None for line in lines if "facts" in line)
    copy.with_suffix(".jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return copy


@pytest.mark.long
def test_a_recording_that_lacks_a_layout_file_is_not_solved_with_another_layout(
    recorded: Recorded, tmp_path: Path
) -> None:
    path, live = recorded
    run = replay(as_an_older_version_wrote_it(path, tmp_path))
    found = {key(field): field.displacement_m.tobytes() for field in run}
    assert {patch for patch, _ in found} == {"p1"}
    assert {which: found.get(which) for which in live if which[0] == "p1"}.items() <= live.items()
    (complaint,) = [flaw for flaw in run.flaws if "p0" in flaw]
    assert "lacks the layout file of p0; solve it with skinnode resolve" in complaint


@pytest.mark.long
def test_the_layout_file_can_be_given_later(recorded: Recorded, tmp_path: Path) -> None:
    path, live = recorded
    recording, hand = recording_at(as_an_older_version_wrote_it(path, tmp_path), None)
    options = [
        f'patches.p0.layout={{file="{path.parent}/kept-{FILE}"}}',
        "patches.p0.calibration.upper_gain=[1.0, 1.01, 1.0]",
    ]
    (variant,) = variants(options)
    run = Replay(recording.opened(apply(hand, variant)))
    found = {key(field): field.displacement_m.tobytes() for field in run}
    assert run.flaws == []
    assert {which: found.get(which) for which in live} == live


@pytest.mark.long
def test_a_file_that_changes_during_a_run_does_not_change_the_recording(tmp_path: Path) -> None:
    hand, path = with_layout_file(tmp_path), tmp_path / "run.log"
    with VirtualClock(), Fleet(hand), Recorder(hand, path) as recorder:
        other = PatchLayout.preset("staggered", upper_wires=3, upper_electrodes=4)
        with Host.from_config(hand, tap=recorder) as host:
            np.savez(tmp_path / FILE, upper_m=other.upper_m, lower_m=other.lower_m)
            live = {key(field): field.displacement_m.tobytes() for field in taken(host, 0.5)}
    found = {key(field): field.displacement_m.tobytes() for field in replay(path)}
    assert {which: found.get(which) for which in live} == live
    assert "p0" in {patch for patch, _ in live}


def test_programs_get_the_layout_file(tmp_path: Path) -> None:
    """A program compares the hands of a daemon before and after a restart."""
    hand = with_layout_file(tmp_path)
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    sent = Description(hand, layouts, "boot", commands=True, started_ns=1).encode()
    first = Description.decode(sent, "hand").hand
    assert first.patch("p0").layout.build().upper_m.tobytes() == LAYOUT.upper_m.tobytes()
    np.savez(tmp_path / FILE, upper_m=LAYOUT.upper_m * 1.5, lower_m=LAYOUT.lower_m)
    second = Description.decode(
        Description(hand, layouts, "boot", commands=True, started_ns=1).encode(), "hand"
    ).hand
    assert second != first


def guest_of(hand: HandConfig, journal: Path, period_ms: int) -> HandConfig:
    """A guest that sends nothing and takes the baselines, which a master has recorded, from files."""
    table: dict[str, Any] = hand.model_dump(mode="json", exclude_defaults=True)
    table["buses"][0]["role"] = "guest"
    table["sync"] = {"period_ms": period_ms}
    for line in journal.read_text().splitlines()[1:]:
        event = json.loads(line)
        if "facts" in event:
            (patch,) = [patch for patch in table["patches"] if patch["name"] == event["patch"]]
            patch["baseline"] = f"{event['patch']}.txt"
            np.savetxt(journal.parent / patch["baseline"], event["facts"]["baseline_ohm"], fmt="%.17g")
    return parse_hand(table, folder=journal.parent)


@pytest.mark.long
def test_the_recording_of_a_guest_that_sends_nothing_is_replayed(tmp_path: Path) -> None:
    """80 ms is the default period, but a guest must give it."""
    table = a_hand().model_dump(mode="json", exclude_defaults=True) | {"sync": {"period_ms": 80}}
    hand = parse_hand(table)
    with ExitStack() as stack:
        stack.enter_context(VirtualClock())
        stack.enter_context(Fleet(hand))
        recorder = stack.enter_context(Recorder(hand, tmp_path / "master.log"))
        stack.enter_context(Host.from_config(hand, tap=recorder))
        clock.sleep(0.5)
        guest = guest_of(hand, tmp_path / "master.jsonl", 80)
        own = stack.enter_context(Recorder(guest, tmp_path / "guest.log"))
        with Host.from_config(guest, tap=own) as host:
            live = {key(field): field.displacement_m.tobytes() for field in taken(host, 1.0)}
    assert len(live) > 10
    run = replay(tmp_path / "guest.log")
    found = {key(field): field.displacement_m.tobytes() for field in run}
    assert {which: found.get(which) for which in live} == live


def test_a_layout_has_one_source() -> None:
    origin, above = [[[0.0, 0.0, 0.0]]], [[[0.0, 0.0, 1e-3]]]
    good: dict[str, Any] = {"upper_m": above, "lower_m": origin, "resistivity_ohm_per_m": 1e7}
    ragged = [[[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]]
    for layout, says in (
        (
            {"electrodes": good, "pitch_m": 1e-3},
            "pitch_m: got 0.001, allowed: only without layout.electrodes",
        ),
        ({"electrodes": good | {"upper_m": [[[0.0, 1.0]]]}}, "layout.electrodes.upper_m"),
        ({"electrodes": good | {"upper_m": origin}}, "an electrode is 0.0 m from a lower"),
        ({"electrodes": good | {"lower_m": ragged}}, "layout.electrodes.lower_m"),
    ):
        patch = {"name": "a", "node_id": 1, "layout": layout}
        with pytest.raises(ConfigError) as refused:
            parse_hand({"buses": [{}], "patches": [patch]})
        assert says in str(refused.value)
        assert "\n" not in str(refused.value)
