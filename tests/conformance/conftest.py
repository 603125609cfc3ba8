"""A patch on a bus, and the tester beside it, in virtual time."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skinnode.config import BusConfig
from skinnode.conformance import Dut, Eds, connect
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode, VolatileMemory
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from vcan_sim.virtual_time import VirtualClock

NODE_ID = 4


class Source:
    """A patch at rest."""

    def __init__(self, layout: PatchLayout) -> None:
        self._ohm = resistance_ohm(layout, layout.upper_m)

    def read(self, t_ns: int) -> Float:
        return self._ohm


@pytest.fixture(autouse=True)
def virtual_time(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run the test in virtual time, unless code that knows only the system's clock takes part in it."""
    if any(request.node.get_closest_marker(name) for name in ("system_time", "vcan")):
        yield
        return
    with VirtualClock():
        yield


def bus_in_this_time(channel: str, *, fd: bool = False) -> BusConfig:
    """A bus within this process."""
    interface = "timed" if isinstance(clock.current(), VirtualClock) else "virtual"
    return BusConfig(interface=interface, channel=channel, fd=fd)


@contextmanager
def patch_on(
    channel: str,
    wrap: Callable[[CanPort], CanPort] = lambda port: port,
    interface: str | None = None,
    *,
    fd: bool = False,
    stores: bool = True,
) -> Iterator[PatchNode]:
    """A running patch of 2 × 6 wires; ``wrap`` may stand between it and its bus."""
    layout = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2, lower_wires=6)
    profile = PatchProfile.from_layout(layout, bus="fd" if fd else "classic")
    bus = bus_in_this_time(channel, fd=fd)
    with CanPort(bus.model_copy(update={"interface": interface or bus.interface})) as bare:
        port = wrap(bare)
        memory = VolatileMemory() if stores else None
        node = PatchNode(NODE_ID, layout, Source(layout), send=port.send, profile=profile, memory=memory)
        with NodeRunner(port, [node]):
            yield node


@contextmanager
def bench_on(channel: str, *, fd: bool = False) -> Iterator[Dut]:
    """The tester, connected to the patch."""
    with CanPort(bus_in_this_time(channel, fd=fd)) as port:
        yield connect(port, NODE_ID)


@pytest.fixture(scope="session")
def own_eds() -> Eds:
    """The EDS that is generated from the descriptor of the patch; reading it takes longer than most cases."""
    with VirtualClock(), patch_on("descriptor"), bench_on("descriptor") as found:
        return found.eds


@pytest.fixture
def dut(own_eds: Eds, virtual_time: None) -> Iterator[Dut]:
    channel = f"conformance-{uuid.uuid4().hex[:8]}"
    with patch_on(channel), CanPort(bus_in_this_time(channel)) as port:
        yield connect(port, NODE_ID, own_eds)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that does not come up is waited for as long as ours takes many times over, not for seconds."""
    monkeypatch.setattr("skinnode.conformance.dut.BOOT_S", 0.6)
