"""``bench scale``: every scan is solved, and the parts of the cost are there."""

from __future__ import annotations

import gc
import json
import tracemalloc
from pathlib import Path

import pytest

from skinnode.bench import real_time, scale
from skinnode.bench.plots.scale import draw
from skinnode.cli.main import main
from skinnode.host import Host
from skinnode.process import clock
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock


@pytest.mark.long
def test_each_scan_of_each_patch_is_solved() -> None:
    row = scale.measure(patches=5, touched=2, scans=2)  # on two buses
    assert row["fields"] == 5 * 2
    assert all(row[part] > 0.0 for part in ("nodes_ms", "bus_ms", "host_ms", "faster", "memory_mb"))


@pytest.mark.long
def test_a_further_patch_takes_little_memory() -> None:
    """Skin, node, host and solver of one patch: 1.5 MB when the limit was set, so 1,000 patches fit."""

    def held_mb(patches: int) -> float:
        hand = scale.hand_of(patches)
        with VirtualClock(), Fleet(hand, scene=scale.scene_of(1)), Host.from_config(hand):
            clock.sleep(0.5)
            gc.collect()
            return tracemalloc.get_traced_memory()[0] / 1e6

    tracemalloc.start()
    try:
        few = held_mb(2)  # also fills the caches
        assert held_mb(5) - few < 3 * 2.5  # on two buses
    finally:
        tracemalloc.stop()


def test_the_largest_hand_is_one_that_a_host_accepts() -> None:
    hand = scale.hand_of(1000)  # the maximum of the option --patches
    assert (len(hand.patches), len(hand.buses)) == (1000, 250)


def test_large_hands_are_measured_for_fewer_scans() -> None:
    assert [scale.scans_of(patches, 20) for patches in (1, 200, 256, 1000)] == [20, 20, 15, 4]
    assert scale.scans_of(1000, 1) == 1


@pytest.mark.long
def test_the_command_prints_writes_and_plots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scale, "FIXED", 1)
    monkeypatch.setattr(scale, "TOUCHED", (0, 1))
    monkeypatch.setattr(scale, "CHANGED_SCANS", 20)  # of which two are sent in full
    file, image = tmp_path / "scale.json", tmp_path / "scale.png"
    with pytest.raises(SystemExit) as done:
        main(
            f"bench scale --patches 1 --patches 2 --scans 2 --real-time 0 "
            f"--json {file} --plot {image}".split()
        )
    assert done.value.code == 0
    assert "CPU time per patch and scan" in capsys.readouterr().out
    figures = json.loads(file.read_text())
    assert [row["patches"] for row in figures["area"]] == [1, 2]
    assert [row["touched"] for row in figures["contact"]] == [0, 1]
    assert [row["touched"] for row in figures["changed"] if row["changed_only"]] == [0, 1]
    assert figures["changed"][0]["bus_ms"] < 0.7 * figures["contact"][0]["bus_ms"]  # fewer frames
    assert image.read_bytes().startswith(b"\x89PNG")
    draw(image, figures)


@pytest.mark.long
@pytest.mark.real_time
def test_in_real_time_all_scans_are_sent_and_solved_in_two_processes() -> None:
    row = real_time.measure(patches=5, touched=1, hop_limit=0, seconds=1.0)  # on two buses
    assert row["scans"] + row["skipped"] == pytest.approx(5 * 10 * row["seconds"], abs=10)
    assert row["fields"] == pytest.approx(row["scans"], abs=10)
    assert row["frames_per_s"] * row["seconds"] == pytest.approx(101 * row["scans"], rel=0.2)
    assert row["simulator"] > 0.0
    assert row["host"] > 0.0


def test_the_time_to_exchange_a_frame_is_measured_on_both_roads() -> None:
    times = real_time.frame_us()
    assert min(times["python_can"], times["port"]) > 1.0  # a system call alone takes longer
