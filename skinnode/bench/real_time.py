"""Measures a real-time simulator's CPU time on udp_multicast, and the time to exchange a frame.

The simulator and the host run in separate processes, as they do with ``vcan-sim``. The hand has sixteen
patches on four buses. Spheres press on four patches, and all chunks are sent.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any, Final, NamedTuple

from skinnode.bench.scale import hand_of, scene_of
from skinnode.bench.timing import take_turns
from skinnode.config import BusConfig, HandConfig
from skinnode.host import Host
from skinnode.process.child_processes import starting_children
from skinnode.process.garbage_collection import without_long_collections
from skinnode.transport import CanPort, open_can_bus
from vcan_sim.fleet import Fleet

PATCHES: Final = 16
TOUCHED: Final = 4
HOP_LIMITS: Final = (1, 0)
"""Values of python-can's ``hop_limit`` option. With 1, the default, each frame is also sent to the network;
with 0, frames stay on this machine."""
_SETTLED_S: Final = 3.0
"""Time between bring-up and measurement, in s."""
_BURST: Final = 16
"""Number of frames sent at a time while frame exchange is timed."""

Row = dict[str, Any]


class _Counts(NamedTuple):
    """Simulator counters since start-up."""

    cpu_s: float
    frames: int
    scans: int
    skipped: int


def run(seconds: float) -> dict[str, Any]:
    """Measure the simulator with each hop limit, and the time to exchange a frame.

    Args:
        seconds: Duration of each measurement, in s.

    Returns:
        ``rows``: results of :func:`measure`; ``frame_us``: result of :func:`frame_us`.
    """
    return {
        "rows": [measure(PATCHES, TOUCHED, hop_limit, seconds) for hop_limit in HOP_LIMITS],
        "frame_us": frame_us(),
    }


def measure(patches: int, touched: int, hop_limit: int, seconds: float) -> Row:
    """Run a simulator and a host in real time, each in its own process.

    Args:
        patches: Number of patches.
        touched: Number of touched patches.
        hop_limit: ``hop_limit`` option of all buses.
        seconds: Duration of the measurement, in s.

    Returns:
        The arguments; the two processes' CPU times divided by the duration (``simulator``, ``host``); the
        number of frames that the nodes sent per second (``frames_per_s``); the numbers of ``scans`` sent,
        scans ``skipped`` because the machine was too busy, and ``fields`` solved; and the machine's ``load``,
        averaged over the last minute.
    """
    hand = on_multicast(hand_of(patches), hop_limit)
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe()
    process = context.Process(target=_simulate, args=(theirs, hand, touched), daemon=True)
    with starting_children():
        process.start()
    theirs.close()
    try:
        _counts(pipe)
        with Host.from_config(hand) as host, without_long_collections():
            time.sleep(_SETTLED_S)
            before, host_s, fields, start_s = (
                _counts(pipe),
                time.process_time(),
                _solved(host),
                time.monotonic(),
            )
            time.sleep(seconds)
            after, host_s = _counts(pipe), time.process_time() - host_s
            seconds, fields = time.monotonic() - start_s, _solved(host) - fields
    finally:
        pipe.close()  # makes the child process exit
        process.join()
    return {
        "patches": patches,
        "touched": touched,
        "hop_limit": hop_limit,
        "seconds": seconds,
        "simulator": (after.cpu_s - before.cpu_s) / seconds,
        "host": host_s / seconds,
        "frames_per_s": (after.frames - before.frames) / seconds,
        "scans": after.scans - before.scans,
        "skipped": after.skipped - before.skipped,
        "fields": fields,
        "load": os.getloadavg()[0],
    }


def on_multicast(hand: HandConfig, hop_limit: int) -> HandConfig:
    """Return a copy of the hand that uses randomly chosen multicast groups."""
    groups = random.sample(range(1 << 16), len(hand.buses))
    buses = tuple(
        _multicast_bus(bus.name, group, hop_limit) for bus, group in zip(hand.buses, groups, strict=True)
    )
    return hand.model_copy(update={"buses": buses})


def _multicast_bus(name: str, group: int, hop_limit: int) -> BusConfig:
    return BusConfig(
        name=name,
        interface="udp_multicast",
        channel=f"239.74.{group >> 8}.{group & 255}",
        options={"hop_limit": hop_limit},
    )


def _simulate(pipe: Connection, hand: HandConfig, touched: int) -> None:
    """Run the nodes and send the counters on request until the parent closes its end of the pipe."""
    with Fleet(hand, scene=scene_of(touched)) as fleet, without_long_collections():
        while True:
            try:
                pipe.recv()
            except EOFError:
                return
            reports = fleet.report()
            pipe.send(
                _Counts(
                    time.process_time(),
                    sum(report.frames_sent for report in reports),
                    sum(report.scans_sent for report in reports),
                    sum(report.slow_overruns for report in reports),
                )
            )


def _counts(pipe: Connection) -> _Counts:
    pipe.send(None)
    counts: _Counts = pipe.recv()
    return counts


def _solved(host: Host) -> int:
    return sum(patch.solved for patch in host.stats().patches.values())


def frame_us() -> dict[str, float]:
    """Measure the time to exchange a frame between two endpoints that both receive it.

    Returns:
        Time per frame in µs: ``python_can`` with python-can, ``port`` with
        :class:`~skinnode.transport.CanPort`.
    """
    one, two = (_multicast_bus("can0", random.randrange(1 << 16), 0) for _ in range(2))
    with ExitStack() as opened:
        bus, other_bus = (opened.enter_context(open_can_bus(one)) for _ in range(2))
        port, other_port = (opened.enter_context(CanPort(two)) for _ in range(2))
        with CanPort(one) as third:
            third.send(0x185, bytes(range(8)))
            message, _ = bus.recv(1.0), other_bus.recv(1.0)
        assert message is not None

        def exchange_messages() -> None:
            for _ in range(_BURST):
                bus.send(message)
            for endpoint in (other_bus, bus):
                for _ in range(_BURST):
                    endpoint.recv(1.0)

        def exchange_frames() -> None:
            for _ in range(_BURST):
                port.send(0x185, bytes(message.data))
            received = 0
            while received < _BURST:
                received += len(other_port.recv_batch(1.0))
            port.recv_batch(0.0)

        timed = take_turns({"python_can": exchange_messages, "port": exchange_frames})
    return {name: timing.call_us / _BURST for name, timing in timed.items()}
