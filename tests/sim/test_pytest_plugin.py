"""pytest plugin: fixtures of a simulated hand on the bus that an option chooses, and what a failure keeps."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HAND = """
[[buses]]
name = "can0"

[sync]
period_ms = 50

[[patches]]
name = "palm"
node_id = 4
tolerances = "exact"
layout = { upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4 }
"""
SCENE = """
[[bodies]]
name = "ball"
shape = "sphere"
radius_m = 0.01

[[touches]]
body = "ball"
patch = "palm"
at_m = [0.004, 0.004]
force_n = 0.5
from_s = 0.5
to_s = 4.0
"""
SUITE = """
import pytest
from vcan_sim.testing import eventually, within


@pytest.fixture
def host(skin_hand, skin_host):
    skin_hand("hand.toml", scene="press.toml")
    return skin_host()


def test_a_press_is_felt(host, skin_truth):
    fields = host.fields(timeout_s=5)
    eventually(lambda: any(contact.force_n[2] < -0.4 for contact in skin_truth(fields.get()).contacts))
    field = fields.get()
    moved = skin_truth(field).displacement_m
    assert moved[..., 2].min() < -1e-5
    assert field.trusted
    assert (abs(field.displacement_m - moved) < 5 * field.displacement_std_m).all()


def test_a_patch_that_is_unplugged_comes_back(host, skin_faults):
    skin_faults.inject("palm", unplugged=True)
    eventually(lambda: host.health("palm").condition == "lost")
    skin_faults.clear()
    with within(5.0):
        eventually(lambda: host.health("palm").condition == "operational")


@pytest.mark.skin_bus("timed")
def test_a_bus_with_a_second_master(host, skin_faults, skin_clock):
    skin_faults.inject("can0", rogue_sync_per_s=50.0)
    skin_clock.sleep(1.0)
    skin_faults.clear("can0")
    assert 49 <= skin_faults.injected_bus("can0").rogue_sync <= 51


@pytest.mark.skin_bus("timed")
def test_time_passes(host, skin_clock):
    begin_s = skin_clock.monotonic()
    skin_clock.sleep(5.0)
    assert abs(skin_clock.monotonic() - begin_s - 5.0) < 1e-9
    assert host.stats().patches["palm"].solved > 90


def test_that_fails(host):
    host.fields(timeout_s=5).get()
    assert host.health("palm").condition == "lost"
"""


Run = tuple[Path, subprocess.CompletedProcess[str]]


def run(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "hand.toml").write_text(HAND)
    (folder / "press.toml").write_text(SCENE)
    (folder / "test_grip.py").write_text(SUITE)
    without = [f"-pno:{plugin}" for plugin in ("cacheprovider", "xdist", "hypothesispytest", "anyio")]
    command = [sys.executable, "-m", "pytest", *without, "-rA", *options]
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTEST_ADDOPTS": ""}, capture_output=True, text=True,
        timeout=100, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def in_virtual_time(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The whole suite, run once, as no option asks for a bus."""
    folder = tmp_path_factory.mktemp("virtual")
    return folder, run(folder)


@pytest.mark.long
def test_the_same_suite_in_virtual_and_in_real_time(in_virtual_time: Run, tmp_path: Path) -> None:
    for done, passed, skipped in ((in_virtual_time[1], 4, 0), (run(tmp_path, "--skin-bus=virtual"), 2, 2)):
        assert re.search(rf"1 failed, {passed} passed(, {skipped} skipped)? in", done.stdout), done.stdout
        assert bool(skipped) == ("--skin-bus is virtual" in done.stdout)


@pytest.mark.long
def test_what_a_failure_keeps(in_virtual_time: Run) -> None:
    tmp_path, done = in_virtual_time
    folder = tmp_path / "skin-kept" / "test_grip.py_test_that_fails"
    kept = "trace.log, truth.npz, scene.json, scene.png"
    assert f"kept in {folder.relative_to(tmp_path)}: {kept}" in done.stdout
    frames = (folder / "trace.log").read_text().splitlines()
    assert all(re.fullmatch(r"\(\d+\.\d{6}\) \S+ [0-9A-F]{3}#[0-9A-F]*", line) for line in frames)
    assert any(" 080#" in line for line in frames)  # SYNC
    truth = np.load(folder / "truth.npz")
    assert truth["palm displacement_m"].shape == (len(truth["palm time_ns"]), 4, 4, 3)
    assert json.loads((folder / "scene.json").read_text())["bodies"][0]["name"] == "ball"
    assert (folder / "scene.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_scene_of_faults_is_kept_without_a_plot(tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text("[[faults]]\nwhere = 'palm'\nfault = 'frozen'\n")
    (tmp_path / "test_faults.py").write_text(
        "def test_fails(skin_hand):\n    skin_hand('hand.toml', scene='faults.toml')\n    assert False\n"
    )
    printed = run(tmp_path, "test_faults.py").stdout
    assert "test_faults.py_test_fails: trace.log, truth.npz, scene.json\n" in printed


@pytest.mark.long
def test_a_failed_set_up_is_kept(tmp_path: Path) -> None:
    (tmp_path / "test_early.py").write_text(
        "import pytest\n\n\n@pytest.fixture\ndef ready(skin_hand):\n    skin_hand('hand.toml')\n"
        "    raise AssertionError\n\n\ndef test_early(ready):\n    pass\n"
    )
    printed = run(tmp_path, "test_early.py").stdout
    assert "1 error in" in printed
    assert "test_early.py_test_early: trace.log, truth.npz\n" in printed
    kept = tmp_path / "skin-kept" / "test_early.py_test_early"
    assert np.load(kept / "truth.npz")["palm displacement_m"].shape[1:] == (4, 4, 3)


EXAMPLE = str(Path(__file__).parents[2] / "examples" / "hand.toml")


@pytest.mark.long
def test_a_shipped_scene_is_played_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "test_named.py").write_text(
        f"def test_named(skin_hand, skin_clock):\n    skin_hand({EXAMPLE!r}, scene='taps')\n\n\n"
        "def test_unknown(skin_hand):\n    skin_hand('hand.toml', scene='tabs')\n"
    )
    printed = run(tmp_path, "test_named.py").stdout
    assert "1 failed, 1 passed" in printed
    assert "ConfigError: scene: got 'tabs', allowed: a scene file, or one of faults, press, taps" in printed


@pytest.mark.long
def test_bad_use_is_one_line(tmp_path: Path) -> None:
    done = run(tmp_path, "--skin-bus=wireless")
    assert done.returncode == 4
    assert "--skin-bus" in done.stderr
    test = "def test_{0}(skin_hand, skin_faults):\n    skin_hand('hand.toml')\n    skin_faults.inject({1})\n"
    both = test.format("patch", "'pinky', lost=0.1"), test.format("name", "'palm', loss=0.1")
    (tmp_path / "test_faults.py").write_text("\n\n".join(both))
    (tmp_path / "test_more.py").write_text("def test_no_hand(skin_host):\n    skin_host()\n")
    early = "def test_early(skin_hand, skin_host, skin_truth):\n    skin_hand('hand.toml')\n"
    (tmp_path / "test_early.py").write_text(f"{early}    skin_truth(skin_host().latest('palm'))\n")
    bare = "import pytest\n\n\n@pytest.mark.skin_bus\ndef test_bare():\n    pass\n"
    (tmp_path / "test_bare.py").write_text(bare)
    printed = run(tmp_path, "test_more.py", "test_faults.py", "test_early.py", "test_bare.py").stdout
    assert "ValueError: field: got None, must be a field from a host; wait for the first field" in printed
    assert "skin_bus: got no bus, must be one or more of timed, virtual, udp_multicast, vcan0" in printed
    assert "skin_host: there is no hand yet; call skin_hand first" in printed
    assert "ConfigError: patch: got 'pinky', allowed: a patch of the hand: palm" in printed
    assert "ConfigError: loss: got an unknown fault, allowed: one of seed, lost, " in printed


@pytest.mark.long
def test_pytest_starts_without_numpy_and_numba(tmp_path: Path) -> None:
    (tmp_path / "test_light.py").write_text(
        "import sys\n\n\ndef test_light():\n    assert not {'numpy', 'numba', 'can'} & set(sys.modules)\n"
    )
    assert "1 passed" in run(tmp_path, "test_light.py").stdout
