"""Faults of every kind on a running host: within a second of their end every patch is operational and
streams; until then its health says in one line what holds it back.

Several patches suffer at a time, each another fault; the waves are drawn from a seed.
"""

from __future__ import annotations

import random
import subprocess
import threading
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest

from skinnode.config import HandConfig, parse_hand
from skinnode.errors import NodeTimeout
from skinnode.host import Condition, Host
from skinnode.process import clock
from skinnode.process.clock import SystemClock
from skinnode.transport import CanPort
from tests.lanes import some_long
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .conftest import SMALL
from .processor import ProcessorWait

SEED = 4
BACK_S = 1.0
"""How soon a patch must be operational after the cause of its fault has gone."""
STEADY_S = 0.3
"""How long it must be so without a relapse."""
PATCHES = 4


@dataclass(frozen=True)
class Attack:
    """Faults of one patch one after the other, with how long each lasts."""

    name: str
    steps: tuple[tuple[Faults, float], ...]
    reason: str = ""
    """What health must say at the end of the attack; empty: that depends on chance."""


def attack(name: str, seconds: float = 0.8, *, reason: str = "", **faults: Any) -> Attack:
    return Attack(name, ((Faults(**faults), seconds),), reason)


def after_power_off(name: str, seconds: float, *, reason: str = "", **faults: Any) -> Attack:
    """The patch has to be brought up again while it suffers."""
    steps = ((Faults(unplugged=True), 0.3), (Faults(**faults), seconds))
    return Attack(f"{name} after power-off", steps, reason)


EVERY_KIND = {
    "lost": 0.1,
    "summary_lost": 0.1,
    "sync_lost": 0.1,
    "nmt_lost": 0.1,
    "sdo_request_lost": 0.1,
    "sdo_response_lost": 0.1,
    "lss_request_lost": 0.1,
    "lss_response_lost": 0.1,
    "heartbeat_lost": 0.1,
    "boot_up_lost": 0.1,
    "emcy_lost": 0.1,
    "command_lost": 0.1,
}

ATTACKS = (
    attack("lost chunks", lost=0.3),
    attack("all chunks lost", lost=1.0, reason="no scan from node"),
    attack("duplicated chunks", duplicated=0.3),
    attack("reordered chunks", reordered=0.3),
    attack("late chunks", late=0.2),
    attack("short chunks", short=0.3),
    attack("remote frames", remote=0.3),
    attack("long heartbeats", 1.3, long=1.0, reason="no heartbeat from node"),
    attack("wrong counters", miscounted=0.3),
    attack("torn scans", torn=0.5),
    attack("all summaries lost", summary_lost=1.0),
    attack("half the SYNCs lost", sync_lost=0.5),
    attack("all SYNCs lost", sync_lost=1.0, reason="no scan from node"),
    attack("reset in the middle of a scan", 0.4, reset=1.0),
    attack("restart loop", 2.0, restart_every_s=0.3, reason="keeps restarting without a command"),
    attack("silent node", 1.5, silent=True, reason="no heartbeat from node"),
    attack("silent for a moment", 0.3, silent=True),
    attack("stuck receiver", 1.5, deaf=True),
    attack("unplugged", 1.3, unplugged=True, reason="no heartbeat from node"),
    attack("unplugged for a moment", 0.2, unplugged=True),
    attack("frozen converter", frozen=True),
    attack("drifting resistances", drift_per_s=0.05),
    attack("warmer patch", warmer_k=20.0),
    attack("error-passive controller", error_passive=True, reason="newest emergency 0x8120"),
    attack("second node with the node-ID", 1.5, duplicate_node_id=True),
    after_power_off("second node with the node-ID", 1.5, duplicate_node_id=True),
    attack("EMCY storm", emcy_per_s=300.0, reason="newest emergency 0xFF0F"),
    Attack("lost end of an error", ((Faults(emcy_per_s=50.0), 0.3), (Faults(emcy_lost=1.0), 0.1))),
    attack("babbling node", babble_per_s=2000.0),
    attack("open wire", open_upper=1, reason="wire open or shorted: upper wire open 1"),
    attack("all heartbeats lost", 2.0, heartbeat_lost=1.0, reason="no heartbeat from node"),
    attack("all SDO answers lost", 1.0, sdo_response_lost=1.0),
    after_power_off("all SDO answers lost", 3.0, sdo_response_lost=1.0, reason="no response"),
    after_power_off("all SDO requests lost", 2.0, sdo_request_lost=1.0, reason="no heartbeat from node"),
    after_power_off("a fifth of the SDO answers lost", 2.0, sdo_response_lost=0.2),
    after_power_off("NMT lost", 2.0, nmt_lost=1.0, reason="after the start command, expected 5"),
    after_power_off("boot-up lost", 0.4, boot_up_lost=1.0),
    after_power_off("wrong identity", 0.8, wrong_identity=True, reason="product code: got 0x"),
    after_power_off("wrong layout", 0.8, wrong_layout=True, reason="layout hash: got 0x"),
    attack("a tenth of everything lost", 1.5, **EVERY_KIND),
    after_power_off("a tenth of everything lost", 1.5, **EVERY_KIND),
)


def waves() -> list[tuple[Attack, ...]]:
    """All attacks, as many at a time as there are patches."""
    shuffled = random.Random(SEED).sample(ATTACKS, len(ATTACKS))
    return [tuple(shuffled[i : i + PATCHES]) for i in range(0, len(shuffled), PATCHES)]


class Running:
    """A hand of four patches on two virtual buses, and its host."""

    def __init__(self, fleet: Fleet, host: Host) -> None:
        self.fleet, self.host = fleet, host
        self.names = [patch.name for patch in host.hand.patches]

    def suffer(self, wave: tuple[Attack, ...]) -> dict[str, str]:
        """Go through all steps of each attack; the reasons at the end of the longest."""
        longest_s = max(sum(seconds for _, seconds in each.steps) for each in wave)
        begin_s = clock.monotonic()
        due = []
        for name, each in zip(self.names, wave, strict=False):
            at_s = longest_s - sum(seconds for _, seconds in each.steps)  # all end together
            for faults, seconds in each.steps:
                due.append((at_s, name, faults))
                at_s += seconds
        for at_s, name, faults in sorted(due, key=lambda step: step[0]):
            clock.sleep(max(0.0, begin_s + at_s - clock.monotonic()))
            self.fleet.inject(faults, name)
        clock.sleep(max(0.0, begin_s + longest_s - clock.monotonic()))
        return {name: self.host.health(name).reason for name in self.names}

    def assert_back(self, within_s: float = BACK_S) -> float:
        """From now on; returns after how long, s. It stays so for a moment.

        A machine too busy for its nodes, which then skip scans and say so, is a fault of its own: its
        end counts too, for ten seconds at most. Waiting for a processor does not count."""
        processor = ProcessorWait()
        begin_ns = cause_ns = clock.monotonic_ns()
        steady_ns: int | None = None
        overruns = self._overruns()
        while steady_ns is None or clock.monotonic_ns() < steady_ns + STEADY_S * 1e9:
            waited = {name: why for name in self.names if (why := self._waited_for(name, begin_ns))}
            now_ns = clock.monotonic_ns()
            if self._overruns() != overruns and now_ns < begin_ns + 10e9:
                overruns, cause_ns = self._overruns(), now_ns
            if waited:
                steady_ns = None
                assert now_ns < cause_ns + (within_s + processor.seconds()) * 1e9, waited
            elif steady_ns is None:
                steady_ns = now_ns
            clock.sleep(0.01)
        return (steady_ns - begin_ns) * 1e-9

    def _overruns(self) -> int:
        return sum(report.overruns for report in self.fleet.report())

    def _waited_for(self, name: str, begin_ns: int) -> str:
        health, field = self.host.health(name), self.host.latest(name)
        if health.condition is not Condition.OPERATIONAL:
            assert health.reason  # never silent about it
            return health.reason
        streams = field is not None and field.stamp is not None and field.stamp.t_sync_ns > begin_ns
        return "" if streams else "no field yet"


def hand_on(*buses: dict[str, Any], patches: int, period_ms: int) -> HandConfig:
    table = [
        {
            "name": f"p{i}",
            "node_id": 5 + i,
            "bus": buses[i % len(buses)]["name"],
            "layout": SMALL,
            "tolerances": "exact",
            "serial": i,
        }
        for i in range(patches)
    ]
    named = {"buses": list(buses), "patches": table, "sync": {"period_ms": period_ms}}
    return parse_hand(named)


@pytest.fixture(autouse=True, scope="module")
def nothing_left_running() -> Iterator[None]:
    """All tests here share a host, whose pool grows with what it has to do at a time."""
    threads = set(threading.enumerate())
    yield
    left = {thread.name for thread in threading.enumerate() if thread not in threads}
    assert left <= {"stall watch"}  # of the test that runs


@pytest.fixture(autouse=True, scope="module")
def module_clock() -> Iterator[None]:
    """Virtual time of the host that all tests share."""
    with VirtualClock():
        yield


@pytest.fixture(autouse=True)
def virtual_time(request: pytest.FixtureRequest, module_clock: None) -> Iterator[bool]:
    """Run in the virtual time of the module, but for a test in the kernel."""
    kernel = request.node.get_closest_marker("vcan") is not None
    with clock.use(SystemClock() if kernel else clock.current()):
        yield not kernel


@pytest.fixture(scope="module")
def running(nothing_left_running: None, module_clock: None) -> Iterator[Running]:
    buses = [
        {
            "name": f"can{i}",
            "interface": "timed",
            "channel": uuid.uuid4().hex[:8],
            "heartbeat_node_id": 1,
        }
        for i in range(2)
    ]
    hand = hand_on(*buses, patches=PATCHES, period_ms=50)
    with Fleet(hand, faults=replace(NO_FAULTS, seed=SEED)) as fleet:
        with Host.from_config(hand) as host:
            it = Running(fleet, host)
            it.assert_back(5.0)
            yield it
        clock.sleep(0.1)  # what the host sent last is heard
    for patch in hand.patches:
        assert fleet.tally(patch.name).discrepancies() == []


@pytest.mark.parametrize(
    "wave",
    [pytest.param(wave, marks=pytest.mark.long if i > 1 else []) for i, wave in enumerate(waves())],
    ids=lambda wave: ", ".join(each.name for each in wave),
)
def test_patches_are_back_within_a_second(running: Running, wave: tuple[Attack, ...]) -> None:
    said = running.suffer(wave)
    running.fleet.inject(NO_FAULTS)
    running.assert_back()
    for name, each in zip(running.names, wave, strict=False):
        assert each.reason in said[name], each.name
        assert "\n" not in said[name]


@pytest.mark.long
@pytest.mark.parametrize("off_s", some_long([0.05, 0.2, 1.5], 1.5))
def test_bus_off(running: Running, off_s: float) -> None:
    running.fleet.bus_off("can0", off=True)
    clock.sleep(off_s)
    running.fleet.bus_off("can0", off=False)
    running.assert_back()


@pytest.mark.parametrize("command", some_long([0x02, 0x80, 0x81, 0x82], 0x02, 0x81))
def test_a_stranger_stops_or_resets_a_node(running: Running, command: int) -> None:
    with CanPort(running.host.hand.buses[0]) as stranger:
        stranger.send(0, bytes([command, 5]))
        clock.sleep(0.02)
        running.assert_back()


@pytest.mark.long
def test_a_second_node_with_the_same_id_comes_and_goes(running: Running) -> None:
    table = running.host.hand.model_dump(mode="json")
    twin = parse_hand({**table, "patches": table["patches"][:1], "buses": table["buses"][:1]})
    with Fleet(twin):
        clock.sleep(1.0)
        assert running.host.health("p0").reason
    running.assert_back()


@pytest.mark.long
def test_a_lost_answer_to_a_tare_is_no_operational_patch(running: Running) -> None:
    """Its scans are withheld, since nobody knows the baseline they are encoded with."""
    running.fleet.inject(Faults(sdo_response_lost=1.0), "p0")
    with pytest.raises(NodeTimeout, match="no new baseline"):
        running.host.tare("p0", deadline_s=1.0)
    health = running.host.health("p0")
    assert (health.condition, health.withheld) == (Condition.STALE, True)
    assert health.reason.startswith("its scans are withheld")
    running.fleet.inject(NO_FAULTS, "p0")
    running.assert_back()


@pytest.mark.long
def test_a_host_that_is_restarted_finds_its_nodes_running(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(sync={"period_ms": 50})
    with Fleet(hand) as fleet:
        with Host.from_config(hand) as host:
            Running(fleet, host).assert_back(5.0)
            for name in ("p0", "p1"):  # as if it were killed: nobody tells them to stand by
                fleet.inject(Faults(nmt_lost=1.0), name)
        fleet.inject(NO_FAULTS)
        with Host.from_config(hand) as host:
            Running(fleet, host).assert_back()


@pytest.mark.long
def test_a_node_that_lost_its_configuration_is_configured_again(make_hand: Callable[..., HandConfig]) -> None:
    """Operational by its heartbeats, it rejects every SYNC: its counter overflow is 0 again, as after a reset
    in the middle of a bring-up whose boot-up message was lost."""
    hand = make_hand(sync={"period_ms": 50})
    with Fleet(hand) as fleet, CanPort(hand.buses[0]) as other, Host.from_config(hand) as host:
        running = Running(fleet, host)
        running.assert_back(5.0)
        for request in ("23 06 10 00 00 00 00 00", "2F 19 10 00 00 00 00 00"):  # 0x1006 = 0, 0x1019 = 0
            other.send(0x605, bytes.fromhex(request))
            clock.sleep(0.05)
        clock.sleep(0.2)
        running.assert_back(1.5)  # from the last scan on; it is missed after 0.4 s
        assert host.stats().nodes["p0"].rejoins == 1
        assert host.stats().nodes["p1"].rejoins == 0


@pytest.mark.vcan
def test_an_interface_goes_down_and_up_in_the_kernel() -> None:
    """For moments and for seconds, at any phase of SYNC and heartbeats. One processor of a guest takes long
    for a bring-up, so a second is allowed beyond that of nodes which were reset."""
    chance = random.Random(SEED)
    bus = {"name": "can0", "interface": "socketcan", "channel": "vcan0"}
    hand = hand_on(bus, patches=2, period_ms=100)
    with Fleet(hand) as fleet, Host.from_config(hand) as host, CanPort(hand.buses[0]) as stranger:
        running = Running(fleet, host)
        running.assert_back(10.0)
        brought_up_s = 0.0
        for _ in range(2):
            stranger.send(0, bytes([0x82, 0]))
            clock.sleep(0.1)
            brought_up_s = max(brought_up_s, running.assert_back(10.0))
        stranger.close()
        for down_s in (0.2, 0.5, 1.2, 3.0, 0.2, 0.8):
            clock.sleep(chance.uniform(0.0, 0.3))
            try:
                subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
                clock.sleep(down_s)
            finally:
                subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
            running.assert_back(brought_up_s + BACK_S)
