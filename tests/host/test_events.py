"""The events of a hand's health: each change is reported once, in words, with the condition that is new."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from skinnode.host import events as events_module
from skinnode.host import health_watch as watch_module
from skinnode.host.containment import Defects
from skinnode.host.events import Events, EventSubscription, HealthEvent
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.health_watch import HealthWatch
from skinnode.host.open_and_shorted_wires import WireFault, WireState
from skinnode.process import clock
from skinnode.transport.bus_state import BusState

PATCH = PatchHealth(
    patch="thumb",
    node_id=11,
    condition=Condition.OPERATIONAL,
    nmt_state=5,
    heartbeat_age_s=0.1,
    scan_age_s=0.01,
    boot_ups=3,
    emergencies=4,
    last_emergency=0x8110,
    emergency_text="overrun",
    error_register=0,
)
BUS = BusHealth(
    bus="can0",
    away=None,
    load=0.3,
    error_frames=1,
    bus_offs=0,
    outages=2,
    kernel_dropped=0,
    dropped=0,
    malformed=0,
    foreign=5,
    foreign_ids=(0x3F0,),
    other_syncs=0,
    other_masters=0,
)


class HandHealth:
    """The health of one patch and one bus, as a test sets it."""

    def __init__(self) -> None:
        self.patch, self.bus = PATCH, BUS

    def patches(self) -> Mapping[str, PatchHealth]:
        return {"thumb": self.patch}

    def buses(self) -> Mapping[str, BusHealth]:
        return {"can0": self.bus}


@pytest.fixture
def hand() -> HandHealth:
    return HandHealth()


def reported(events: EventSubscription) -> list[tuple[str, str, str]]:
    return [(event.subject, event.what, event.text) for event in iter(lambda: events.get(0.0), None)]


def after(hand: HandHealth, *, patch: Any = None, bus: Any = None) -> list[tuple[str, str, str]]:
    """Return what a watch reports of these changes. It checks once more when it is closed."""
    events = Events()
    heard = events.subscribe(100)
    with HealthWatch(hand.patches, hand.buses, events):
        hand.patch, hand.bus = replace(hand.patch, **(patch or {})), replace(hand.bus, **(bus or {}))
    return reported(heard)


def test_nothing_is_reported_while_nothing_changes(hand: HandHealth) -> None:
    assert after(hand, patch={"heartbeat_age_s": 0.2, "scan_age_s": 0.02}, bus={"load": 0.4}) == []


def test_a_bus_goes_away_and_comes_back(hand: HandHealth) -> None:
    assert after(hand, bus={"away": "can0: unplugged"}) == [("can0", "away", "can0: unplugged")]
    assert after(hand, bus={"away": None}) == [("can0", "back", "the bus is available again")]


def test_a_counter_is_reported_by_how_much_it_grew(hand: HandHealth) -> None:
    grown = {"emergencies": 6, "last_emergency": 0x5000, "emergency_text": "upper wire open 3", "rejoins": 1}
    assert after(hand, patch=grown) == [
        ("thumb", "emergencies", "2 emergencies, last 0x5000 upper wire open 3"),
        ("thumb", "rejoins", "1 rejoin"),
    ]
    assert after(hand, bus={"error_frames": 2, "foreign": 7, "foreign_ids": (0x3F0, 0x3F1)}) == [
        ("can0", "error_frames", "1 error frame"),
        ("can0", "foreign", "2 foreign frames: 0x3F0, 0x3F1"),
    ]


def test_a_loop_of_restarts_is_reported_when_it_begins(hand: HandHealth) -> None:
    text = "restarts in a loop: check its supply and watchdog"
    assert after(hand, patch={"restarts_in_a_loop": True}) == [("thumb", "restarts in a loop", text)]
    assert after(hand, patch={"nmt_state": 127}) == []  # it goes on
    assert after(hand, patch={"restarts_in_a_loop": False}) == []


def test_each_wire_is_reported_when_it_breaks_and_when_it_is_mended(hand: HandHealth) -> None:
    one, two = WireFault("upper", 3, WireState.OPEN), WireFault("lower", 7, WireState.SHORT)
    assert after(hand, patch={"wires": (one,)}) == [("thumb", "open", "upper wire 3 is open")]
    assert after(hand, patch={"wires": (one, two)}) == [("thumb", "short", "lower wire 7 is short")]
    assert after(hand, patch={"wires": (two,)}) == [("thumb", "well", "upper wire 3 is no longer open")]


def test_a_condition_is_reported_with_its_reason(hand: HandHealth) -> None:
    silent = {"condition": Condition.LOST, "heartbeat_age_s": 0.8}
    text = "operational, now lost (no heartbeat from node 11 for 0.8 s)"
    assert after(hand, patch=silent) == [("thumb", "lost", text)]
    assert after(hand, patch={"heartbeat_age_s": 0.9}) == []  # it still is
    assert after(hand, patch={"condition": Condition.OPERATIONAL}) == [
        ("thumb", "operational", "lost, now operational")
    ]


def test_two_nodes_of_one_node_id_are_reported_once(hand: HandHealth) -> None:
    text = "two nodes have node-ID 11"
    assert after(hand, patch={"duplicate_id": True}) == [("thumb", "duplicate node-ID", text)]
    assert after(hand, patch={"nmt_state": 127}) == []
    assert after(hand, patch={"duplicate_id": False}) == []


def test_the_sync_of_a_guest_and_the_controller_are_reported(hand: HandHealth) -> None:
    assert after(hand, bus={"no_sync": True}) == [("can0", "no SYNC", "no SYNC received from its master")]
    assert after(hand, bus={"no_sync": False}) == [("can0", "SYNC", "SYNC received again")]
    assert after(hand, bus={"controller": BusState.OFF, "bus_offs": 1}) == [
        ("can0", "bus-off", "the controller is bus-off"),
        ("can0", "bus_offs", "1 bus-off"),
    ]


def test_a_counter_that_keeps_growing_is_reported_once_a_second(
    hand: HandHealth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By all that it grew meanwhile."""
    now_ns, looked = [10**12], clock.event()
    monkeypatch.setattr(watch_module.clock, "monotonic_ns", lambda: now_ns[0])
    monkeypatch.setattr(watch_module, "_CHECK_S", 0.001)

    def look() -> None:
        """Wait for a check that begins from now on, and for its end."""
        for _ in range(2):
            looked.clear()
            assert looked.wait(10)

    def buses() -> Mapping[str, BusHealth]:
        looked.set()
        return hand.buses()

    events = Events()
    heard = events.subscribe(100)
    with HealthWatch(hand.patches, buses, events):
        for tenth in range(23):
            hand.bus = replace(hand.bus, malformed=tenth + 1)
            now_ns[0] = 10**12 + tenth * 100_000_000
            look()
    texts = [text for _, _, text in reported(heard)]
    assert texts == ["1 malformed frame", "11 malformed frames", "11 malformed frames"]


def test_a_subscriber_that_lags_loses_the_oldest_events() -> None:
    events = Events()
    slow, quick = events.subscribe(2), events.subscribe(100)
    for number in range(5):
        events.publish(HealthEvent(number, "thumb", "rejoins", f"{number}"))
    assert [text for _, _, text in reported(slow)] == ["3", "4"]
    assert (slow.dropped, quick.dropped) == (3, 0)
    events.end()
    assert not quick.ended
    assert [event.text for event in quick] == ["0", "1", "2", "3", "4"]
    assert quick.ended  # so a loop that polls with get() can end
    assert list(quick) == list(events.subscribe(1)) == []


def test_an_event_that_cannot_be_logged_reaches_its_subscribers() -> None:
    class Broken(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise OSError("disk full")

    defects, log, broken = Defects("host"), logging.getLogger(events_module.__name__), Broken()
    events = Events(defects)
    heard, level = events.subscribe(10), log.level
    log.addHandler(broken)
    log.setLevel(logging.INFO)
    try:
        events.publish(HealthEvent(0, "thumb", "rejoins", "1 rejoin"))
    finally:
        log.removeHandler(broken)
        log.setLevel(level)
    assert reported(heard) == [("thumb", "rejoins", "1 rejoin")]
    assert defects.newest == "logging an event: OSError: disk full"
