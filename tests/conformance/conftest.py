"""A patch on a virtual bus, and the tester beside it."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skinnode.config import BusConfig
from skinnode.conformance import Dut, connect
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NodeRunner, PatchNode, VolatileMemory
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

NODE_ID = 4


class Source:
    """A patch at rest."""

    def __init__(self, layout: PatchLayout) -> None:
        self._ohm = resistance_ohm(layout, layout.upper_m)

    def read(self, t_ns: int) -> Float:
        return self._ohm


@contextmanager
def patch_on(
    channel: str,
    wrap: Callable[[CanPort], CanPort] = lambda port: port,
    interface: str = "virtual",
    *,
    fd: bool = False,
    stores: bool = True,
) -> Iterator[PatchNode]:
    """A running patch of 2 × 6 wires; ``wrap`` may stand between it and its bus."""
    layout = PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=2, lower_wires=6)
    profile = PatchProfile.from_layout(layout, bus="fd" if fd else "classic")
    with CanPort(BusConfig(interface=interface, channel=channel, fd=fd)) as bare:
        port = wrap(bare)
        memory = VolatileMemory() if stores else None
        node = PatchNode(NODE_ID, layout, Source(layout), send=port.send, profile=profile, memory=memory)
        with NodeRunner(port, [node]):
            yield node


@contextmanager
def bench_on(channel: str, *, fd: bool = False) -> Iterator[Dut]:
    """The tester, connected to the patch."""
    with CanPort(BusConfig(channel=channel, fd=fd)) as port:
        yield connect(port, NODE_ID)


@pytest.fixture(scope="session")
def dut() -> Iterator[Dut]:
    channel = f"conformance-{uuid.uuid4().hex[:8]}"
    with patch_on(channel), bench_on(channel) as found:
        yield found


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that does not come up is waited for as long as ours takes many times over, not for seconds."""
    monkeypatch.setattr("skinnode.conformance.dut.BOOT_S", 0.6)
