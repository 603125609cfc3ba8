"""What a host makes of the error frames of an interface: counters, health and the exit status."""

from __future__ import annotations

import can
import pytest

from skinnode.cli._run_report import faults_and_notes
from skinnode.config import BusConfig, HandConfig
from skinnode.host import Host
from skinnode.host.accounting import discrepancies, losses_of_bus
from skinnode.host.dispatcher import Dispatcher
from skinnode.transport import Frame
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import eventually

WARNING, PASSIVE, ACTIVE = "00 08 00 00 00 00 60 00", "00 20 00 00 00 00 90 00", "00 40 00 00 00 00 00 00"


@pytest.mark.parametrize(
    ("told", "controller", "bus_offs"),
    [
        ([(0x204, WARNING)], "error warning", 0),
        ([(0x204, WARNING), (0x204, PASSIVE)], "error passive", 0),
        ([(0x204, PASSIVE), (0x040, "00 " * 8)], "bus-off", 1),
        ([(0x040, "00 " * 8), (0x100, "00 " * 8)], "error active", 1),
        ([(0x204, PASSIVE), (0x204, ACTIVE)], "error active", 0),
        ([(0x02A, "00 00 08 00 80 00 00 00")], None, 0),  # no acknowledge: of no state
    ],
)
def test_states_of_a_controller_as_linux_tells_them(
    told: list[tuple[int, str]], controller: str | None, bus_offs: int
) -> None:
    dispatcher = Dispatcher(BusConfig(name="can0", interface="socketcan", channel="can0"), {}, 0)
    dispatcher.dispatch([Frame(can_id, bytes.fromhex(data), 0, error=True) for can_id, data in told])
    stats = dispatcher.count()
    assert (stats.controller, stats.bus_offs, stats.error_frames) == (controller, bus_offs, len(told))
    assert losses_of_bus(stats)["error_frames"].startswith(f"{len(told)} error frame")


@pytest.mark.system_time
def test_an_error_frame_is_a_fault_of_the_bus(hand: HandConfig, fleet: Fleet) -> None:
    bus = hand.buses[0]
    with Host.from_config(hand) as host, can.Bus(interface="virtual", channel=bus.channel) as driver:
        assert "can0: 1 error frame" not in faults_and_notes(host)[0]
        fleet.inject(Faults(unplugged=True))  # a host without processor time would drop the newest frames
        driver.send(can.Message(arbitration_id=0x04, data=bytes(8), is_error_frame=True))
        assert eventually(lambda: host.bus_health("can0").error_frames == 1), host.stats()
        assert "can0: 1 error frame" in faults_and_notes(host)[0]
    assert discrepancies(host.stats()) == []
