"""What all tests share."""

from __future__ import annotations

import functools
import os
import random
import signal
import socket
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
import typer.main
import typer.testing

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.transport import CanPort

from . import stalls, workers

# typer builds all commands for each call of one, which takes three times as long as most calls in the tests.
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)

REQUIRE_VCAN = "SKINNODE_REQUIRE_VCAN"


FUZZ_FRAMES = 20_000


def pytest_addoption(parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager) -> None:
    pluginmanager.register(stalls, "stalls")
    pluginmanager.register(workers, "workers")
    parser.addoption("--frames", type=int, default=FUZZ_FRAMES, help="frames that a node is fuzzed with")
    parser.addoption(
        "--all-injections", action="store_true", help="an exception at every call of a thread of the host"
    )
    parser.addoption("--injection-seed", type=int, default=0, help="which calls, where not every one")


def pytest_configure() -> None:
    """Let Ctrl-C end the programs that tests start.

    A script starts a program in the background with SIGINT ignored, which all its descendants inherit."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def fuzz_frames(request: pytest.FixtureRequest) -> int:
    """How many frames a node is fuzzed with."""
    frames: int = request.config.getoption("--frames")
    return frames


@pytest.fixture(autouse=True)
def _signal_handlers() -> Iterator[None]:
    """A command that is run in this process leaves its own in place: its process ends with it."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


def has_vcan() -> bool:
    """Whether the kernel has an interface vcan0."""
    return any(name == "vcan0" for _, name in socket.if_nameindex())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked ``vcan`` run where the kernel has vcan0, and are skipped elsewhere: `tools/vcan/vcan-run`
    boots a kernel that has it."""
    if has_vcan():
        return
    if os.environ.get(REQUIRE_VCAN):
        raise pytest.UsageError(f"{REQUIRE_VCAN} is set, but the kernel has no interface vcan0")
    skip = pytest.mark.skip(reason="no vcan0 in this kernel; CONTRIBUTING.md says how to run it all the same")
    for item in items:
        if item.get_closest_marker("vcan"):
            item.add_marker(skip)


@pytest.fixture
def multicast_group() -> str:
    """A multicast address that nobody else on this machine is likely to use at the same time."""
    return f"239.74.{random.randrange(256)}.{random.randrange(256)}"


@functools.cache
def has_multicast() -> bool:
    """Whether what is sent to a multicast group of this machine is heard on it."""
    bus = BusConfig(name="can7", interface="udp_multicast", channel="239.74.255.255")
    try:
        with CanPort(bus) as port, CanPort(bus) as other:
            port.send(0x7FF, b"")
            return other.recv(2.0) is not None
    except BusError:
        return False


EVERY_INTERFACE = ["virtual", "udp_multicast", pytest.param("socketcan", marks=pytest.mark.vcan)]
BETWEEN_PROCESSES = EVERY_INTERFACE[1:]


def bus_on(interface: str, group: str) -> BusConfig:
    """A bus that nobody else uses; ``group``: its address if it is a multicast group. vcan0 is there once.
    Skips where multicast is not."""
    if interface == "udp_multicast" and not has_multicast():
        pytest.skip("no multicast on this machine")
    channel = {"udp_multicast": group, "socketcan": "vcan0"}.get(interface, uuid.uuid4().hex)
    return BusConfig(name="can7", interface=interface, channel=channel)


@pytest.fixture(params=EVERY_INTERFACE)
def any_bus(request: pytest.FixtureRequest, multicast_group: str) -> BusConfig:
    """Each interface that a test can have to itself."""
    return bus_on(request.param, multicast_group)


@pytest.fixture(params=BETWEEN_PROCESSES)
def crossing_bus(request: pytest.FixtureRequest, multicast_group: str) -> BusConfig:
    """Each interface that crosses processes."""
    return bus_on(request.param, multicast_group)


@pytest.fixture
def plain_bus() -> Callable[..., can.BusABC]:
    """Opens python-can's own bus, apart from our transport."""
    return _plain_bus


def _plain_bus(config: BusConfig, **options: Any) -> can.BusABC:
    """python-can's own bus at another end of ``config``. On multicast it is told to hear its own group only:
    python-can binds to any address, and would hear every group that anyone on the machine has joined."""
    bus = can.Bus(interface=config.interface, channel=config.channel, ignore_config=True, **options)
    if config.interface == "udp_multicast":
        tuned = socket.socket(fileno=os.dup(bus.fileno()))
        tuned.setsockopt(socket.IPPROTO_IP, 49, 0)  # IP_MULTICAST_ALL
        tuned.close()
        while bus.recv(0.0) is not None:  # of other groups, before it was told
            pass
    return bus
