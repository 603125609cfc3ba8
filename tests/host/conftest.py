"""A small hand on a bus of its own, its simulated nodes, and the check that nothing stays behind."""

from __future__ import annotations

import os
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from multiprocessing import resource_tracker
from typing import Any

import pytest

from skinnode.config import BusConfig, HandConfig, parse_hand
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float
from skinnode.node import NodeRunner, PatchNode
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort, Frame
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .processor import ProcessorWait

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Threads and file descriptors are the same after a test as before it."""
    resource_tracker.ensure_running()  # multiprocessing opens its pipe once, and keeps it
    threads, descriptors = set(threading.enumerate()), os.listdir("/proc/self/fd")
    yield
    left = [thread.name for thread in threading.enumerate() if thread not in threads]
    assert left == []
    assert len(os.listdir("/proc/self/fd")) <= len(descriptors)  # an earlier test's garbage may have gone


@pytest.fixture(autouse=True)
def virtual_time(request: pytest.FixtureRequest, nothing_left_running: None) -> Iterator[bool]:
    """Run the test in virtual time, unless other processes or event loops take part in it."""
    marked = any(request.node.get_closest_marker(name) for name in ("system_time", "vcan"))
    if marked or "crossing_bus" in request.fixturenames:
        yield False
        return
    with VirtualClock():
        yield True


@pytest.fixture
def make_hand(virtual_time: bool) -> Callable[..., HandConfig]:
    """A hand of small patches called p0, p1 … with node-IDs from 5 on, on a bus of its own."""

    def make(patches: int = 2, **tables: object) -> HandConfig:
        interface = "timed" if virtual_time else "virtual"
        bus = {"name": "can0", "interface": interface, "channel": uuid.uuid4().hex[:8]}
        listed = [
            {"name": f"p{i}", "node_id": 5 + i, "layout": SMALL, "tolerances": "exact"}
            for i in range(patches)
        ]
        return parse_hand({"buses": [bus], "patches": listed, "sync": {"period_ms": 25}, **tables})

    return make


@pytest.fixture
def crossing_hand(make_hand: Callable[..., HandConfig], crossing_bus: BusConfig) -> HandConfig:
    """A hand on each interface that crosses processes."""
    table = {"name": "can0", "interface": crossing_bus.interface, "channel": crossing_bus.channel}
    return make_hand(buses=[table])


@pytest.fixture
def hand(make_hand: Callable[..., HandConfig]) -> HandConfig:
    return make_hand()


@pytest.fixture
def fleet(hand: HandConfig) -> Iterator[Fleet]:
    with Fleet(hand) as running:
        yield running


@pytest.fixture
def listener_of() -> Iterator[Callable[[HandConfig], CanPort]]:
    """Somebody else on the bus of a hand, who hears everything."""
    with ExitStack() as ports:
        yield lambda hand: ports.enter_context(CanPort(hand.buses[0]))


@pytest.fixture
def listener(hand: HandConfig, listener_of: Callable[[HandConfig], CanPort]) -> CanPort:
    return listener_of(hand)


def heard(port: CanPort) -> list[Frame]:
    """All frames waiting at ``port``."""
    frames = []
    while (frame := port.recv(0.0)) is not None:
        frames.append(frame)
    return frames


def eventually(condition: Callable[[], bool], within_s: float = 10.0) -> bool:
    """Whether ``condition`` comes true in time; waiting for a processor does not count."""
    end_s, waited = clock.monotonic() + within_s, ProcessorWait()
    while not condition():
        if clock.monotonic() > end_s + waited.seconds():
            return False
        clock.sleep(0.01)
    return True


class Still:
    """The resistances of a patch that does not move, until a test changes them."""

    def __init__(self, ohm: Float) -> None:
        self.ohm = ohm

    def read(self, t_ns: int) -> Float:
        return self.ohm


class Rack:
    """The patches of a hand as the real node, each plugged in and pulled out by itself."""

    def __init__(self, hand: HandConfig) -> None:
        self.hand = hand
        self.sources = {}
        for patch in hand.patches:
            layout = patch.layout.build()
            self.sources[patch.name] = Still(resistance_ohm(layout, layout.upper_m))
        self.nodes: dict[str, PatchNode] = {}
        self._plugged: dict[str, ExitStack] = {}

    def plug(
        self,
        name: str,
        *,
        node_id: int | None = None,
        lets_through: Callable[[int, bytes], bool] = lambda can_id, data: True,
        **options: Any,
    ) -> PatchNode:
        """Power a patch on: a new node every time. Only what ``lets_through`` says reaches the bus."""
        patch = self.hand.patch(name)
        bus = self.hand.bus(patch.bus)
        options = {"serial": patch.serial or 0, "layout": patch.layout.build(), **options}
        options.setdefault("profile", PatchProfile.from_layout(options["layout"], patch.code_bits))
        with ExitStack() as stack:
            port = stack.enter_context(CanPort(bus))

            def send(can_id: int, data: bytes) -> None:
                if lets_through(can_id, data):
                    port.send(can_id, data)

            node = PatchNode(
                patch.node_id if node_id is None else node_id, source=self.sources[name], send=send, **options
            )
            stack.enter_context(NodeRunner(port, [node]))
            self._plugged[name] = stack.pop_all()
        self.nodes[name] = node
        return node

    def pull(self, name: str) -> None:
        """Cut its power."""
        self._plugged.pop(name).close()

    def close(self) -> None:
        for name in list(self._plugged):
            self.pull(name)


@pytest.fixture
def rack_of() -> Iterator[Callable[[HandConfig], Rack]]:
    """A rack with nothing plugged in."""
    with ExitStack() as racks:
        yield lambda hand: racks.enter_context(closing(Rack(hand)))


@pytest.fixture
def rack(hand: HandConfig, rack_of: Callable[[HandConfig], Rack]) -> Rack:
    """The patches of ``hand``, all plugged in."""
    rack = rack_of(hand)
    for patch in hand.patches:
        rack.plug(patch.name)
    return rack
