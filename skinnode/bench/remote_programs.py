"""Child processes of :mod:`skinnode.bench.remote`: a client, a ping sender and an echo server."""

from __future__ import annotations

import contextlib
import json
import queue
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, Final

from skinnode.process.garbage_collection import without_long_collections

if TYPE_CHECKING:
    import zenoh

PING_S: Final = 0.01
"""Interval between pings, in s."""
_LONGEST_S: Final = 10.0
"""Time after which a ping without an echo ends the benchmark, in s."""
_PING, _PONG = "skinnode-bench/ping", "skinnode-bench/pong"


def until_closed(program: Callable[..., None], *arguments: Any) -> None:
    """Run a function; exit quietly if the parent closes the pipe."""
    with contextlib.suppress(EOFError, OSError):
        program(*arguments)


def follow(pipe: Connection, hand: str, port: int) -> None:
    """Receive a hand's fields until the parent sends a message; then send the times and counters."""
    from skinnode.remote import connect

    times_ms: list[float] = []
    first: dict[str, int] = {}
    with without_long_collections(), connect(hand, port=port, timeout_s=60.0) as remote:
        fields = remote.fields(capacity=10_000)
        pipe.send("ready")
        delays_ms: list[float] = []
        while not pipe.poll():
            for _ in range(1000):
                field = fields.get(0.1)
                if field is None:
                    break
                now_ns = time.monotonic_ns()
                assert field.stamp is not None
                times_ms.append((now_ns - field.stamp.t_solved_ns) * 1e-6)
                counts = remote.stats().patches[field.stamp.patch]
                delays_ms.append(counts.delay_s * 1e3)
        for name, counts in remote.stats().patches.items():
            if counts.received:
                first[name] = counts.sequence - counts.received - counts.lost + 1
        counted = {
            name: (first[name], counts.received, counts.lost)
            for name, counts in remote.stats().patches.items()
            if counts.received
        }
    pipe.recv()
    pipe.send({"solved_to_program_ms": times_ms, "sent_to_program_ms": delays_ms, "counts": counted})


def ping(pipe: Connection, port: int, payload_bytes: int) -> None:
    """Ping every 10 ms, awaiting each echo, until the parent sends a message; then send the times."""
    import zenoh

    arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
    times_ms: list[float] = []
    data = bytes(payload_bytes)
    with _session({"connect/endpoints": [f"tcp/127.0.0.1:{port}"]}) as session, without_long_collections():
        session.declare_subscriber(_PONG, lambda sample: arrived.put(time.monotonic_ns()))
        publisher = session.declare_publisher(
            _PING, congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        while not _echoed(publisher, data, arrived):
            if pipe.poll():  # the parent has ended
                return
        pipe.send("ready")
        while not pipe.poll(PING_S):
            begin_ns = time.monotonic_ns()
            publisher.put(data)
            times_ms.append((arrived.get(timeout=_LONGEST_S) - begin_ns) * 1e-6)
    pipe.recv()
    pipe.send({"round_trip_ms": times_ms})


def pong(pipe: Connection, port: int) -> None:
    """Echo messages until the parent sends a message."""
    import zenoh

    with _session({"listen/endpoints": [f"tcp/127.0.0.1:{port}"]}) as session, without_long_collections():
        publisher = session.declare_publisher(
            _PONG, congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        session.declare_subscriber(_PING, lambda sample: publisher.put(sample.payload))
        pipe.send("ready")
        pipe.recv()
    pipe.send({})


def _echoed(publisher: zenoh.Publisher, data: bytes, arrived: queue.SimpleQueue[int]) -> bool:
    """Send a message; return whether it is echoed within 0.1 s."""
    publisher.put(data)
    try:
        arrived.get(timeout=0.1)
    except queue.Empty:
        return False
    return True


def _session(settings: dict[str, Any]) -> zenoh.Session:
    import zenoh

    config = zenoh.Config()
    fixed = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [],
        "connect/timeout_ms": -1,  # the echo server may start later
        "connect/exit_on_failure": False,
    }
    for key, value in {**fixed, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
