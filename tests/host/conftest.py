"""A small hand on a bus of its own, its simulated nodes, and the check that nothing stays behind."""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from skinnode.model.config import HandConfig, parse_hand
from skinnode.transport import CanPort, Frame
from vcan_sim.fleet import Fleet

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Threads and file descriptors are the same after a test as before it."""
    threads, descriptors = set(threading.enumerate()), os.listdir("/proc/self/fd")
    yield
    left = [thread.name for thread in threading.enumerate() if thread not in threads]
    assert left == []
    assert len(os.listdir("/proc/self/fd")) == len(descriptors)


@pytest.fixture
def make_hand() -> Callable[..., HandConfig]:
    """A hand of small patches called p0, p1 … with node-IDs from 5 on, on a virtual bus of its own."""

    def make(patches: int = 2, **tables: object) -> HandConfig:
        bus = {"name": "can0", "interface": "virtual", "channel": uuid.uuid4().hex[:8]}
        listed = [{"name": f"p{i}", "node_id": 5 + i, "layout": SMALL} for i in range(patches)]
        return parse_hand({"buses": [bus], "patches": listed, "sync": {"period_ms": 25}, **tables})

    return make


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
    """Whether ``condition`` comes true; how long it takes is not what is tested."""
    end_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True
