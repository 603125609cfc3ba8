"""Measures the latency of fields sent to a second process over Zenoh, and of bare Zenoh pings of equal size.

As in :mod:`skinnode.bench.pipeline`, the host has sixteen patches on four CAN FD buses, and a child process
replays their frames. A second process connects to the hand. At the same time, two more processes exchange
field-sized messages over Zenoh alone, without any skinnode code between sender and receiver.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench.load import LEAD_S, Generator
from skinnode.bench.pipeline import STAGGER_MS, full_hand
from skinnode.bench.remote_programs import follow, ping, pong, until_closed
from skinnode.bench.timing import machine
from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.messages.full_field import SendStamp, encode_field
from skinnode.process.child_processes import starting_children
from skinnode.process.garbage_collection import responsive_threads, without_long_collections
from skinnode.remote import Publication, SessionOptions
from skinnode.remote.claim import Claim
from skinnode.transport.datagram import DatagramPort

BUSES: Final = 4
ROUND_S: Final = 60.0
"""Duration of a round, in s; the replayed frames of a round are held in memory."""
TIMES_A_PING: Final = 3.0
"""Maximum ratio of the fields' p99 latency to the pings' p99 latency."""
PORT: Final = 17647
"""First port used by the benchmark, chosen to avoid those of other daemons on the machine."""
PING_PORT: Final = PORT + 16
_SETTLE_S: Final = 1.0

Row = dict[str, Any]


def run(seconds: float, *, publish_only: bool, report: Callable[[Row], None]) -> dict[str, Any]:
    """Measure latencies in rounds of up to one minute.

    Args:
        seconds: Total duration, in s.
        publish_only: Measure only the host, without a second process and without pings.
        report: Function called with the results of each round.

    Returns:
        The rounds, their totals and the requirements.
    """
    rounds = max(1, round(seconds / ROUND_S))
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        hand = full_hand(BUSES, True, STAGGER_MS, "udp", "", Path(folder), one_worker=False)
        with closing(Generator(hand, seconds / rounds, touched=None, core=None)) as generator:
            for _ in range(rounds):
                rows.append(_measure(hand, generator, connected=not publish_only))
                report(rows[-1])
    total = _total(rows)
    return {"machine": machine(), "rows": rows, "total": total, "must": [] if publish_only else _must(total)}


def _measure(hand: HandConfig, generator: Generator, *, connected: bool) -> Row:
    generator.send_heartbeats([bus.name for bus in hand.buses])
    with contextlib.ExitStack() as stack:
        stack.enter_context(without_long_collections())
        stack.enter_context(responsive_threads())
        host = stack.enter_context(Host.from_config(hand, open_port=DatagramPort))
        # programs parse the hand as a hand file, which permits a bus load of at most 1
        buses = tuple(bus.model_copy(update={"max_load": 1.0}) for bus in hand.buses)
        host.hand = hand.model_copy(update={"buses": buses})
        claim = stack.enter_context(Claim(hand, SessionOptions(port=PORT)))
        publication = stack.enter_context(Publication(host, claim))
        program = stack.enter_context(_child(follow, hand.name, PORT)) if connected else None
        echo = stack.enter_context(_child(pong, PING_PORT)) if connected else None
        pinger = stack.enter_context(_child(ping, PING_PORT, _payload_bytes(hand))) if connected else None
        for child in (program, echo, pinger):
            if child is not None:
                _received(child)  # ready
        generator.begin()
        time.sleep(LEAD_S / 2)
        begin_s, cpu_s = time.monotonic(), time.process_time()
        generator.wait()
        wall_s, cpu_s = time.monotonic() - begin_s, time.process_time() - cpu_s
        time.sleep(_SETTLE_S)  # wait for the last fields
        followed = _answer(program)
        pings = _answer(pinger)
        _answer(echo)
        sent, streams = publication.stats(), host.stats().patches.values()
    return {
        "seconds": wall_s,
        "host_cpu": cpu_s / wall_s,
        "solved": sum(stream.solved for stream in streams),
        "skipped": sum(stream.skipped for stream in streams),
        "sent": sum(sent.published.values()),
        "daemon_dropped": sent.dropped,
        **_unaccounted(sent.published, followed),
        "solved_to_program_ms": followed.get("solved_to_program_ms", []),
        "sent_to_program_ms": followed.get("sent_to_program_ms", []),
        "ping_ms": pings.get("round_trip_ms", []),
        "load": os.getloadavg()[0],
    }


def _unaccounted(published: dict[str, int], followed: Row) -> Row:
    """Compare the sequence numbers at both ends.

    Returns:
        ``received``, ``lost`` (gaps found by the program) and ``unaccounted``: fields that the daemon has
        sent since the program's first field from the patch, but that the program neither received nor counted
        as lost.
    """
    counts = followed.get("counts", {})
    unaccounted = sum(
        published[name] - (first - 1) - received - lost for name, (first, received, lost) in counts.items()
    )
    return {
        "received": sum(received for _, received, _ in counts.values()),
        "lost": sum(lost for _, _, lost in counts.values()),
        "unaccounted": unaccounted,
    }


def _total(rows: list[Row]) -> Row:
    """Return the sums of the counters and the percentiles of all times."""
    sums = {
        key: sum(row[key] for row in rows)
        for key in (
            "seconds",
            "solved",
            "skipped",
            "sent",
            "daemon_dropped",
            "received",
            "lost",
            "unaccounted",
        )
    }
    times = {key: spread(rows, key) for key in ("solved_to_program_ms", "sent_to_program_ms", "ping_ms")}
    for row in rows:
        for key in times:
            row[key] = spread([row], key)
    return sums | times | {"host_cpu": float(np.mean([row["host_cpu"] for row in rows]))}


def spread(rows: list[Row], key: str) -> dict[str, float]:
    """Return p50, p99 and the maximum of the times stored under ``key`` in the rows."""
    values = np.concatenate([row[key] for row in rows])
    if not len(values):
        return {}
    p50, p99, most = np.percentile(values, (50, 99, 100)).tolist()
    return {"p50": p50, "p99": p99, "max": most}


def _must(total: Row) -> list[Row]:
    ratio = total["solved_to_program_ms"]["p99"] / total["ping_ms"]["p99"]
    lost = total["lost"] + total["unaccounted"] + total["daemon_dropped"]
    asked = [
        ("fields lost, according to the sequence numbers at both ends", lost, 0.0, False),
        ("p99 of solved to received by the program, relative to a ping", ratio, TIMES_A_PING, True),
    ]
    return [
        {"what": what, "got": got, "asked": most, "reached": got <= most, "time": time}
        for what, got, most, time in asked
    ]


def _payload_bytes(hand: HandConfig) -> int:
    """Return the size of the first patch's encoded field, in bytes."""
    from skinnode.solve.tracker import Tracker

    layout = hand.patches[0].layout.build()
    from skinnode.model.forward import resistance_ohm
    from skinnode.model.frames import ScanStamp, amended

    field = Tracker(layout).update(resistance_ohm(layout, layout.upper_m))
    stamped = amended(field, stamp=ScanStamp(hand.patches[0].name, 1, 1, 0, 1, 1, 1))
    return len(encode_field(stamped, SendStamp(1, 1, 1, 0)))


@contextlib.contextmanager
def _child(program: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    """Run a function in another process, connected by a pipe; the process ends when the pipe is closed."""
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe()
    process = context.Process(target=until_closed, args=(program, theirs, *arguments), daemon=True)
    with starting_children():
        process.start()
    theirs.close()
    try:
        yield pipe
    finally:
        pipe.close()
        process.join()


def _answer(pipe: Connection | None) -> Row:
    if pipe is None:
        return {}
    with contextlib.suppress(OSError):
        pipe.send("end")
    answer: Row = _received(pipe)
    return answer


def _received(pipe: Connection) -> Any:
    """Return the next message from a child process. Raises SkinError if the process has ended."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        raise SkinError("a benchmark process ended unexpectedly; see its message above") from None


def line(row: Row) -> str:
    """Format the results of one round, or of all rounds, as a few lines of text."""
    text = (
        f"{row['seconds']:.0f} s: {row['solved']} fields solved, {row['skipped']} scans skipped, "
        f"{row['sent']} sent, {row['received']} received, {row['lost']} lost, "
        f"{row['unaccounted']} unaccounted, {row['daemon_dropped']} dropped by the daemon; "
        f"host {row['host_cpu']:.0%} of a core"
    )
    names = {
        "solved_to_program_ms": "solved to received by the program",
        "sent_to_program_ms": "sent to received by the program",
        "ping_ms": "bare ping, round trip",
    }
    for key, name in names.items():
        times = row[key]
        if times:
            text += (
                f"\n  {name:36} p50 {times['p50']:7.2f}  p99 {times['p99']:7.2f}  max {times['max']:8.2f} ms"
            )
    return text
