"""Measures the size, write cost and seek time of recordings from fully loaded buses.

The frames come from simulated nodes and have exact times; a replay computes the fields from the frames. A
block of a few seconds is written repeatedly, with increasing times, until the recording has the requested
length.
"""

from __future__ import annotations

import heapq
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench.load import stream_of
from skinnode.bench.pipeline import full_hand
from skinnode.bench.timing import machine
from skinnode.config import HandConfig
from skinnode.messages.topics import HandTopics
from skinnode.model.frames import FieldFrame
from skinnode.record.journal import SUFFIX, Header
from skinnode.record.log_files import LogFiles
from skinnode.record.mcap_file import McapFile
from skinnode.record.open_recording import open_log
from skinnode.record.recorder import FLUSH_S
from skinnode.record.replay import Replay
from skinnode.transport.frame import Frame
from skinnode.transport.socketcan import HEADER

FORMATS: Final = ((".mcap", True), (".mcap", False), (".log", False), (".blf", False))
"""Formats as pairs: suffix, and whether the recording contains fields."""
SEEKS: Final = 20
HOUR_S: Final = 3600.0

_BEGIN_NS: Final = 1_790_000_000_000_000_000
"""Arbitrary Unix time of the first frame, in ns."""


@dataclass(frozen=True, slots=True)
class Block:
    """A few seconds of traffic."""

    hand: HandConfig
    seconds: float
    frames: list[tuple[str, Frame]]
    """Pairs of bus name and frame, in chronological order; ``t_ns`` counts from the start of the block."""
    fields: list[FieldFrame]


def run(
    buses: int, minutes: float, seconds: float, report: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Write a recording in each format, and measure seeking in the MCAP file.

    Args:
        buses: Number of fully loaded buses with four patches each.
        minutes: Duration of each recording, in minutes.
        seconds: Duration of the block of simulated traffic, in s.
        report: Function that receives each format's results as soon as they are complete.

    Returns:
        Results for each format and for seeking.
    """
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        block = block_of(buses, seconds, folder)
        blocks = max(1, round(60 * minutes / seconds))
        seek = {}
        for suffix, fields in FORMATS:
            path = folder / f"run{suffix}"
            rows.append(_write(block, blocks, path, with_fields=fields))
            report(rows[-1])
            if fields:
                seek = seek_times(path, HandTopics.of(block.hand).patches["p0"].field)
            path.unlink()
            path.with_suffix(SUFFIX).unlink(missing_ok=True)
    rates = {
        "frames_hz": len(block.frames) / seconds,
        "fields_hz": len(block.fields) / seconds,
        "minutes": blocks * seconds / 60,
    }
    return {"machine": machine(), "rates": rates, "rows": rows, "seek": seek}


def block_of(buses: int, seconds: float, folder: Path) -> Block:
    """Simulate traffic and solve its scans."""
    hand = full_hand(buses, False, 0.0, "udp", "", folder, one_worker=True)
    streams = [_frames(hand, bus.name, seconds) for bus in hand.buses]
    frames = list(heapq.merge(*streams, key=lambda item: item[1].t_ns))
    path = folder / "block.mcap"
    file = McapFile(path, hand)
    for bus, frame in frames:
        later = frame._replace(t_ns=frame.t_ns + _BEGIN_NS)
        file.write(bus, later, sent=False, log_ns=later.t_ns)
    file.close()
    fields = list(Replay(open_log(path, hand)))
    path.unlink()
    return Block(hand, seconds, frames, fields)


def _frames(hand: HandConfig, bus: str, seconds: float) -> Iterator[tuple[str, Frame]]:
    stream = stream_of(hand, hand.bus(bus), seconds)
    for t_ns, packet in zip(stream.t_ns, stream.packets, strict=True):
        can_id, length, _ = HEADER.unpack_from(packet)
        yield bus, Frame(can_id, packet[HEADER.size : HEADER.size + length], t_ns)


def _write(block: Block, blocks: int, path: Path, *, with_fields: bool) -> dict[str, Any]:
    """Write a recording; measure the CPU time for frames, fields and flushes separately."""
    file = McapFile(path, block.hand) if path.suffix == ".mcap" else LogFiles(path, block.hand)
    file.write_line(Header(block.hand, "", 0).line(), _BEGIN_NS)
    steps = _steps(block)
    spent = {"frames": 0.0, "fields": 0.0, "flush": 0.0}
    now_s = time.thread_time
    for number in range(blocks):
        offset_ns = _BEGIN_NS + round(number * block.seconds * 1e9)
        later_ns = offset_ns - _BEGIN_NS
        rest_m = block.hand.patches[0].layout.build().upper_m
        for frames, fields in steps:
            shifted = [(bus, frame._replace(t_ns=frame.t_ns + offset_ns)) for bus, frame in frames]
            begin_s = now_s()
            for bus, frame in shifted:
                file.write(bus, frame, sent=False, log_ns=frame.t_ns)
            middle_s = now_s()
            if with_fields and isinstance(file, McapFile):
                for field in fields:
                    assert field.stamp is not None
                    file.write_field(field, rest_m, later_ns, field.stamp.t_receive_ns + later_ns)
            flush_s = now_s()
            file.flush(to_disk=False)
            end_s = now_s()
            spent["frames"] += middle_s - begin_s
            spent["fields"] += flush_s - middle_s
            spent["flush"] += end_s - flush_s
    begin_s = now_s()
    file.close()
    close_s = now_s() - begin_s
    size = path.stat().st_size
    duration_s = blocks * block.seconds
    fields_written = len(block.fields) * blocks if with_fields else 0
    return {
        "format": f"{path.suffix}{' with fields' if with_fields else ''}",
        "gb_per_hour": size * HOUR_S / duration_s / 1e9,
        "frame_us": 1e6 * spent["frames"] / (len(block.frames) * blocks),
        "field_us": 1e6 * spent["fields"] / fields_written if fields_written else None,
        "flush_ms": 1e3 * spent["flush"] / (len(steps) * blocks),
        "close_s": close_s,
        "core": sum(spent.values()) / duration_s,
    }


def _steps(block: Block) -> list[tuple[list[tuple[str, Frame]], list[FieldFrame]]]:
    """Divide a block into groups of frames and fields, one group per flush."""
    count = round(block.seconds / FLUSH_S)
    steps: list[tuple[list[tuple[str, Frame]], list[FieldFrame]]] = [([], []) for _ in range(count)]

    def step(t_ns: int) -> int:
        return min(count - 1, int(t_ns * 1e-9 / FLUSH_S))

    for item in block.frames:
        steps[step(item[1].t_ns)][0].append(item)
    for field in block.fields:
        assert field.stamp is not None
        steps[step(field.stamp.t_receive_ns - _BEGIN_NS)][1].append(field)
    return steps


def seek_times(path: Path, topic: str) -> dict[str, float]:
    """Measure how long mcap's reader takes to open a file and to find the first message after a random time.

    Args:
        path: The file.
        topic: Topic of the messages.
    """
    from mcap.reader import make_reader

    with path.open("rb") as file:
        begin_s = time.perf_counter()
        reader = make_reader(file)
        summary = reader.get_summary()
        open_s = time.perf_counter() - begin_s
        assert summary is not None
        assert summary.statistics is not None
        first_ns, last_ns = summary.statistics.message_start_time, summary.statistics.message_end_time
        spent_s = []
        for share in np.random.default_rng(1).uniform(0.0, 0.99, SEEKS):
            begin_s = time.perf_counter()
            at_ns = first_ns + int(share * (last_ns - first_ns))
            next(reader.iter_messages([topic], starting_at=at_ns))
            spent_s.append(time.perf_counter() - begin_s)
    return {
        "chunks": len(summary.chunk_indexes),
        "open_s": open_s,
        "seek_ms": 1e3 * float(np.median(spent_s)),
        "seek_max_ms": 1e3 * max(spent_s),
    }
