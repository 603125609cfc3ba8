"""Nodes, buses and hosts that fail: health names what happened, and the stream is back within a second."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from skinnode.config import HandConfig
from skinnode.host import Condition, Host, nmt_master
from skinnode.host.accounting import discrepancies
from skinnode.host.events import EventSubscription, HealthEvent
from skinnode.process import clock
from skinnode.transport import CanPort
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet

from .conftest import eventually, heard
from .tagged import Tags

BACK_S = 1.0
"""How soon the stream must be back after the cause has gone."""


class Hand:
    """A hand that runs, and all that was told about its health."""

    def __init__(self, fleet: Fleet, host: Host) -> None:
        self.fleet, self.host = fleet, host
        self.told: list[HealthEvent] = []
        self._events: EventSubscription = host.events()

    def inject(self, faults: Faults) -> None:
        self.fleet.inject(faults, "p0")

    def hears(self, subject: str, what: str) -> bool:
        """Whether that event comes."""

        def heard() -> bool:
            while (event := self._events.get(0.0)) is not None:
                self.told.append(event)
            return any((event.subject, event.what) == (subject, what) for event in self.told)

        return eventually(heard)

    def condition(self) -> Condition:
        return self.host.health("p0").condition

    def well_again(self) -> bool:
        """Whether a scan solved comes within a second from now."""
        since_ns = clock.monotonic_ns()

        def streams() -> bool:
            field = self.host.latest("p0")
            return field is not None and field.stamp is not None and field.stamp.t_sync_ns > since_ns

        return eventually(streams, BACK_S)


@pytest.fixture
def running(make_hand: Callable[..., HandConfig], monkeypatch: pytest.MonkeyPatch) -> Iterator[Hand]:
    hand = make_hand()
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up) as fleet:
        with Host.from_config(hand) as host:
            running = Hand(fleet, host)
            assert running.well_again()
            neighbour = host.health("p1")
            yield running
            assert eventually(lambda: host.health("p1").condition is Condition.OPERATIONAL)
            assert host.health("p1").boot_ups == neighbour.boot_ups
            assert host.health("p1").rejoins == 0
        stats = host.stats()
        assert discrepancies(stats) == []
        for name, stream in stats.patches.items():
            assert stream.frames == fleet.injected(name).pdos
        assert tags.mixed == []


@pytest.mark.long
def test_silent_node(running: Hand) -> None:
    boot_ups = running.host.health("p0").boot_ups
    running.inject(Faults(silent=True))
    assert running.hears("p0", "lost")
    running.fleet.inject(NO_FAULTS)
    assert running.well_again()
    assert running.host.health("p0").boot_ups == boot_ups  # it was there all the time


def test_deaf_node_is_stale(running: Hand) -> None:
    running.inject(Faults(deaf=True))
    assert running.hears("p0", "stale")
    assert running.condition() is Condition.STALE
    running.fleet.inject(NO_FAULTS)
    assert running.well_again()
    assert running.hears("p0", "operational")


@pytest.mark.long
def test_node_reset_in_the_middle_of_a_scan(running: Hand) -> None:
    boot_ups = running.host.health("p0").boot_ups
    running.inject(Faults(reset=1.0))
    assert eventually(lambda: running.fleet.injected("p0").reset == 1)
    running.fleet.inject(NO_FAULTS)
    assert running.hears("p0", "boot_ups")
    assert running.well_again()
    assembler, resets = running.host.stats().patches["p0"].assembler, running.fleet.injected("p0").reset
    assert assembler.scans_discarded + assembler.scans_torn == resets
    health = running.host.health("p0")
    assert health.boot_ups == boot_ups + resets
    assert eventually(lambda: running.host.health("p0").rejoins == resets == 1)


@pytest.mark.long
def test_node_that_restarts_in_a_loop_is_told_as_such(running: Hand) -> None:
    boot_ups = running.host.health("p0").boot_ups
    running.inject(Faults(restart_every_s=0.3))
    assert running.hears("p0", "restarts in a loop")
    assert running.host.health("p0").restarts_in_a_loop
    assert running.condition() is Condition.RESTARTING
    running.fleet.inject(NO_FAULTS)
    assert eventually(lambda: running.host.stats().nodes["p0"].phase == "running", BACK_S + 0.3)
    assert running.well_again()
    restarts = running.fleet.injected("p0").restarts
    assert restarts >= 3
    assert running.host.health("p0").boot_ups == boot_ups + restarts


def test_node_unplugged_and_plugged_in_again(running: Hand) -> None:
    boot_ups = running.host.health("p0").boot_ups
    running.inject(Faults(unplugged=True))
    assert running.hears("p0", "lost")
    running.fleet.inject(NO_FAULTS)
    assert running.well_again()
    assert eventually(lambda: running.host.health("p0").rejoins == 1)
    assert running.fleet.injected("p0").unplugged == 1
    assert running.host.health("p0").boot_ups == boot_ups + 1


@pytest.mark.parametrize("wrong", [Faults(wrong_identity=True), Faults(wrong_layout=True)])
def test_another_node_in_its_place_is_refused(running: Hand, wrong: Faults) -> None:
    running.inject(Faults(unplugged=True))
    assert running.hears("p0", "lost")
    running.inject(wrong)
    assert running.hears("p0", "refused")
    refusal = running.host.health("p0").refusal
    assert refusal is not None
    assert ("product code" if wrong.wrong_identity else "layout hash") in refusal
    assert running.fleet.injected("p0").impostures > 0
    running.inject(Faults(unplugged=True))
    assert eventually(lambda: running.fleet.injected("p0").unplugged == 2)
    assert eventually(lambda: running.host.stats().nodes["p0"].phase == "awaited")
    running.fleet.inject(NO_FAULTS)
    assert running.well_again()


def test_storm_of_emergencies(running: Hand) -> None:
    with CanPort(running.host.hand.buses[0]) as listener:
        running.inject(Faults(emcy_per_s=500))
        assert running.hears("p0", "faulty")
        assert running.hears("p0", "emergencies")
        assert eventually(lambda: running.fleet.injected("p0").emergencies > 20)
        running.fleet.inject(NO_FAULTS)
        assert running.hears("p0", "operational")
        assert running.well_again()
        health = running.host.health("p0")
        codes = [int.from_bytes(f.data[:2], "little") for f in heard(listener) if f.can_id == 0x085]
    assert health.emergencies == len([code for code in codes if code])
    assert codes.count(0xFF0F) == running.fleet.injected("p0").emergencies


def test_foreign_babbling_node(running: Hand) -> None:
    running.inject(Faults(babble_per_s=2000))
    assert running.hears("can0", "foreign")
    assert running.well_again()
    running.fleet.inject(NO_FAULTS)
    babbled = running.fleet.injected("p0").babbled
    assert eventually(lambda: running.host.bus_health("can0").foreign >= babbled)
    health = running.host.bus_health("can0")
    assert health.foreign == running.fleet.injected("p0").babbled
    assert health.foreign_ids == (0x3F0,)


@pytest.mark.long
def test_bus_off_and_recovery(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand()
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        running = Hand(fleet, host)
        assert running.well_again()
        fleet.bus_off("can0", off=True)
        assert running.hears("p0", "lost")
        assert running.hears("p1", "lost")
        fleet.bus_off("can0", off=False)
        assert running.well_again()
        assert eventually(lambda: running.condition() is Condition.OPERATIONAL, BACK_S)
        assert host.health("p0").last_emergency == 0x8140
    assert discrepancies(host.stats()) == []


@pytest.mark.long
def test_fleet_that_is_started_anew_below_a_host(make_hand: Callable[..., HandConfig]) -> None:
    """Its nodes hear SYNC with a counter before they are told that there is one."""
    hand = make_hand(patches=1)
    with ExitStack() as power:
        fleet = power.enter_context(Fleet(hand))
        with Host.from_config(hand) as host:
            running = Hand(fleet, host)
            assert running.well_again()
            power.close()
            assert running.hears("p0", "lost")
            running.fleet = power.enter_context(Fleet(hand))
            assert running.well_again()
            assert eventually(lambda: running.condition() is Condition.OPERATIONAL, BACK_S)
            assert host.health("p0").last_emergency == 0x8240
            assert host.health("p0").error_register == 0


def test_end_of_an_error_that_is_lost(make_hand: Callable[..., HandConfig]) -> None:
    """The host asks."""
    hand = make_hand(patches=1)
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        running = Hand(fleet, host)
        assert running.well_again()
        with CanPort(hand.buses[0]) as stranger:
            stranger.send(0x085, bytes.fromhex("00 50 81 00 03 01 00 00"))
        assert eventually(lambda: host.health("p0").emergencies == 1)
        assert eventually(lambda: host.health("p0").error_register == 0)


@pytest.mark.long
def test_second_node_with_the_same_id(
    make_hand: Callable[..., HandConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = make_hand(patches=1)
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up) as fleet, Host.from_config(hand) as host:
        running = Hand(fleet, host)
        assert running.well_again()
        boot_ups = host.health("p0").boot_ups
        with Fleet(hand, wire_up=tags.twin) as twin:
            assert running.hears("p0", "duplicate node-ID")
            twin.inject(Faults(silent=True))
        assert eventually(lambda: not host.health("p0").duplicate_id)
        assert running.well_again()
        assert host.health("p0").boot_ups == boot_ups + 1
        assert host.health("p0").conflicts == host.stats().patches["p0"].assembler.conflicts
    stats = host.stats()
    assert discrepancies(stats) == []
    assert stats.patches["p0"].frames == fleet.injected("p0").pdos + twin.injected("p0").pdos
    assert [line for line in tags.mixed if "readings" in line] == []  # whole scans of either are seen


def test_second_producer_of_sync(running: Hand) -> None:
    with CanPort(running.host.hand.buses[0]) as other:
        other.send(0x080, b"\x05")
        assert running.hears("can0", "other_syncs")
    assert running.host.bus_health("can0").other_syncs == 1
    assert running.well_again()


@pytest.mark.system_time
def test_stuck_receiver_costs_nobody_else(running: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinnode.transport.port.VIRTUAL_QUEUE_FRAMES", 16)
    with CanPort(running.host.hand.buses[0]):  # nobody reads it
        port = running.fleet._ports["can0"]
        assert eventually(lambda: port.undelivered > 100)
        assert running.well_again()
    assert eventually(lambda: running.host.health("p0").condition is Condition.OPERATIONAL)


def test_host_that_dies_is_followed_by_another(
    make_hand: Callable[..., HandConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a kill: the nodes are not told, and go on."""
    hand = make_hand()
    with Fleet(hand) as fleet:
        with monkeypatch.context() as dying, Host.from_config(hand) as host:
            assert Hand(fleet, host).well_again()
            dying.setattr(nmt_master, "stand_by", lambda send, node_id: None)
        assert {int(report.nmt_state) for report in fleet.report()} == {5}
        with Host.from_config(hand) as host:
            assert Hand(fleet, host).well_again()
            assert all(stream.assembler.scans_torn == 0 for stream in host.stats().patches.values())
        assert discrepancies(host.stats()) == []


@pytest.mark.long
def test_frozen_values(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(simulation={"cycle_s": 60.0})
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        running = Hand(fleet, host)
        assert running.well_again()
        assert eventually(lambda: host.stats().patches["p0"].solved > 80)
        fleet.inject(Faults(frozen=True), "p0")
        assert running.hears("p0", "frozen")
        assert eventually(lambda: host.health("p1").condition is Condition.OPERATIONAL)
        fleet.inject(NO_FAULTS)
        assert running.hears("p0", "operational")
        assert running.well_again()
    assert fleet.injected("p0").frozen >= 3  # the phase tells at once: PHASES_REPEATED


def test_heartbeat_and_emergency_of_wrong_length(running: Hand) -> None:
    with CanPort(running.host.hand.buses[0]) as stranger:
        stranger.send(0x705, b"\x05\x05")
        stranger.send(0x085, bytes(7))
        assert running.hears("can0", "malformed")
    assert eventually(lambda: running.host.bus_health("can0").malformed == 2)
    assert running.hears("p0", "faulty")  # the node itself says that somebody uses its identifiers
    assert eventually(lambda: running.host.health("p0").last_emergency == 0x8150)


def test_loop_over_events_ends_with_the_host(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(patches=1)
    with Fleet(hand), Host.from_config(hand) as host:
        seen: list[HealthEvent] = []
        events = host.events()
        reader = clock.thread(lambda: seen.extend(events), "reader")
        reader.start()
    reader.join(10)
    assert not reader.is_alive()
    with pytest.raises(ValueError, match="capacity: got 0, must be an integer of at least 1"):
        host.events(capacity=0)
