"""``skinnode hand``: what an integrator sees before anything is on a bus."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import skinnode as sk
import skinnode.host.solve_rate
from skinnode.bus_load.plan import check_plan
from skinnode.cli.main import app
from skinnode.config import HandConfig, load_hand, parse_hand
from skinnode.config.schema import SCHEMA_FILE, schema_text
from skinnode.errors import ConfigError
from skinnode.host.limitations import limitations
from skinnode.host.solve_rate import SolveRate

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))


@pytest.fixture(autouse=True)
def _few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most tests do not depend on how long a scan takes to solve, so it is measured in two frames."""
    monkeypatch.setattr(skinnode.host.solve_rate, "FRAMES", 2)


def command(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["hand", *arguments])


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_a_plan_that_fits(path: Path) -> None:
    found = command("check", str(path), "--json")
    assert found.exit_code == 0, found.output
    report = json.loads(found.stdout)
    assert report["refused"] == []
    hand = load_hand(path)
    assert [bus["bus"] for bus in report["buses"]] == [bus.name for bus in hand.buses]
    for bus in report["buses"]:
        assert 0 < bus["typical_load"] < bus["load"] <= bus["max_load"]
        assert all(
            scan["paced_s"] < scan["sync_to_summary_s"] < bus["sync_period_s"] for scan in bus["scans"]
        )
        assert sum(frame["load"] for frame in bus["frames"]) == pytest.approx(bus["load"])


def test_there_is_an_example_of_each_kind() -> None:
    hands = [load_hand(path) for path in EXAMPLES]
    assert any(len(hand.buses) == 2 and len(hand.patches) == 16 for hand in hands)
    assert any(bus.role == "guest" for hand in hands for bus in hand.buses)
    assert any(bus.fd for hand in hands for bus in hand.buses)


def test_tables_for_a_person() -> None:
    lines = command("check", str(next(path for path in EXAMPLES if path.stem == "hand"))).stdout.splitlines()
    assert lines[0] == "example hand: 4 patches on 1 bus, a scan every 80 ms"
    # 404 chunks and summaries of 135 bits and a SYNC of 65 in 80 ms, 4 heartbeats and EMCYs in 250, SDO 1 %
    assert "load 69.6% at worst" in lines[2]
    assert "of 70% allowed" in lines[2]
    assert any(line.split()[:4] == ["palm", "14", "100", "59.4"] for line in lines)


@pytest.mark.long
def test_how_long_frames_of_others_wait(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(
        '[[buses]]\nname = "can0"\nothers = [{ can_id = 0x070, length = 6, period_ms = 8 }]\n'
        '[[patches]]\nname = "p"\nnode_id = 1\n'
    )
    lines = command("check", str(path)).stdout.splitlines()
    assert any(line.split() == ["0x070", "6", "8", "0.25"] for line in lines)
    (frame,) = [
        frame
        for frame in json.loads(command("check", str(path), "--json").stdout)["buses"][0]["frames"]
        if frame["can_id"] == 0x070
    ]
    assert frame["worst_response_s"] == pytest.approx(250e-6, abs=1e-8)


def overloaded(folder: Path) -> Path:
    path = folder / "hand.toml"
    patches = "".join(f'[[patches]]\nname = "p{i}"\nnode_id = {i}\n' for i in range(1, 6))
    path.write_text(f'[[buses]]\nname = "can0"\n{patches}')
    return path


@pytest.mark.long
def test_too_much_for_a_bus_is_shown_and_refused(tmp_path: Path) -> None:
    path = overloaded(tmp_path)
    found = command("check", str(path))
    assert found.exit_code == 1
    assert "SYNC to summary" in found.stdout
    assert found.stderr == (
        f"error: {path}:1:1: buses[0] (can0): got a plan that needs 86.7% of 1000000 bit/s, "
        "allowed: at most 70.0% (max_load); sync.period_ms = 100 or fewer patches would suffice\n"
    )
    as_json = command("check", str(path), "--json")
    assert as_json.exit_code == 1
    assert json.loads(as_json.stdout)["buses"][0]["shortest_period_ms"] == 100


@pytest.mark.long
def test_a_scan_that_may_outlast_its_period_is_noted(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(
        '[sync]\nperiod_ms = 3\n[[buses]]\nname = "can0"\nfd = true\n[[patches]]\nname = "p"\nnode_id = 1\n'
    )
    found = command("check", str(path))
    assert found.exit_code == 0
    assert "note: in the worst case, a scan of p does not end before the next SYNC" in found.stdout


def test_a_file_that_cannot_be_used(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text('[[buses]]\nname = "can0"\n[[patches]]\nname = "p"\nnode_id = 1\n  code_bit = 16\n')
    error = command("check", str(path)).exception
    assert isinstance(error, ConfigError)
    assert str(error).startswith(
        f"{path}:6:3: patches[0].code_bit: got an unknown key, allowed: a key of this table (did you mean"
    )


@pytest.mark.parametrize("key", ["eds", "baseline"])
def test_files_that_a_hand_names_are_read(key: str, tmp_path: Path) -> None:
    other = tmp_path / "other.txt"
    other.write_text("root:x:0:0:root:/root:/bin/bash\n")
    path = tmp_path / "hand.toml"
    path.write_text(f'[[buses]]\nname = "can0"\n[[patches]]\nname = "p"\nnode_id = 1\n{key} = "other.txt"\n')
    found = command("check", str(path))
    assert isinstance(found.exception, ConfigError)
    assert (
        str(found.exception)
        == {
            "eds": f"{other}:1: EDS: got 'root:x:0:0:root:/root:/bin/bash', "
            "allowed: a file in CiA 306 format: each [section] once, each key once per section, "
            "';' before comments",
            "baseline": f"{other}: baseline, line 1: got 'root:x:0:0:root:/root:/bin/bash', "
            "allowed: 10 lines of 30 positive resistances in ohms",
        }[key]
    )


@pytest.mark.parametrize("patches", [1, 4, 16, 127])
def test_a_new_file_is_a_plan_that_fits(patches: int, tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(command("new", "--patches", str(patches)).stdout)
    hand = load_hand(path)
    assert len(hand.patches) == patches
    (plan,) = check_plan(hand)
    assert patches < 4 or plan.load > 0.6  # no slower than it has to be


@pytest.mark.parametrize(("buses", "patches"), [(2, 5), (3, 3), (16, 127)])
def test_a_new_file_of_several_buses_is_a_plan_that_fits(buses: int, patches: int, tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(command("new", "--buses", str(buses), "--patches", str(patches)).stdout)
    hand = load_hand(path)
    counts = [len(hand.patches_on(bus.name)) for bus in hand.buses]
    assert (len(counts), sum(counts)) == (buses, patches)
    assert max(counts) - min(counts) <= 1
    assert len({patch.node_id for patch in hand.patches}) == patches  # a node-ID alone names a patch
    check_plan(hand)


def test_more_buses_than_patches_are_refused() -> None:
    found = command("new", "--buses", "3", "--patches", "2")
    assert str(found.exception).startswith("--buses: got 3, allowed: at most 2")


def test_a_misspelt_interface_is_found(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(command("new").stdout.replace('"udp_multicast"', '"udpmulticast"'))
    said = str(command("check", str(path)).exception)
    assert said.startswith(f"{path}:10:1: buses[0].interface: got 'udpmulticast', allowed: one of ")
    assert said.endswith("did you mean 'udp_multicast'?")


def test_comments_of_a_new_file_are_keys() -> None:
    text = command("new", "--patches", "1").stdout
    said = re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)
    import tomllib

    hand = parse_hand(tomllib.loads(said))
    assert (hand.patches[0].serial, hand.patches[0].link) == (12345, "palm_link")
    assert (hand.solver.max_std_m, hand.solver.max_force_std_n) == (20e-6, 0.1)
    assert hand.patches[0].calibration.force_calibrated


def test_schema_is_the_one_that_is_shipped() -> None:
    printed = command("schema").stdout
    assert printed == schema_text()
    assert json.loads(SCHEMA_FILE.read_text(encoding="utf-8")) == json.loads(printed), (
        "python -m skinnode.config.schema writes it again"
    )


def test_every_key_is_described() -> None:
    tables = json.loads(schema_text())
    described: dict[str, Any] = {"HandConfig": tables, **tables["$defs"]}
    bare = [
        f"{name}.{key}"
        for name, table in described.items()
        for key, field in table["properties"].items()
        if "description" not in field and "$ref" not in field
    ]
    assert bare == []
    assert set(tables["properties"]) == set(HandConfig.model_fields)


def notes(folder: Path, text: str) -> list[dict[str, Any]]:
    """Notes of `hand check` on a hand of one or more patches; each is also a line for a person."""
    path = folder / "hand.toml"
    path.write_text(f'[[buses]]\nname = "can0"\n[sync]\nperiod_ms = 400\n{text}')
    found = command("check", str(path), "--json")
    assert found.exit_code == 0, found.output
    listed: list[dict[str, Any]] = json.loads(found.stdout)["notes"]
    lines = [line for line in command("check", str(path)).stdout.splitlines() if line.startswith("note: ")]
    assert len(lines) == len(listed)
    for note, line in zip(listed, lines, strict=True):  # a time is measured anew
        assert re.sub(r"\d+", "#", note["text"]) in re.sub(r"\d+", "#", line)
    return listed


PALM = '[[patches]]\nname = "palm"\nnode_id = 1\n'
TIP = '[[patches]]\nname = "tip"\nnode_id = 2\n'
PLACED = "pose = { position_m = [0.0, 0.0, 0.01] }\n"
EXACT = 'tolerances = "exact"\n'


def said(listed: list[dict[str, Any]], key: str) -> dict[str, str]:
    """Text by patches of the notes on one key."""
    return {", ".join(note["patches"]): note["text"] for note in listed if note["key"] == key}


def test_a_hand_whose_displacements_come_from_the_prior_says_so(tmp_path: Path) -> None:
    thick = 'layout = { preset = "aligned", height_m = 4e-3 }\n'
    few = "layout = { lower_wires = 20 }\n"
    listed = notes(tmp_path, PALM + thick + TIP + few)
    by_layout = said(listed, "patches.layout")
    assert "resistances alone give errors of ± 225% of the clearance" in by_layout["palm"]
    assert "20 lower wires for 30 unknowns per upper wire" in by_layout["tip"]
    assert not said(notes(tmp_path, PALM), "patches.layout")


@pytest.mark.long
def test_the_exact_inverse_where_it_is_useless(tmp_path: Path) -> None:
    thick = 'layout = { preset = "aligned", height_m = 4e-3 }\n'
    solver = '[solver]\nmethod = "exact"\n'
    assert "too large to be" in said(notes(tmp_path, solver + PALM + thick + EXACT), "solver.method")["palm"]
    said_of_method = said(notes(tmp_path, solver + PALM), "solver.method")
    assert "cannot account for the patch's tolerances" in said_of_method["palm"]
    assert not said(notes(tmp_path, solver + PALM + EXACT), "solver.method")
    assert not said(notes(tmp_path, PALM), "solver.method")


def test_a_layout_that_the_host_would_refuse(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    few = "layout = { lower_wires = 20 }\n"
    path.write_text(
        '[[buses]]\nname = "can0"\n[sync]\nperiod_ms = 400\n[solver]\nmethod = "exact"\n' + PALM + few
    )
    refused = command("check", str(path)).exception
    assert isinstance(refused, ConfigError)
    assert str(refused).startswith("patch 'palm'")
    assert "20 lower wires for 30 unknowns" in str(refused)


def test_discs_are_recommended_where_they_help(tmp_path: Path) -> None:
    noisy = "relative_noise = 1e-3\n"
    cells = '[solver]\nprior = "cells"\n'
    assert 'prior = "auto"' in said(notes(tmp_path, cells + PALM + noisy + TIP), "solver.prior")["palm"]
    assert not said(notes(tmp_path, PALM + noisy), "solver.prior")


@pytest.mark.long
def test_how_many_scans_can_be_solved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hand.toml"
    path.write_text('[[buses]]\nname = "can0"\n[sync]\nperiod_ms = 400\n[solver]\nworkers = 2\n' + PALM + TIP)
    solving = json.loads(command("check", str(path), "--json").stdout)["solving"]
    assert set(solving["scan_s"]) == {"palm", "tip"}
    assert 1e-5 < solving["scan_s"]["palm"] < 10
    assert solving["rate_hz"] == pytest.approx(2 / sum(solving["scan_s"].values()))
    line = next(line for line in command("check", str(path)).stdout.splitlines() if "solving: " in line)
    assert re.search(
        r"scans/s of each patch with 2 threads if all patches are touched \(2\.5 planned\)", line
    )
    monkeypatch.setattr(skinnode.host.solve_rate, "is_cold", lambda _: True)
    assert json.loads(command("check", str(path), "--json").stdout)["solving"] is None
    assert "solving: not measured" in command("check", str(path)).stdout


def test_a_computer_that_is_too_slow_for_the_planned_rate(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text('[[buses]]\nname = "can0"\n[sync]\nperiod_ms = 400\n' + PALM + TIP)
    hand = load_hand(path)
    slow, fast = (SolveRate(1, {"palm": 3 * share, "tip": share}) for share in (0.11, 0.09))
    (note,) = [limit for limit in limitations(hand, slow) if limit.key == "sync.period_ms"]
    assert "solves 2.27 scans per second of each patch, fewer than the planned 2.5" in note.text
    assert not [limit for limit in limitations(hand, fast) if limit.key == "sync.period_ms"]
    assert SolveRate(4, {"palm": 0.5, "tip": 0.1}).rate_hz == 2.0  # a patch has at most one thread


@pytest.mark.long
def test_forces_that_are_not_calibrated(tmp_path: Path) -> None:
    calibrated = "calibration = { young_pa = 0.8e6, force_calibrated = true }\n"
    listed = notes(tmp_path, PALM + calibrated + TIP)
    assert list(said(listed, "patches.calibration")) == ["tip"]
    assert "no calibrated forces" in said(listed, "patches.calibration")["tip"]


def test_where_contacts_cannot_be_placed(tmp_path: Path) -> None:
    listed = notes(tmp_path, PALM + TIP)
    assert said(listed, "patches.pose") == {
        "palm, tip": "no pose: contacts are in the patch's own coordinate frame"
    }
    listed = notes(tmp_path, PALM + PLACED + TIP + PLACED + 'link = "distal"\n')
    assert not said(listed, "patches.pose")
    assert "'distal' has no pose in the hand" in said(listed, "links")["tip"]
    linked = '[[links]]\nname = "distal"\n'
    assert not said(notes(tmp_path, PALM + PLACED + TIP + PLACED + 'link = "distal"\n' + linked), "links")


def test_what_the_solver_leaves_out_or_cannot_reach(tmp_path: Path) -> None:
    listed = notes(tmp_path, "[solver]\nnormal_only = true\nmax_std_m = 1e-9\n" + PALM + PLACED + EXACT)
    assert said(listed, "solver.normal_only") == {"palm": "no shear displacements and no shear forces"}
    assert "no field will be precise" in said(listed, "solver.max_std_m")["palm"]
    roomy = notes(tmp_path, "[solver]\nmax_std_m = 1e-4\n" + PALM + PLACED + EXACT)
    assert not said(roomy, "solver.max_std_m")
    assert not said(roomy, "solver.normal_only")


@pytest.mark.long
@pytest.mark.parametrize(("deadline_us", "met"), [(100, False), (10_000_000, True)])
def test_a_deadline_that_a_new_touch_cannot_meet(tmp_path: Path, deadline_us: int, met: bool) -> None:
    sk.Posterior(sk.PatchLayout.preset("staggered"))  # the deadline is checked with compiled kernels only
    listed = said(notes(tmp_path, f"[solver]\ndeadline_us = {deadline_us}\n" + PALM), "solver.deadline_us")
    assert bool(listed) is not met
    assert met or f"longer than the deadline of {deadline_us} µs" in listed["palm"]
