"""The screen as somebody at the keys meets it: a host, real nodes, and textual without a terminal."""

from __future__ import annotations

import re
import resource
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.monitor.app import MonitorApp
from skinnode.monitor.live_source import HostSource
from skinnode.monitor.widgets import Dialog
from skinnode.record import replay
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import Pressed, a_hand, eventually, in_app, press, screen_of

SIZES = [(80, 24), (120, 40)]
SIGNS = "@%#*+=-:"
"""What skin is drawn with where there are no colours, the deepest first: a small map has no pixel in the very
middle of an electrode."""


def heaviest(text: str, width: int) -> list[tuple[float, float]]:
    """Where the heaviest signs of the maps are: column, and line from the top of the map, in cells of the
    4 × 4 electrodes of the left patch of two."""
    lines = text.split("\n")
    first = next(row for row, line in enumerate(lines) if "┌" in line) + 1
    last = next(row for row, line in enumerate(lines) if "└" in line)
    left = lines[first - 1].index("┌") + 1
    across = last - first
    inside = "".join(lines[first:last])
    deepest = next((sign for sign in SIGNS if sign in inside), "")
    return [
        ((column - left + 0.5) / (2 * across) * 4, (row - first + 0.5) / across * 4)
        for row, line in enumerate(lines[first:last], first)
        for column, sign in enumerate(line[: width // 2])
        if sign == deepest
    ]


@pytest.mark.parametrize("size", SIZES)
def test_a_press_is_seen_where_it_is(size: tuple[int, int]) -> None:
    hand = a_hand()
    with closing(Pressed(hand)) as skin, Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            assert await eventually(pilot, lambda: "nothing touches" in screen_of(pilot))
            # the last wire is the uppermost line, the second electrode the second column
            skin.press("p0", 3, 1, (0.0, 0.0, -200e-6))
            assert await eventually(pilot, lambda: "200 ± " in screen_of(pilot))
            assert await eventually(pilot, lambda: heaviest(screen_of(pilot), size[0]))
            places = heaviest(screen_of(pilot), size[0])
            assert all(1 <= x <= 2 and 0 <= y <= 1 for x, y in places), places
            seen = re.search(r"x +([\d.]+) +y +([\d.]+) mm", screen_of(pilot))
            assert seen is not None
            assert abs(float(seen[1]) - 4.0) < 1.0  # a pitch of 4 mm
            assert float(seen[2]) > 10.0  # at the edge or beyond: skin does not move at one electrode alone
            lines = screen_of(pilot).split("\n")
            assert len(lines) == size[1]
            assert {len(line) for line in lines} == {size[0]}

        in_app(source, play, size=size)


def test_shear_is_an_arrow_the_way_it_goes() -> None:
    hand = a_hand(1)
    with closing(Pressed(hand)) as skin, Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            for moved_m, sign in (((60e-6, 0.0, -200e-6), "→"), ((0.0, 60e-6, -200e-6), "↑")):
                skin.press("p0", 1, 1, moved_m)
                told = f"{sign} 6"
                assert await eventually(pilot, lambda told=told: told in screen_of(pilot)), screen_of(pilot)
                await press(pilot, "z")
                assert await eventually(pilot, lambda sign=sign: screen_of(pilot).count(sign) > 1)
                await press(pilot, "escape")

        in_app(source, play)


@pytest.mark.long
@pytest.mark.real_time
def test_a_dead_node_is_named_and_its_last_map_is_not_taken_for_now() -> None:
    hand = a_hand()
    with Fleet(hand) as fleet, Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            assert await eventually(pilot, lambda: screen_of(pilot).count("operational") == 2)
            fleet.inject(Faults(unplugged=True), "p1")
            assert await eventually(pilot, lambda: "for " in screen_of(pilot) and "lost" in screen_of(pilot))
            assert await eventually(pilot, lambda: "p1 operational, now" in screen_of(pilot))
            app = pilot.app
            assert isinstance(app, MonitorApp)
            assert await eventually(pilot, lambda: "p1: lost" in app.faults.lines)
            text = screen_of(pilot)
            assert text.count("operational ") == 1  # the other
            assert "1 fault" in text
            await press(pilot, "2", "z")
            assert await eventually(pilot, lambda: "p1  node 6, can0" in screen_of(pilot))

        app = in_app(source, play)
    assert "p1: lost" in app.faults.lines
    assert not any(line.startswith("p0: lost") for line in app.faults.lines)


@pytest.mark.long
def test_tare_asks_and_then_zeroes() -> None:
    hand = a_hand()
    with closing(Pressed(hand)) as skin, Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            skin.press("p1", 2, 2, (0.0, 0.0, -150e-6))
            assert await eventually(pilot, lambda: "150 ± " in screen_of(pilot))
            await press(pilot, "2", "t")
            assert isinstance(pilot.app.screen, Dialog)
            assert "Tare p1?" in pilot.app.screen.text
            assert "p1 150 µm" in pilot.app.screen.text
            await press(pilot, "n")
            assert not isinstance(pilot.app.screen, Dialog)
            assert host.stats().nodes["p1"].baselines == 0
            await press(pilot, "t", "y")
            assert await eventually(
                pilot, lambda: "p1: tared; the new baseline is in use" in screen_of(pilot)
            )
            assert await eventually(pilot, lambda: "150 ± " not in screen_of(pilot))
            assert await eventually(pilot, lambda: "nothing touches" in screen_of(pilot))
            assert host.stats().nodes["p0"].baselines == 0

        in_app(source, play)


def test_a_guest_says_that_it_does_not_tare() -> None:
    bus = {"role": "guest", "guest_sends": "sdo"}
    hand = a_hand(1, bus, sync={"period_ms": 50, "counter_overflow": 0})
    with closing(Pressed(hand)), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            await press(pilot, "t", "y")
            assert await eventually(
                pilot, lambda: "not tared: another master runs the bus" in screen_of(pilot)
            )

        in_app(source, play)


@pytest.mark.long
def test_what_the_record_key_wrote_replays(tmp_path: Path) -> None:
    hand = a_hand()
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            for _ in range(2):  # a second recording of the same second is refused, in words
                await press(pilot, "r")
                if not await eventually(pilot, lambda: "● REC" in screen_of(pilot), 2.0):
                    assert "exists" in screen_of(pilot)
                    continue
                assert await eventually(pilot, lambda: (source.recording or _NONE).frames > 400)
                await press(pilot, "r")
                assert await eventually(pilot, lambda: "● REC" not in screen_of(pilot))
                assert await eventually(pilot, lambda: " frames in " in screen_of(pilot).split("\n")[-1])

        in_app(source, play, folder=tmp_path, size=(200, 50))
    recordings = sorted(tmp_path.glob("*.log"))
    assert recordings
    for path in recordings:
        run = replay(path)
        patches = [field.stamp.patch for field in run if field.stamp is not None]
        assert run.ended
        assert run.complaints == []
        assert {"p0", "p1"} == set(patches)


class _NONE:
    frames = 0


def test_a_recording_under_way_is_ended_by_quitting(tmp_path: Path) -> None:
    hand = a_hand()
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            await press(pilot, "r")
            assert await eventually(pilot, lambda: (source.recording or _NONE).frames > 100)

        in_app(source, play, folder=tmp_path)
    (path,) = tmp_path.glob("*.log")
    run = replay(path)
    assert list(run)
    assert run.ended


def test_a_recording_that_cannot_be_is_told_and_the_screen_goes_on(tmp_path: Path) -> None:
    hand = a_hand(1)
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            await press(pilot, "r")
            assert await eventually(pilot, lambda: "recording: got" in screen_of(pilot))
            assert source.recording is None

        (tmp_path / "taken").touch()
        in_app(source, play, folder=tmp_path / "taken", size=(120, 40))


@pytest.mark.long
def test_a_recording_that_the_disk_has_ended_is_a_fault_also_when_the_screen_is_left(tmp_path: Path) -> None:
    hand = a_hand(1)
    kept = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            await press(pilot, "r")
            assert await eventually(pilot, lambda: source.recording is not None)
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, kept[1]))
            try:
                assert await eventually(pilot, lambda: source.recording and source.recording.dropped)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, kept)
            assert source.flaws == []  # of a recording under way, the screen tells

        in_app(source, play, folder=tmp_path)
        assert source.recording is None
        failed, lost = source.flaws
    assert failed.endswith("recording ended, because writing to the disk failed (File too large)")
    assert re.search(r"\.log: \d+ frames not recorded$", lost)


def test_pause_holds_the_picture_while_the_host_goes_on() -> None:
    hand = a_hand(1)
    with closing(Pressed(hand)) as skin, Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            assert await eventually(pilot, lambda: " 0 ± " in screen_of(pilot))
            await press(pilot, "space")
            skin.press("p0", 1, 1, (0.0, 0.0, -200e-6))
            solved = host.stats().patches["p0"].solved
            assert await eventually(pilot, lambda: host.stats().patches["p0"].solved > solved + 8)
            assert "PAUSED" in screen_of(pilot)
            assert " 0 ± " in screen_of(pilot)
            await press(pilot, "space")
            assert await eventually(pilot, lambda: "200 ± " in screen_of(pilot))

        in_app(source, play)


@pytest.mark.long
def test_help_keys_and_sizes() -> None:
    hand = a_hand(2)
    with closing(Pressed(hand)), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            await press(pilot, "question_mark")
            assert isinstance(pilot.app.screen, Dialog)
            for key in "ztraq":
                assert key in pilot.app.screen.text
            for _ in range(3):  # typed ahead of the dialog's going away
                pilot.app.simulate_key("x")
            assert await eventually(pilot, lambda: not isinstance(pilot.app.screen, Dialog))
            await press(pilot, "right", "z")
            assert await eventually(pilot, lambda: "p1  node 6" in screen_of(pilot))
            await press(pilot, "left")
            assert await eventually(pilot, lambda: "p0  node 5" in screen_of(pilot))
            for width, height in ((200, 50), (60, 18), (30, 8), (80, 24)):
                await pilot.resize_terminal(width, height)
                told = "too small" if width < 50 else "q quit" if width >= 80 else "1-9 patch"

                def shown(width: int = width, height: int = height, told: str = told) -> bool:
                    lines = screen_of(pilot).split("\n")
                    return len(lines) == height and len(lines[0]) == width and told in screen_of(pilot)

                assert await eventually(pilot, shown), screen_of(pilot)

        in_app(source, play)


def test_a_source_that_fails_ends_the_screen_and_is_told() -> None:
    hand = a_hand(1)
    with closing(Pressed(hand)), Host.from_config(hand) as host, HostSource(host) as source:

        async def play(pilot: Pilot[Any]) -> None:
            host._publisher.fail(SkinError("patch 'p0': a defect"))
            assert isinstance(pilot.app, MonitorApp)
            app = pilot.app
            assert await eventually(pilot, lambda: app.failure is not None)

        app = in_app(source, play)
        assert str(app.failure) == "patch 'p0': a defect"
