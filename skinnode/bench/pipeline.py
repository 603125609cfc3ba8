"""Measures the throughput, latency and CPU time of a host, for hands with different numbers of buses.

The host is a guest on its buses. A child process replays the frames of the robot's master and of the nodes
(:mod:`skinnode.bench.load`), over a CAN interface or over UDP. The SocketCAN receiver also receives the UDP
frames (see :mod:`skinnode.transport.datagram`).
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from skinnode.bench.load import LEAD_S, Generator
from skinnode.bench.timing import machine
from skinnode.config import HandConfig, LayoutConfig, parse_hand
from skinnode.host import Host, Subscription
from skinnode.host.accounting import discrepancies
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import ScanStamp
from skinnode.process.garbage_collection import without_long_collections
from skinnode.transport import CanPort
from skinnode.transport.datagram import DatagramPort, free_channel

PATCHES_A_BUS: Final = 4
CLASSIC_MS: Final = 50
"""SYNC period with classic CAN, in ms. Four patches send 101 frames each per period, 8,080 frames/s in
all."""
FD_MS: Final = 25
STAGGER_MS: Final = 3.0
"""Offset between the SYNCs of successive buses in staggered scenes, in ms. The offset lets the host solve the
four patches of one bus before the scans of the next bus are complete."""
SCENES: Final = (
    (False, True, 0.0),
    (False, True, STAGGER_MS),
    (False, False, 0.0),
    (True, True, 0.0),
    (True, True, STAGGER_MS),
    (True, False, 0.0),
)
"""Scenes as triples: whether CAN FD is used, whether the patches are touched, and the offset between SYNCs in
ms."""
DEADLINE_US: Final = 1000
"""Deadline for solving a scan, in µs. For comparison, an exact inverse takes 200 µs, and its verification by
the posterior 13 ms."""
RECEIVE_US: Final = 5.0
LATENCY_MS: Final = 5.0
SETTLE_S: Final = 5.0

Row = dict[str, Any]
_GROUPS: Final = ("receive", "mainline", "solve", "subscriber")


def run(  # noqa: PLR0913 - the options of the command
    seconds: float,
    *,
    short: bool,
    interface: str,
    channel: str,
    all_cores: bool,
    report: Callable[[Row], None],
) -> dict[str, Any]:
    """Measure all hands.

    Args:
        seconds: Duration of each measurement.
        short: Whether to measure only the rows that have a requirement.
        interface: ``udp`` or ``socketcan``.
        channel: Channel of the ``socketcan`` interface.
        all_cores: Whether the host and the load generator may use all cores; if False, each is bound to its
            own core.
        report: Function that receives each row as soon as it is complete.

    Returns:
        The rows and the requirements.

    Raises:
        BusError: if a bus fails.
    """
    fullest = 1 if interface == "socketcan" else 4
    cores = sorted(os.sched_getaffinity(0))
    apart = len(cores) > 1 and not all_cores
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        if apart:
            stack.callback(os.sched_setaffinity, 0, cores)
            os.sched_setaffinity(0, cores[:1])
        for fd, touched, stagger_ms in SCENES:
            if (short and not touched) or ((fd or stagger_ms) and interface == "socketcan"):
                continue
            hand = full_hand(fullest, fd, stagger_ms, interface, channel, Path(folder), one_worker=apart)
            plain = touched and not (fd or short or stagger_ms)
            fewer = [buses for buses in (1, 2) if buses < fullest and plain]
            core = cores[-1] if apart else None
            with (
                closing(Generator(hand, seconds, touched=None if touched else 0, core=core)) as generator,
                without_long_collections(),
            ):
                for buses in (*fewer, fullest):
                    rows.append(_measure(_part(hand, buses), generator) | {"touched": touched})
                    report(rows[-1])
    road = "a CAN interface" if interface == "socketcan" else "UDP"
    where = "host restricted to one core" if apart else "host on all cores"
    return {"machine": machine() | {"road": road, "": where}, "rows": rows, "must": _must(rows)}


def full_hand(  # noqa: PLR0913 - the properties in which hands differ
    buses: int,
    fd: bool,
    stagger_ms: float,
    interface: str,
    channel: str,
    folder: Path,
    *,
    one_worker: bool,
) -> HandConfig:
    """Return a hand whose buses are fully loaded with four patches each.

    Args:
        buses: Number of buses.
        fd: Whether the patches send CAN FD frames.
        stagger_ms: Offset between the SYNCs of successive buses, in ms.
        interface: ``udp`` or ``socketcan``.
        channel: Channel of the ``socketcan`` interface.
        folder: Folder for the baseline file.
        one_worker: Whether the host solves with one thread.
    """
    listed = [
        {
            "name": f"can{i}",
            "interface": interface,
            "channel": channel if interface == "socketcan" else free_channel(),
            "role": "guest",
            "fd": fd,
        }
        for i in range(buses)
    ]
    layout = LayoutConfig().build()
    baseline = folder / "baseline.txt"
    np.savetxt(baseline, resistance_ohm(layout, layout.upper_m))
    hand = parse_hand(
        {
            "buses": listed,
            "patches": [
                {
                    "name": f"p{i}",
                    "bus": f"can{i // PATCHES_A_BUS}",
                    "node_id": 1 + i % PATCHES_A_BUS,
                    "baseline": str(baseline),
                    "tolerances": "exact",
                }
                for i in range(buses * PATCHES_A_BUS)
            ],
            "sync": {"period_ms": FD_MS if fd else CLASSIC_MS, "stagger_ms": stagger_ms},
            "solver": {"deadline_us": DEADLINE_US} | ({"workers": 1} if one_worker else {}),
            "stream": {"capacity_fields": 100_000},
        }
    )
    # model_copy skips validation, which assumes frames of maximum length and would reject this bus load.
    full = tuple(bus.model_copy(update={"max_load": 2.0}) for bus in hand.buses)
    return hand.model_copy(update={"buses": full})


def _part(hand: HandConfig, buses: int) -> HandConfig:
    """Return a copy of the hand that contains only its first ``buses`` buses."""
    kept = hand.buses[:buses]
    patches = tuple(patch for patch in hand.patches if patch.bus in {bus.name for bus in kept})
    return hand.model_copy(update={"buses": kept, "patches": patches})


def _measure(hand: HandConfig, generator: Generator) -> Row:
    names = [bus.name for bus in hand.buses]
    open_port = CanPort if hand.buses[0].interface == "socketcan" else DatagramPort
    generator.send_heartbeats(names)
    with Host.from_config(hand, open_port=open_port) as host, FieldReader(host.fields()) as reader:
        begin_ns = generator.begin()
        time.sleep(LEAD_S / 2)  # wait for the last heartbeats before the replay
        read_before = _read(host)
        before, begin_s = _cpu_s(), time.monotonic()
        sent = generator.wait()
        settle(host)
        wall_s = time.monotonic() - begin_s
        cpu_s = {group: used - before.get(group, 0.0) for group, used in _cpu_s().items()}
        stats, read = host.stats(), _read(host) - read_before
    published_ms, read_ms = reader.since(begin_ns)
    streams, buses = list(stats.patches.values()), list(stats.buses.values())
    scans = sum(stream.offered + stream.withheld + stream.partial for stream in streams)
    seconds = hand.sync.period_s * scans / len(streams)
    return {
        "buses": len(buses),
        "patches": len(streams),
        "fd": hand.buses[0].fd,
        "stagger_ms": hand.sync.stagger_ms,
        "frames_hz": read / seconds,
        "bus_load": max(sent.bus_load.values()),
        "sent": sum(sent.frames.values()),
        "received": read,
        "kernel_dropped": sum(bus.kernel_dropped for bus in buses),
        "queue_dropped": sum(bus.dropped for bus in buses),
        "chunks_lost": sum(stream.assembler.chunks_lost for stream in streams),
        "scans": scans,
        "scans_hz": scans / seconds,
        "scans_torn": sum(stream.assembler.scans_torn for stream in streams),
        "scans_missed": sum(stream.assembler.scans_missed for stream in streams),
        "scans_skipped": sum(stream.skipped for stream in streams),
        "fields": sum(stream.solved for stream in streams),
        "fields_read": len(read_ms),
        "untrusted": sum(stream.untrusted for stream in streams),
        "published_ms": _spread(published_ms),
        "read_ms": _spread(read_ms),
        "receive_us": 1e6 * (cpu_s["receive"] + cpu_s["mainline"]) / max(1, read),
        "cpu": {group: used / wall_s for group, used in cpu_s.items()} | {"generator": sent.cpu_s / wall_s},
        "generator_late_p99_ms": sent.late_p99_ms,
        "generator_late_max_ms": sent.late_max_ms,
        "discrepancies": discrepancies(stats),
    }


def _spread(late_ms: list[float]) -> dict[str, float | None]:
    values = np.percentile(late_ms, (50, 99, 100)).tolist() if late_ms else [None] * 3
    return dict(zip(("p50", "p99", "max"), values, strict=True))


def lost(row: Row) -> int:
    """Return the number of frames, chunks and scans lost between the generator and the solver."""
    frames = row["sent"] - row["received"] + row["queue_dropped"]
    return int(frames + row["chunks_lost"] + row["scans_missed"] + row["scans"] - row["fields"])


def hand_name(row: Row) -> str:
    """Return a short description of a row's hand."""
    kind = "CAN FD" if row["fd"] else "classic"
    scene = "touched" if row["touched"] else "at rest"
    apart = f", {row['stagger_ms']:g} ms apart" if row["stagger_ms"] else ""
    return f"{kind}, {row['buses']} x {row['patches'] // row['buses']}, {scene}{apart}"


def _must(rows: list[Row]) -> list[Row]:
    """Check the requirements for each hand with at least four buses and touched patches."""
    must = []
    for row in rows:
        if row["buses"] < 4 or not row["touched"]:
            continue
        asked = [("lost", lost(row), 0.0), ("latency p99, ms", row["published_ms"]["p99"], LATENCY_MS)]
        if not row["fd"]:
            asked.append(("received to assembled, µs per frame", row["receive_us"], RECEIVE_US))
        for what, got, most in asked:
            reached = got is not None and got <= most
            said = f"{hand_name(row)}: {what}"
            must.append({"what": said, "got": got, "asked": most, "reached": reached, "time": what != "lost"})
    return must


class FieldReader:
    """Subscriber that records the arrival time of each field."""

    def __init__(self, fields: Subscription) -> None:
        self._stamps: list[tuple[ScanStamp, int]] = []
        self._fields = fields
        self._thread = threading.Thread(target=self._run, name="subscriber", daemon=True)

    def since(self, begin_ns: int) -> tuple[list[float], list[float]]:
        """Return the publication and delivery latencies (ms) of all scans that end after ``begin_ns``."""
        stamps = [(stamp, read_ns) for stamp, read_ns in self._stamps if stamp.t_receive_ns >= begin_ns]
        published = [(stamp.t_solved_ns - stamp.t_receive_ns) * 1e-6 for stamp, _ in stamps]
        return published, [(read_ns - stamp.t_receive_ns) * 1e-6 for stamp, read_ns in stamps]

    def _run(self) -> None:
        for field in self._fields:
            assert field.stamp is not None
            self._stamps.append((field.stamp, time.monotonic_ns()))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._fields.close()


def _read(host: Host) -> int:
    return sum(bus.read for bus in host.stats().buses.values())


def settle(host: Host) -> None:
    """Wait until the host's counters stop changing."""
    end_s, last = time.monotonic() + SETTLE_S, None
    while time.monotonic() < end_s:
        stats = host.stats()
        now = (
            [bus.read for bus in stats.buses.values()],
            [stream.solved for stream in stats.patches.values()],
        )
        if now == last:
            return
        last = now
        time.sleep(0.3)


def _cpu_s() -> dict[str, float]:
    """Return the CPU time of each thread group in this process, in seconds."""
    used: dict[str, float] = defaultdict(float)
    names = {thread.native_id: thread.name.split()[0] for thread in threading.enumerate()}
    for task in os.listdir("/proc/self/task"):
        group = names.get(int(task), "other")
        try:
            text = Path(f"/proc/self/task/{task}/schedstat").read_text()
        except OSError:  # the thread has ended
            continue
        used[group if group in _GROUPS else "other"] += int(text.split()[0]) * 1e-9
    return used


HEAD: Final = (
    f"{'':39}{'frames/s':>9}{'load':>6}{'sent':>9}{'received':>9}{'lost':>6}{'scans/s':>8}{'skipped':>8}"
    f"{'published, ms':>20}{'read, ms':>14}{'µs':>6}{'receive':>9}{'mainline':>9}{'solve':>7}{'load':>6}"
    f"\n{'':94}{'p50   p99   max':>20}{'p50   p99':>14}{'frame':>6}{'fraction of a core':>24}"
)
LEGEND: Final = (
    "lost: total number of lost frames, chunks and scans. published: time from the kernel timestamp of a\n"
    "scan's last frame to the publication of the field. read: time from that timestamp to the delivery of\n"
    "the field. µs: CPU time per frame in the receive and mainline threads, including wake-ups. load: bus\n"
    "load (left) and the load generator's CPU load (right). The scans of all patches end at the same time,\n"
    "unless the SYNCs of the buses are staggered."
)


def line(row: Row) -> str:
    """Format a row as one line of text."""

    def ms(spread: dict[str, float | None], *names: str) -> str:
        return "".join("     -" if spread[name] is None else f"{spread[name]:6.1f}" for name in names)

    cpu = row["cpu"]
    return (
        f"{hand_name(row):39}{row['frames_hz']:9.0f}{row['bus_load']:6.0%}{row['sent']:9}{row['received']:9}"
        f"{lost(row):6}{row['scans_hz']:8.0f}{row['scans_skipped']:8}"
        f"  {ms(row['published_ms'], 'p50', 'p99', 'max')}  {ms(row['read_ms'], 'p50', 'p99')}"
        f"{row['receive_us']:6.1f}{cpu['receive']:9.0%}{cpu['mainline']:9.0%}{cpu['solve']:7.0%}"
        f"{cpu['generator']:6.0%}"
    )
