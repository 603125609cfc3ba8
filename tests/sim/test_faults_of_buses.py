"""Faults of a bus on the timed bus: counted exactly, over when they end, and the hand comes back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

import skinnode as sk
from skinnode.canopen import indices as od
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.process import clock
from tests.lanes import some_long
from vcan_sim.bus_attacker import FLOOD_COB_ID, NO_BUS_FAULTS, BusFaults
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import load_scene, parse_scene
from vcan_sim.testing import eventually
from vcan_sim.timed_bus import BitRates, Cause, Delivered, ErrorFrame, Event
from vcan_sim.timed_interface import MOST_STATIONS, segment
from vcan_sim.virtual_time import READINGS, VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
RATES = BitRates(1_000_000)


def hand(interface: str = "timed") -> HandConfig:
    return parse_hand(
        {
            "buses": [{"name": "can0", "interface": interface, "channel": "can0"}],
            "patches": [{"name": "palm", "node_id": 4, "layout": SMALL, "tolerances": "exact"}],
            "sync": {"period_ms": 20},
        }
    )


class Running:
    """A hand, its host, and what happens on its bus."""

    def __init__(self, time: VirtualClock, fleet: Fleet, host: sk.Host) -> None:
        self.fleet, self.host = fleet, host
        self.bus = segment("can0", time, RATES).bus
        self.frames: Counter[int] = Counter()
        self.destroyed = 0
        segment("can0", time, RATES).listeners.append(self._on_event)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Delivered):
            self.frames[event.frame.can_id] += 1
        elif isinstance(event, ErrorFrame) and event.cause is Cause.DISTURBED:  # two SYNCs may collide
            self.destroyed += event.destroyed

    def suffer(self, seconds: float = 1.0, **faults: Any) -> None:
        """Inject faults into the bus, end them, and let the frames that were handed in be sent."""
        self.fleet.inject_bus("can0", BusFaults(**faults))
        clock.sleep(seconds)
        self.fleet.inject_bus("can0", NO_BUS_FAULTS)
        clock.sleep(0.1)

    def comes_back(self) -> None:
        def streams() -> bool:
            solved = self.host.stats().patches["palm"].solved
            clock.sleep(0.1)
            return self.host.stats().patches["palm"].solved - solved >= 4

        eventually(lambda: self.host.health("palm").condition == "operational" and streams())


@pytest.fixture
def running() -> Iterator[Running]:
    with VirtualClock() as time, Fleet(hand()) as fleet, sk.Host.from_config(hand()) as host:
        yield Running(time, fleet, host)


def test_bus_off(running: Running) -> None:
    running.fleet.inject_bus("can0", BusFaults(bus_off=True))
    sent = running.fleet.tally("palm").emitted.total()
    clock.sleep(1.0)
    assert running.fleet.tally("palm").emitted.total() == sent
    running.fleet.inject_bus("can0", NO_BUS_FAULTS)
    assert running.fleet.injected_bus("can0").bus_off == 1
    running.comes_back()


@pytest.mark.long
def test_the_nodes_come_back_after_a_long_bus_off(running: Running) -> None:
    running.fleet.inject_bus("can0", BusFaults(bus_off=True))
    clock.sleep(1.2 * MOST_STATIONS)  # the nodes reopen their port about once a second
    running.fleet.inject_bus("can0", NO_BUS_FAULTS)
    running.comes_back()


@pytest.mark.long
@pytest.mark.parametrize("share", some_long([0.5, 1.0], 1.0))
def test_a_starved_bus(running: Running, share: float) -> None:
    begin_ns, sent = clock.monotonic_ns(), running.fleet.injected_bus("can0").starved
    assert sent == 0
    running.fleet.inject_bus("can0", BusFaults(starved=share))
    clock.sleep(0.1)
    solved = running.host.stats().patches["palm"].solved
    clock.sleep(1.0)
    busy = running.bus.busy_share(begin_ns + 100_000_000, begin_ns + 1_000_000_000)
    grown = running.host.stats().patches["palm"].solved - solved
    running.fleet.inject_bus("can0", NO_BUS_FAULTS)
    clock.sleep(0.1)
    if share == 1.0:
        assert busy > 0.999
        assert grown == 0
    else:
        assert share < busy < share + 0.15
        assert grown >= 45
    injected = running.fleet.injected_bus("can0").starved
    assert injected == running.frames[FLOOD_COB_ID]
    assert injected == pytest.approx(1.1 * share * 1e6 / 114, rel=0.01)  # 114 bits each
    running.comes_back()
    assert running.fleet.injected_bus("can0").starved == injected


@pytest.mark.long
def test_a_rogue_master(running: Running) -> None:
    before = running.frames.copy()
    host = running.host.stats().buses["can0"].sent
    running.suffer(rogue_nmt_per_s=20.0, rogue_sync_per_s=35.0)
    injected = running.fleet.injected_bus("can0")
    assert (injected.rogue_nmt, injected.rogue_sync) == (pytest.approx(20, abs=1), pytest.approx(35, abs=1))
    others = sum((running.frames - before)[can_id] for can_id in (od.NMT_COB_ID, od.SYNC_COB_ID))
    assert others >= injected.rogue_nmt + injected.rogue_sync
    assert running.host.stats().buses["can0"].sent > host
    running.comes_back()


@pytest.mark.long
@pytest.mark.parametrize("share", some_long([0.02, 0.3], 0.02))
def test_a_disturbed_bus(running: Running, share: float) -> None:
    running.suffer(3.0, disturbed=share)
    disturbed = running.fleet.injected_bus("can0").disturbed
    assert disturbed == running.destroyed > 0
    attempts = running.frames.total() + disturbed
    assert disturbed / attempts == pytest.approx(share, rel=0.35)
    running.comes_back()
    assert running.destroyed == disturbed


def test_two_runs_are_identical() -> None:
    def run() -> list[tuple[int, int]]:
        with VirtualClock() as time, Fleet(hand()) as fleet:
            found: list[tuple[int, int]] = []

            def note(event: Event) -> None:
                if isinstance(event, Delivered):
                    found.append((event.time_ns, event.frame.can_id))

            segment("can0", time, RATES).listeners.append(note)
            with sk.Host.from_config(hand()):
                fleet.faults.inject("can0:starved=0.3,rogue_nmt_per_s=10,disturbed=0.05")
                clock.sleep(1.0)
        return found

    first = run()
    assert len(first) > 2000
    assert run() == first


@pytest.mark.long
def test_a_scene_attacks_a_bus() -> None:
    plan = parse_scene(
        {"faults": [{"where": "can0", "fault": "rogue_sync_per_s=100.0", "from_s": 0.5, "to_s": 1.0}]}
    )
    with VirtualClock(), Fleet(hand(), scene=plan) as fleet, sk.Host.from_config(hand()):
        clock.sleep(3.0)
        assert fleet.injected_bus("can0").rogue_sync == pytest.approx(50, abs=1)
        assert [str(event) for event in fleet.faults.log] == [
            "can0:rogue_sync_per_s=100.0 on",
            "can0:rogue_sync_per_s=100.0 off",
        ]


def test_only_a_timed_bus_can_be_disturbed(tmp_path: Any) -> None:
    with pytest.raises(ConfigError, match="only the interface timed"):
        Fleet(hand("virtual")).inject_bus("can0", BusFaults(disturbed=0.1))
    file = tmp_path / "scene.toml"
    file.write_text('[[faults]]\nwhere = "can0"\nfault = "disturbed=0.1"\n')
    load_scene(file, hand())
    with pytest.raises(ConfigError, match=r"scene.toml:3:1: .*only the interface timed"):
        load_scene(file, hand("virtual"))


@pytest.mark.parametrize(
    "faults",
    [{"starved": 1.5}, {"disturbed": -0.1}, {"rogue_nmt_per_s": -1.0}, {"rogue_sync_per_s": float("nan")}],
)
def test_numbers_out_of_range(faults: dict[str, float]) -> None:
    (name,) = faults
    with pytest.raises(ConfigError, match=name):
        BusFaults(**faults)  # type: ignore[arg-type]


def test_buses_that_are_not_there() -> None:
    with pytest.raises(ConfigError, match="a bus of the hand: can0"):
        Fleet(hand()).inject_bus("can7", BusFaults(bus_off=True))


def test_an_attacker_of_a_bus_without_exact_times() -> None:
    plan = hand("virtual")
    with Fleet(plan) as fleet:
        fleet.faults.inject("can0:rogue_sync_per_s=200")
        eventually(lambda: fleet.passed("can0").heard.total() >= 10)
        fleet.inject(Faults(silent=True))
        fleet.faults.inject("none")


def test_an_attacker_with_nothing_to_do_for_centuries() -> None:
    """A wait in real time has a limit, which must not end the thread of the rogue device."""
    with Fleet(hand("virtual")) as fleet:
        fleet.faults.inject("can0:starved=1e-300")
        clock.sleep(0.1)
        fleet.faults.inject("can0:starved=0,rogue_sync_per_s=200")
        eventually(lambda: fleet.passed("can0").heard.total() >= 10)


def test_reading_a_full_queue_is_no_polling() -> None:
    """A thread that takes frame after frame does not wait: time stands still meanwhile."""
    with VirtualClock() as time:
        queue = time.queue()
        for number in range(3 * READINGS):
            queue.put(number)
        begin_ns = time.now_ns
        for number in range(3 * READINGS):
            time.monotonic_ns()
            assert queue.get(timeout=0.0) == number
        assert time.now_ns == begin_ns


def test_truth_at_a_time() -> None:
    plan = parse_scene({"faults": [{"where": "palm", "fault": "frozen"}]})
    with VirtualClock(), Fleet(hand(), scene=plan) as fleet:
        assert fleet.truth_at("palm", clock.monotonic_ns()).contacts == ()
        with pytest.raises(LookupError):
            fleet.truth_at("thumb", 0)
    with pytest.raises(LookupError, match="no scene"):
        Fleet(hand()).truth_at("palm", 0)
