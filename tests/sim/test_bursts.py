"""Chunks that travel as one burst: the same frames, times and counts as one by one."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand
from skinnode.config import BusConfig, HandConfig, parse_hand
from skinnode.errors import BusError
from skinnode.process import clock
from skinnode.transport import CanPort, Frame
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.faulty_bus import FaultyPort
from vcan_sim.fleet import Fleet
from vcan_sim.timed_bus import BitRates, CanFrame, Event, StationOptions, TimedBus
from vcan_sim.timed_interface import segment
from vcan_sim.trace import Trace
from vcan_sim.virtual_time import VirtualClock

FD_BUS = BusConfig(name="can0", interface="timed", channel="can0", fd=True, data_bitrate_bps=4_000_000)
BUSES = [BusConfig(name="can0", interface="timed", channel="can0"), FD_BUS]
HAND: HandConfig = parse_hand(
    {
        "buses": [{"name": "can0", "interface": "timed", "channel": "can0"}],
        "patches": [
            {"name": name, "node_id": node_id, "tolerances": "exact"}
            for node_id, name in enumerate(("thumb", "palm"), start=4)
        ],
        "sync": {"period_ms": 50},
    }
)

SENT = st.lists(
    st.tuples(
        st.integers(0, 400_000),  # pause before these frames, ns
        st.integers(0, 2),  # station
        st.integers(0x100, 0x103),
        st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=9),
    ),
    max_size=12,
)


@settings(max_examples=200, deadline=None)
@given(SENT, st.sampled_from(["fifo", "priority"]), st.randoms(use_true_random=False))
def test_on_the_bus(sent: list[tuple[int, int, int, list[bytes]]], queue: str, draw: random.Random) -> None:
    """Arbitration, times and events do not depend on how the frames have been queued."""

    def events(*, bursts: bool, seed: float) -> list[Event]:
        bus, now_ns, found = TimedBus([StationOptions(queue=queue)] * 3), 0, []  # type: ignore[arg-type]
        pauses = random.Random(seed)
        for pause_ns, station, can_id, payloads in sent:
            now_ns += pause_ns
            frames = [CanFrame(can_id, data) for data in payloads]
            if bursts:
                bus.send_all(now_ns, station, frames)
            else:
                for frame in frames:
                    bus.send(now_ns, station, frame)
            if pauses.random() < 0.5:
                found += bus.advance(now_ns + pauses.randrange(1 + pause_ns // 2))
                now_ns += pause_ns // 2
        return [*found, *bus.advance(10**12)]

    seed = draw.random()
    assert events(bursts=True, seed=seed) == events(bursts=False, seed=seed)


@pytest.mark.parametrize("bus", BUSES, ids=["classic", "fd"])
def test_through_a_port(bus: BusConfig) -> None:
    payloads = [bytes([number]) * (20 if bus.fd else 8) for number in range(7)]

    def sent(*, burst: bool) -> tuple[str, list[Frame], int]:
        with VirtualClock() as virtual, CanPort(bus) as port, CanPort(bus) as other:
            trace = Trace(
                segment("can0", virtual, BitRates(1_000_000, bus.data_bitrate_bps if bus.fd else None))
            )
            assert port.takes_bursts
            if burst:
                port.send_burst(0x184, payloads)
            else:
                for data in payloads:
                    port.send(0x184, data)
            clock.sleep(0.01)
            return trace.text(), other.recv_batch(0.0), port.sent

    assert sent(burst=True) == sent(burst=False)
    assert sent(burst=True)[2] == 7


@pytest.mark.parametrize(
    ("can_id", "data", "message"),
    [
        (0x800, bytes(8), "can_id: got 2048, must be 0 to 0x7FF"),
        (1, bytes(9), "got 9 bytes, must be at most 8"),
    ],
)
def test_bursts_that_do_not_fit(can_id: int, data: bytes, message: str) -> None:
    with VirtualClock(), CanPort(BUSES[0]) as port, pytest.raises(ValueError, match=message):
        port.send_burst(can_id, [data])


def test_closed_and_other_interfaces_take_no_bursts() -> None:
    with VirtualClock():
        port = CanPort(BUSES[0])
        port.close()
        assert not port.takes_bursts
        with pytest.raises(BusError, match="closed"):
            port.send_burst(1, [b""])
    with CanPort(BusConfig(name="can0", interface="virtual", channel="bursts")) as port:
        assert not port.takes_bursts
        with pytest.raises(BusError, match="does not accept bursts"):
            port.send_burst(1, [b""])


Script = Callable[[Fleet], None]


def press(fleet: Fleet) -> None:
    clock.sleep(0.5)


def lose_and_recover(fleet: Fleet) -> None:
    """Begin and end faults in the middle of scans."""
    clock.sleep(0.06)
    for fault in (Faults(lost=0.2), Faults(reordered=0.3), Faults(late=0.3), Faults(silent=True)):
        fleet.inject(fault, "palm")
        clock.sleep(0.113)
        fleet.inject(NO_FAULTS, "palm")
        clock.sleep(0.113)


def unplug(fleet: Fleet) -> None:
    clock.sleep(0.07)
    fleet.inject(Faults(unplugged=True), "palm")
    clock.sleep(0.03)
    fleet.inject(NO_FAULTS, "palm")
    clock.sleep(0.2)


def go_bus_off(fleet: Fleet) -> None:
    clock.sleep(0.07)
    fleet.bus_off("can0", off=True)
    clock.sleep(0.05)
    fleet.bus_off("can0", off=False)
    clock.sleep(0.3)


@contextlib.contextmanager
def one_by_one(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patched:
        patched.setattr(FaultyPort, "takes_bursts", property(lambda port: False))
        yield


@pytest.mark.parametrize("script", [press, lose_and_recover, unplug, go_bus_off])
def test_of_a_hand(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand sends the same frames at the same times, and counts them alike, with faults and without."""

    def run() -> tuple[object, ...]:
        with VirtualClock() as virtual:
            trace = Trace(segment("can0", virtual, BitRates(1_000_000)))
            with Fleet(HAND) as fleet, CanPort(HAND.buses[0]) as master:
                master.send(od.NMT_COB_ID, bytes((NmtCommand.START, 0)))
                clock.sleep(0.01)
                for counter in range(3):
                    master.send(od.SYNC_COB_ID, b"")
                    clock.sleep(0.05 + 0.001 * counter)
                master.send(od.SYNC_COB_ID, b"")
                script(fleet)
                for _ in range(3):
                    master.send(od.SYNC_COB_ID, b"")
                    clock.sleep(0.05)
                tallies = [vars(fleet.tally(name)).copy() for name in ("thumb", "palm")]
                assert not [each for name in ("thumb", "palm") for each in fleet.tally(name).discrepancies()]
                passed = vars(fleet.passed("can0")).copy()
                return trace.text(), fleet.report(), fleet.counts(), tallies, passed

    together = run()
    with one_by_one(monkeypatch):
        alone = run()
    assert together == alone
    assert str(together[0]).count("#") > 500
