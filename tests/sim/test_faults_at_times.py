"""Faults as text and as tables of a scene: each starts and ends at its time, counted and logged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import skinnode as sk
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.process import clock
from skinnode.transport import CanPort
from vcan_sim.bus_attacker import BusFaults
from vcan_sim.fault_schedule import FaultSchedule, TimedFault
from vcan_sim.fault_text import parse_changes, parse_values, text_of
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import load_scene, parse_scene, schedule_of
from vcan_sim.tally import Kind
from vcan_sim.testing import eventually
from vcan_sim.virtual_time import VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
PERIOD_MS = 20


def hand(interface: str = "timed") -> HandConfig:
    return parse_hand(
        {
            "buses": [{"name": "can0", "interface": interface, "channel": "can0"}],
            "patches": [
                {"name": name, "node_id": 4 + i, "layout": SMALL, "tolerances": "exact"}
                for i, name in enumerate(("palm", "thumb"))
            ],
            "sync": {"period_ms": PERIOD_MS},
        }
    )


HAND = hand()


@pytest.fixture
def virtual() -> Iterator[VirtualClock]:
    with VirtualClock() as time:
        yield time


def scene(*faults: dict[str, Any], **table: Any) -> Any:
    return parse_scene({"faults": list(faults), **table})


def until(fleet: Fleet, scene_s: float) -> None:
    """Wait for a time of the scene."""
    patch = fleet.patches["palm"]
    eventually(lambda: patch.started)
    clock.sleep(scene_s - patch.scene_s(clock.monotonic_ns()))


def events(fleet: Fleet) -> list[tuple[float, str]]:
    """The log of the faults: the scene time of each, and its text."""
    patch = fleet.patches["palm"]
    wall_ns = clock.time_ns() - clock.monotonic_ns()
    return [
        (round(patch.scene_s(event.time_ns - wall_ns) or 0.0, 6), str(event)) for event in fleet.faults.log
    ]


# --- text


def test_texts_say_what_they_change() -> None:
    faults = Fleet(HAND).faults
    faults.inject("palm:lost=0.5,frozen", "thumb:open_upper=2", "can0:bus_off")
    assert faults.texts() == ["palm:lost=0.5,frozen", "thumb:open_upper=2", "can0:bus_off"]
    faults.inject("palm:lost=0.25", "thumb:open_upper=none", "can0:bus_off=false")
    assert faults.texts() == ["palm:lost=0.25,frozen"]
    faults.inject("palm:none,silent")
    assert faults.patch("palm") == Faults(silent=True)
    faults.inject("late=0.1,bus_off")  # every patch and every bus
    assert faults.texts() == ["palm:late=0.1,silent", "thumb:late=0.1", "can0:bus_off"]
    faults.inject("none")
    assert faults.texts() == []
    assert faults.patch("palm") == NO_FAULTS


def test_what_is_printed_is_parsed_to_the_same_faults() -> None:
    for faults in (Faults(lost=0.1, frozen=True, open_upper=0, miscounted_by=-3), Faults(flipped=1e-7)):
        assert Faults(**parse_values(text_of(faults), on_bus=False)) == faults  # type: ignore[arg-type]
    assert text_of(NO_FAULTS) == "none"
    assert text_of(BusFaults(bus_off=True)) == "bus_off"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("plam:unplugged", "--fault: got 'plam', allowed: a patch of the hand: palm, thumb; or a bus: can0"),
        ("palm:bus_off", "--fault: got 'bus_off', allowed: seed, lost,"),
        ("can0:lost=0.1", "--fault: got 'lost', allowed: seed, bus_off"),
        ("palm:lost=much", "--fault lost: got 'much', allowed: a number"),
        ("palm:lost", "--fault lost: got '', allowed: a number"),
        ("palm:silent=", "--fault silent: got '', allowed: no value, or true or false"),
        ("palm:", "--fault: got '', allowed: the name of a fault, or none"),
        ("palm:seed=-1", "seed: got -1, allowed: a non-negative integer"),
        ("can0:seed=-1", "seed: got -1, allowed: a non-negative integer"),
        ("palm:lost=2", "lost: got 2.0, allowed: a fraction from 0 to 1"),
        ("palm:open_upper=7", "palm: open_upper: got 7, allowed: an integer from 0 to 3"),
        ("palm:struck=16", "palm: struck: got 16, allowed: an integer from 0 to 15"),
        ("palm:struck=-2", "struck: got -2, allowed: a non-negative integer"),
        ("palm:miscounted_by=-256", "miscounted_by: got -256, allowed: an integer that 256 does not divide"),
        ("palm:babble_per_s=2e9", "babble_per_s: got 2000000000.0, allowed: 0, or a number from 1e-06 to"),
        ("palm:emcy_per_s=1e-305", "emcy_per_s: got 1e-305, allowed: 0, or a number from 1e-06 to 100000"),
        ("palm:restart_every_s=1e300", "restart_every_s: got 1e+300, allowed: 0, or a number from 0.001 to"),
        ("palm:restart_every_s=1e-10", "restart_every_s: got 1e-10, allowed: 0, or a number from 0.001 to"),
        ("can0:rogue_sync_per_s=3e9", "rogue_sync_per_s: got 3000000000.0, allowed: 0, or a number from 1e"),
        ("can0:rogue_nmt_per_s=-1", "rogue_nmt_per_s: got -1.0, allowed: 0, or a number from 1e-06 to"),
    ],
)
def test_a_bad_text_is_one_line_and_changes_nothing(text: str, words: str) -> None:
    faults = Fleet(HAND).faults
    with pytest.raises(ConfigError) as error:
        faults.inject("thumb:silent", text)
    assert str(error.value).startswith(words)
    assert "\n" not in str(error.value)
    assert faults.texts() == []
    assert faults.log == ()


def test_a_change_names_its_place() -> None:
    (change,) = parse_changes(["can0:bus_off"], ["palm"], ["can0"])
    assert (change.place, change.on_bus, dict(change.values)) == ("can0", True, {"bus_off": True})


# --- schedule


def timed(number: int, from_s: float, to_s: float) -> TimedFault:
    return TimedFault(number, "palm", False, from_s, to_s, {"lost": 0.1})


def test_a_schedule_says_what_is_active() -> None:
    first, second = timed(0, 0.1, 0.3), timed(1, 0.2, float("inf"))
    schedule = FaultSchedule((first, second))
    assert [schedule.active(t) for t in (-1.0, 0.0, 0.1, 0.2, 0.3, 9.0)] == [
        (), (), (first,), (first, second), (second,), (second,)
    ]  # fmt: skip
    assert [schedule.next_change_s(t) for t in (-1.0, 0.1, 0.25, 0.3)] == [0.1, 0.2, 0.3, None]


def test_a_schedule_repeats() -> None:
    only = timed(0, 0.0, 0.1)
    schedule = FaultSchedule((only,), repeat_s=0.3)
    changes, t_s = [], 0.0
    for _ in range(10_000):
        t_s = schedule.next_change_s(t_s) or pytest.fail("a schedule that repeats ended")
        changes.append(t_s)
        assert schedule.active(t_s) == (() if len(changes) % 2 else (only,))
    assert changes[:4] == pytest.approx([0.1, 0.3, 0.4, 0.6])
    assert changes[-1] == pytest.approx(1500.0, abs=1e-8)


# --- scenes


@pytest.mark.long
def test_faults_start_and_end_at_their_times(virtual: VirtualClock) -> None:
    plan = scene(
        {"where": "palm", "fault": "lost=1.0", "from_s": 0.5, "to_s": 1.0},
        {"where": "thumb", "fault": "unplugged", "from_s": 1.5, "to_s": 2.0},
        {"where": "palm upper 2", "fault": "open", "from_s": 2.5},
    )
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND) as host:
        until(fleet, 0.5)
        assert fleet.injected("palm").lost == 0
        until(fleet, 1.2)
        lost = fleet.injected("palm").lost
        scans = 500 // PERIOD_MS
        assert 16 * (scans - 1) <= lost <= 16 * (scans + 1)
        eventually(lambda: host.stats().patches["palm"].assembler.chunks_lost == lost)
        until(fleet, 1.75)
        assert fleet.injected("thumb").unplugged == 1
        until(fleet, 2.6)
        eventually(lambda: host.health("thumb").rejoins == 1)
        assert host.health("thumb").condition == "operational"
        until(fleet, 4.0)
        assert fleet.injected("palm").lost == lost
        miswired = fleet.injected("palm").miswired
        assert abs(miswired - 1500 / PERIOD_MS) <= 1
        assert fleet.injected("thumb").miswired == 0
        assert fleet.faults.texts() == ["palm:open_upper=2"]
        assert events(fleet) == [
            (0.5, "palm:lost=1.0 on"),
            (1.0, "palm:lost=1.0 off"),
            (1.5, "thumb:unplugged on"),
            (2.0, "thumb:unplugged off"),
            (2.5, "palm:open_upper=2 on"),
        ]


def test_an_unplugged_patch_falls_silent_at_once(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "unplugged", "from_s": 0.5, "to_s": 1.5})
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        until(fleet, 0.501)
        sent = fleet.tally("palm").emitted.total()
        until(fleet, 1.499)
        assert fleet.tally("palm").emitted.total() <= sent + 1  # a frame that the node had begun


@pytest.mark.long
def test_faults_repeat_with_the_scene(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "frozen", "from_s": 0.1, "to_s": 0.2}, repeat_s=0.5)
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        until(fleet, 1.9)
        found = events(fleet)
    assert [time for time, _ in found] == pytest.approx([0.1, 0.2, 0.6, 0.7, 1.1, 1.2, 1.6, 1.7])
    assert [text.rpartition(" ")[2] for _, text in found] == ["on", "off"] * 4


@pytest.mark.long
def test_a_schedule_changes_its_own_faults_only(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "late=0.5", "from_s": 0.2, "to_s": 0.4})
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        fleet.faults.inject("palm:sync_lost=0.1")
        until(fleet, 0.3)
        assert fleet.faults.texts() == ["palm:late=0.5,sync_lost=0.1"]
        until(fleet, 0.5)
        assert fleet.faults.texts() == ["palm:sync_lost=0.1"]


@pytest.mark.long
def test_a_scheduled_change_that_contradicts_is_refused(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "late=0.5", "from_s": 0.2, "to_s": 0.4})
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        fleet.faults.inject("palm:lost=0.9")
        until(fleet, 0.5)
        assert fleet.faults.texts() == ["palm:lost=0.9"]
        (_, text), *_ = [event for event in events(fleet) if "late" in event[1]]
    assert text.startswith("palm:late=0.5 on, refused: ")
    assert "at most 1 together" in text


def test_a_fault_ends_although_the_next_one_is_refused(virtual: VirtualClock) -> None:
    plan = scene(
        {"where": "palm", "fault": "frozen", "from_s": 0.2, "to_s": 0.4},
        {"where": "palm", "fault": "lost=0.6", "from_s": 0.4, "to_s": 0.6},
    )
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        fleet.faults.inject("palm:duplicated=0.6")
        until(fleet, 0.5)
        assert fleet.faults.texts() == ["palm:duplicated=0.6"]
        found = [(time, text.partition(": ")[0]) for time, text in events(fleet) if time > 0.3]
    assert found == [(0.4, "palm:frozen off"), (0.4, "palm:lost=0.6 on, refused")]


@pytest.mark.long
def test_a_fault_that_goes_on_in_another_table_does_not_pause(virtual: VirtualClock) -> None:
    plan = scene(
        {"where": "palm", "fault": "frozen", "from_s": 0.2, "to_s": 0.4},
        {"where": "palm", "fault": "frozen", "from_s": 0.4, "to_s": 0.6},
    )
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        until(fleet, 0.7)
        assert events(fleet) == [(0.2, "palm:frozen on"), (0.6, "palm:frozen off")]


@pytest.mark.long
def test_a_patch_drifts_and_warms(virtual: VirtualClock) -> None:
    """The node sends R / R0: 1 + 0.1 t while it drifts, and 1.02 at ten kelvin."""
    plan = scene(
        {"where": "palm", "fault": "drift_per_s=0.1", "from_s": 0.5, "to_s": 1.5},
        {"where": "palm", "fault": "warmer_k=10.0", "from_s": 2.0, "to_s": 3.0},
    )
    ratios: dict[float, float] = {}
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND):
        for scene_s in (0.4, 1.0, 1.49, 1.6, 1.9, 2.5, 3.1):
            until(fleet, scene_s)
            node: Any = fleet._stations["palm"]._node
            ratios[scene_s] = float((node.converter._reading / node.baseline_ohm).mean())
        injected = fleet.injected("palm")
    step = 0.1 * PERIOD_MS * 1e-3
    assert [ratios[t] for t in (0.4, 1.6, 1.9, 3.1)] == pytest.approx([1.0] * 4, abs=1e-4)
    assert ratios[1.0] == pytest.approx(1.05, abs=2 * step)
    assert ratios[1.49] == pytest.approx(1.099, abs=2 * step)
    assert ratios[2.5] == pytest.approx(1.02, abs=1e-4)
    assert abs(injected.drifted - 1000 / PERIOD_MS) <= 1
    assert abs(injected.warmed - 1000 / PERIOD_MS) <= 1


@pytest.mark.long
def test_an_error_passive_controller_is_reported(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "error_passive", "from_s": 0.5, "to_s": 1.0})
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND) as host:
        until(fleet, 0.7)
        newest = host.health("palm").reason
        assert fleet.tally("palm").emitted[Kind.EMCY] == 1
        until(fleet, 1.2)
        assert fleet.tally("palm").emitted[Kind.EMCY] == 2  # error reset
        assert fleet.injected("palm").error_passive == 1
        assert host.health("palm").condition == "operational"
    assert "0x8120" in newest


def test_without_power_nothing_becomes_due(virtual: VirtualClock) -> None:
    with Fleet(HAND) as fleet, CanPort(HAND.buses[0]):  # the port acknowledges the frames
        fleet.inject(Faults(babble_per_s=10.0), "palm")
        clock.sleep(0.55)
        before = fleet.injected("palm").babbled
        assert 3 <= before <= 5  # the node boots first, and an idle node notices a fault after a while
        fleet.inject(Faults(babble_per_s=10.0, unplugged=True), "palm")
        clock.sleep(2.0)
        assert fleet.injected("palm").babbled == before
        fleet.inject(Faults(babble_per_s=10.0), "palm")
        clock.sleep(0.55)
        assert before + 2 <= fleet.injected("palm").babbled <= before + 5


@pytest.mark.long
def test_a_second_node_with_the_node_id(virtual: VirtualClock) -> None:
    plan = scene({"where": "palm", "fault": "duplicate_node_id", "from_s": 0.5, "to_s": 2.0})
    with Fleet(HAND, scene=plan) as fleet, sk.Host.from_config(HAND) as host:
        until(fleet, 0.4)
        assert fleet.injected("palm").twin_frames == 0
        until(fleet, 2.1)
        injected = fleet.injected("palm")
        assert injected.twins == 1
        node = fleet._stations["palm"]._node
        assert node is not None
        assert node.rival_frames > 0
        assert injected.twin_frames > 10
        until(fleet, 4.0)
        assert fleet.injected("palm").twin_frames == injected.twin_frames
        assert host.health("palm").condition == "operational"
    assert fleet.tally("palm").discrepancies() == []


@pytest.mark.long
def test_a_fleet_that_stops_before_its_scene_begins(virtual: VirtualClock) -> None:
    with Fleet(HAND, scene=scene({"where": "palm", "fault": "silent"})) as fleet:
        clock.sleep(1.0)
    assert fleet.faults.log == ()


@pytest.mark.long
def test_a_fleet_of_real_time_plays_its_faults_in_virtual_time() -> None:
    fleet = Fleet(HAND, scene=scene({"where": "palm", "fault": "frozen", "from_s": 0.2, "to_s": 0.4}))
    with VirtualClock(), fleet, sk.Host.from_config(HAND):
        until(fleet, 0.6)
        assert events(fleet) == [(0.2, "palm:frozen on"), (0.4, "palm:frozen off")]


@pytest.mark.long
def test_the_schedule_of_a_fleet_that_is_started_again_goes_on(virtual: VirtualClock) -> None:
    plan = scene(
        {"where": "palm", "fault": "frozen", "from_s": 0.2, "to_s": 1.0},
        {"where": "palm", "fault": "silent", "from_s": 0.8, "to_s": 1.2},  # while the fleet is stopped
        {"where": "thumb", "fault": "lost=0.5", "from_s": 4.0, "to_s": 5.0},
    )
    fleet = Fleet(HAND, scene=plan)
    with fleet, sk.Host.from_config(HAND):
        until(fleet, 0.5)
    until(fleet, 2.0)
    assert fleet.faults.texts() == ["palm:frozen"]
    with fleet, sk.Host.from_config(HAND):
        until(fleet, 6.0)
        found = events(fleet)
    assert found == [
        (0.2, "palm:frozen on"),
        (2.0, "palm:frozen off"),
        (4.0, "thumb:lost=0.5 on"),
        (5.0, "thumb:lost=0.5 off"),
    ]


@pytest.mark.long
def test_a_fleet_is_started_again_before_its_scene_begins(virtual: VirtualClock) -> None:
    fleet = Fleet(HAND, scene=scene({"where": "palm", "fault": "frozen"}))
    for _ in range(2):
        with fleet:
            clock.sleep(0.1)
    with fleet, sk.Host.from_config(HAND):
        until(fleet, 0.1)
        assert fleet.faults.texts() == ["palm:frozen"]


def table(**changes: Any) -> str:
    values = {"where": "palm", "fault": "lost=0.1", "from_s": 1.0, "to_s": 2.0} | changes
    lines = [f"{key} = {value!r}" for key, value in values.items() if value is not None]
    return "\n".join(["[[faults]]", *lines]) + "\n"


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (table(where="plam"), "2:1", ["faults[0].where", "'plam'", "palm, thumb", "can0"]),
        (
            table(where="palm upper 9", fault="open"),
            "2:1",
            ["faults[0].where: got 'palm upper 9'", "from 0 to 3"],
        ),
        (table(where="palm upper 2", fault="stuck"), "3:1", ["'stuck'", "open, shorted, noisy"]),
        (table(where="finger upper 2", fault="open"), "2:1", ["faults[0].where", "'finger upper 2'"]),
        (table(fault="lost_chunk=0.1"), "3:1", ["faults[0].fault", "'lost_chunk'", "lost"]),
        (table(fault="lost=1.5"), "3:1", ["lost", "1.5", "a fraction from 0 to 1"]),
        (table(fault="lost"), "3:1", ["lost", "a number"]),
        (table(fault=""), "3:1", ["faults[0].fault", "a fault, such as"]),
        (table(fault="seed=3"), "3:1", ["'seed'", "the seed is not a fault"]),
        (table(fault="stuck_upper=1"), "3:1", ["stuck_upper", "which name a crossing"]),
        (table(where="can0"), "3:1", ["'lost'", "bus_off"]),
        (table(to_s=0.5), "5:1", ["faults[0].to_s", "0.5", "later than from_s"]),
        (table(from_s=-1.0), "4:1", ["faults[0].from_s", "-1.0", "from 0 to 86400"]),
        (table(ends=3.0), "6:1", ["faults[0].ends", "unknown key", "to_s"]),
        (table() + table(from_s=1.5), "9:1", ["faults[1].from_s", "faults[0]", "lost at 'palm'"]),
        (table(fault="lost=0.8") + table(fault="late=0.8"), "3:1", ["1.6", "at most 1 together"]),
        (
            table(fault="stuck_upper=1") + table(fault="stuck_lower=1", to_s=3.0),
            "5:1",
            ["faults[0].to_s: got 2.0", "the remaining faults", "stuck_lower needs both"],
        ),
        ("repeat_s = 1.5\n" + table(), "6:1", ["faults[0].to_s", "2.0", "repeat_s"]),
        ("name = 'nothing'\n", "", ["touches", "nothing", "[[touches]] or [[faults]]"]),
    ],
)
def test_a_bad_table_is_one_line_with_its_place(
    text: str, place: str, words: list[str], tmp_path: Path
) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_scene(file, HAND)
    message = str(error.value)
    assert message.startswith(f"{file}:{place}: " if place else f"{file}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_the_faults_of_a_scene_are_its_schedule() -> None:
    plan = scene(
        {"where": "palm lower 3", "fault": "noisy", "to_s": 2.0},
        {"where": "can0", "fault": "bus_off", "from_s": 3.0},
    )
    noisy, off = schedule_of(plan, HAND).faults
    assert (noisy.place, noisy.on_bus, dict(noisy.values)) == ("palm", False, {"noisy_lower": 3})
    assert (noisy.from_s, noisy.to_s) == (0.0, 2.0)
    assert (off.place, off.on_bus, off.to_s) == ("can0", True, float("inf"))
