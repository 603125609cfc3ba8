"""The faults that matter most on interfaces that cross processes, kernel CAN among them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from skinnode.errors import BusError
from skinnode.host import Condition, Host
from skinnode.host.accounting import discrepancies
from skinnode.model.config import BusConfig, HandConfig
from skinnode.transport import CanPort
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet

from .conftest import eventually
from .tagged import Tags


@pytest.fixture
def fleet_and_host(
    make_hand: Callable[..., HandConfig], crossing_bus: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Fleet, Host]]:
    bus = crossing_bus
    try:
        with CanPort(bus) as port, CanPort(bus) as other:
            port.send(0x7FF, b"")
            if other.recv(2.0) is None:
                pytest.skip("no multicast on this machine")
    except BusError:
        pytest.skip("no multicast on this machine")
    table = {"name": "can0", "interface": bus.interface, "channel": bus.channel}
    hand = make_hand(patches=1, buses=[table], sync={"period_ms": 50})
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up) as fleet:
        with Host.from_config(hand) as host:
            assert eventually(lambda: host.stats().patches["p0"].solved > 5)
            yield fleet, host
        assert discrepancies(host.stats()) == []
        assert host.stats().patches["p0"].frames == fleet.injected("p0").pdos
        assert tags.mixed == []


def goes_on(host: Host, within_s: float = 10.0) -> bool:
    solved = host.stats().patches["p0"].solved
    return eventually(lambda: host.stats().patches["p0"].solved > solved + 4, within_s)


def test_lost_chunks(fleet_and_host: tuple[Fleet, Host]) -> None:
    fleet, host = fleet_and_host
    fleet.inject(Faults(lost=0.05))
    assert eventually(lambda: fleet.injected("p0").lost > 10)
    fleet.inject(NO_FAULTS)
    assert goes_on(host)
    counted, injected = host.stats().patches["p0"].assembler, fleet.injected("p0")
    assert counted.chunks_lost == injected.lost
    assert counted.scans_torn == injected.scans_spoilt


def test_reset_in_the_middle_of_a_scan(fleet_and_host: tuple[Fleet, Host]) -> None:
    fleet, host = fleet_and_host
    fleet.inject(Faults(reset=1.0))
    assert eventually(lambda: fleet.injected("p0").reset == 1)
    fleet.inject(NO_FAULTS)
    assert eventually(lambda: host.health("p0").condition is Condition.RESTARTING)
    assert goes_on(host)


def test_unplugged_and_plugged_in_again(fleet_and_host: tuple[Fleet, Host]) -> None:
    fleet, host = fleet_and_host
    fleet.inject(Faults(unplugged=True))
    assert eventually(lambda: host.health("p0").condition is Condition.LOST)
    fleet.inject(NO_FAULTS)
    assert goes_on(host)
    assert host.health("p0").rejoins == 1
