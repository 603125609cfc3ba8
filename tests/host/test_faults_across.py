"""The faults that matter most on interfaces that cross processes, kernel CAN among them."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator

import pytest

from skinnode.config import BusConfig, HandConfig
from skinnode.host import Condition, Host
from skinnode.host.accounting import discrepancies
from skinnode.process import clock
from skinnode.protocol.scan import AssemblerStats
from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.fleet import Fleet

from .conftest import eventually
from .tagged import Tags

pytestmark = pytest.mark.real_time

BACK_S = 1.0
"""How soon the stream must be back after the cause has gone."""


@pytest.fixture
def running(
    make_hand: Callable[..., HandConfig], crossing_bus: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Suffers]:
    bus = crossing_bus
    table = {"name": "can0", "interface": bus.interface, "channel": bus.channel}
    hand = make_hand(patches=1, buses=[table], sync={"period_ms": 50})
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up) as fleet:
        with Host.from_config(hand) as host:
            assert eventually(lambda: host.stats().patches["p0"].solved > 5)
            yield Suffers(fleet, host)
        assert discrepancies(host.stats()) == []
        assert host.stats().patches["p0"].frames == fleet.injected("p0").pdos
        assert tags.mixed == []


class Suffers:
    """A hand of one patch on such an interface."""

    def __init__(self, fleet: Fleet, host: Host) -> None:
        self.fleet, self.host = fleet, host

    def until(self, faults: Faults, so_often: Callable[[Injected], bool]) -> None:
        """Inject until there were enough; the stream is back within a second, and all has been counted."""
        self.fleet.inject(faults)
        assert eventually(lambda: so_often(self.injected()))
        self.fleet.inject(NO_FAULTS)
        self.is_back()
        solved = self.host.stats().patches["p0"].solved
        assert eventually(lambda: self.host.stats().patches["p0"].solved > solved + 4)

    def is_back(self) -> None:
        """Within a second."""
        since_ns = clock.monotonic_ns()

        def streams() -> bool:
            field = self.host.latest("p0")
            return field is not None and field.stamp is not None and field.stamp.t_sync_ns > since_ns

        assert eventually(streams, BACK_S)

    def injected(self) -> Injected:
        return self.fleet.injected("p0")

    def counted(self) -> AssemblerStats:
        return self.host.stats().patches["p0"].assembler

    def condition(self) -> Condition:
        return self.host.health("p0").condition

    def overruns(self) -> int:
        """Scans that the node skipped by itself, because this machine was too busy for it."""
        (report,) = self.fleet.report()
        return report.overruns


def test_lost_chunks(running: Suffers) -> None:
    running.until(Faults(lost=0.05), lambda injected: injected.lost > 10)
    counted, injected = running.counted(), running.injected()
    assert counted.chunks_lost == injected.lost
    assert counted.scans_torn == injected.scans_spoilt
    assert counted.duplicates == counted.late == counted.conflicts == 0


@pytest.mark.long
def test_duplicated_and_late_chunks(running: Suffers) -> None:
    running.until(
        Faults(duplicated=0.05, late=0.05),
        lambda injected: injected.duplicated > 10 and injected.late > 10,
    )
    counted, injected = running.counted(), running.injected()
    assert counted.chunks_lost == injected.late
    # The duplicate of a scan's last frame is late when the scan has been given up by then.
    assert counted.late >= injected.late
    assert counted.late + counted.duplicates == injected.late + injected.duplicated
    assert counted.scans_torn == injected.scans_spoilt


@pytest.mark.long
def test_lost_syncs(running: Suffers) -> None:
    running.until(Faults(sync_lost=0.2), lambda injected: injected.sync_lost > 3)
    assert running.counted().scans_missed == running.injected().sync_lost + running.overruns()
    assert running.counted().scans_torn == running.counted().chunks_lost == 0


@pytest.mark.long
def test_two_scans_under_one_counter(running: Suffers) -> None:
    running.until(Faults(torn=0.2), lambda injected: injected.torn > 3)
    assert running.counted().scans_mixed == running.injected().torn
    assert running.counted().conflicts == running.injected().torn_chunks


@pytest.mark.long
def test_reset_in_the_middle_of_a_scan(running: Suffers) -> None:
    boot_ups = running.host.health("p0").boot_ups
    running.until(Faults(reset=1.0), lambda injected: injected.reset > 0)
    assert eventually(lambda: running.condition() is Condition.OPERATIONAL, BACK_S)
    assert running.host.health("p0").boot_ups == boot_ups + running.injected().reset


def test_unplugged_and_plugged_in_again(running: Suffers) -> None:
    running.until(Faults(unplugged=True), lambda _: running.condition() is Condition.LOST)
    assert running.injected().unplugged == 1
    assert eventually(lambda: running.host.health("p0").rejoins == 1)


@pytest.mark.long
def test_bus_off_and_recovery(running: Suffers) -> None:
    running.fleet.bus_off("can0", off=True)
    assert eventually(lambda: running.condition() is Condition.LOST)
    running.fleet.bus_off("can0", off=False)
    running.is_back()
    assert eventually(lambda: running.condition() is Condition.OPERATIONAL, BACK_S)
    assert running.host.health("p0").last_emergency == 0x8140


@pytest.mark.long
def test_silent_and_deaf_node(running: Suffers) -> None:
    running.until(Faults(silent=True), lambda _: running.condition() is Condition.LOST)
    running.until(Faults(deaf=True), lambda _: running.condition() is Condition.STALE)
    assert running.injected().silenced > 0
    assert running.injected().unheard > 0


def can_socket() -> socket.socket:
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


@pytest.mark.vcan
def test_error_frames_of_the_hosts_own_controller(make_hand: Callable[..., HandConfig]) -> None:
    """As a driver tells them (linux/can/error.h): passive, off the bus, started anew; and once more off."""
    passive, off, anew = (0x2000_0004, b"\0\x30"), (0x2000_0040, b""), (0x2000_0100, b"")
    table = {"name": "can0", "interface": "socketcan", "channel": "vcan0"}
    hand = make_hand(patches=1, buses=[table], sync={"period_ms": 50})
    with Fleet(hand), Host.from_config(hand) as host, can_socket() as driver:
        driver.bind(("vcan0",))
        events = host.events()
        for can_id, data in (passive, off, off, anew, off, anew):
            driver.send(struct.pack("=IB3x8s", can_id, 8, data))
        assert eventually(lambda: host.bus_health("can0").error_frames == 6)
        assert host.bus_health("can0").bus_offs == 2
        assert host.bus_health("can0").controller == "error active"
        solved = host.stats().patches["p0"].solved
        assert eventually(lambda: host.stats().patches["p0"].solved > solved + 4)
        told = set()
        while (event := events.get(0.2)) is not None:
            told.add((event.subject, event.what))
    assert {("can0", "bus_offs"), ("can0", "error_frames"), ("can0", "error active")} <= told
    assert discrepancies(host.stats()) == []
