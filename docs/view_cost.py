"""Measure the cost of `skinnode view` for 16 patches on four CAN FD buses at 30 SYNCs per second.

    python docs/view_cost.py [SECONDS [TOUCHED]]

As in `skinnode bench pipeline`, a child process replays the frames of a hand over UDP. The first TOUCHED
patches are pressed and stroked: 4 by default. The script alternates between runs without a view and runs with
a view that writes to the browser's data server. The host runs on one core; the generator, the drawing and the
data server run on another. If permitted, the generator has real-time priority, because frames that it sends
late would look like a slow host.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench.load import LEAD_S, Generator
from skinnode.bench.pipeline import FieldReader, full_hand, settle
from skinnode.host import Host
from skinnode.monitor.live_source import HostSource
from skinnode.process.garbage_collection import responsive_threads, without_long_collections
from skinnode.transport.datagram import DatagramPort
from skinnode.view.drawing_process import DrawingOptions, DrawingProcess
from skinnode.view.drawing_thread import DrawingThread
from skinnode.view.outputs import OutputOptions, open_output
from skinnode.view.viewer_process import free_port

ROUNDS: Final = 5
PERIOD_MS: Final = 33


def cpu_s(name: str) -> float:
    """Return the total CPU time (s) of this process's threads with the given name."""
    ids = [thread.native_id for thread in threading.enumerate() if thread.name == name]
    texts = [Path(f"/proc/self/task/{number}/schedstat").read_text() for number in ids]
    return sum(int(text.split()[0]) * 1e-9 for text in texts)


def measure(hand: Any, generator: Generator, core: int, seconds: float, *, viewed: bool) -> dict[str, float]:
    generator.send_heartbeats([bus.name for bus in hand.buses])
    own = os.sched_getaffinity(0)
    with ExitStack() as stack:
        if viewed:
            os.sched_setaffinity(0, {core})  # inherited by the data server
            options = OutputOptions(window=False, web=True, save=None, port=free_port())
            output = stack.enter_context(open_output(options))
            how = DrawingOptions(10.0, time.time_ns() - time.monotonic_ns(), live=True)
            process = stack.enter_context(DrawingProcess(hand, output.target("cost"), how))
            os.sched_setaffinity(0, own)
        stack.enter_context(responsive_threads())
        host = stack.enter_context(Host.from_config(hand, open_port=DatagramPort))
        reader = stack.enter_context(FieldReader(host.fields()))
        source = stack.enter_context(HostSource(host))
        thread = None
        if viewed:
            thread = stack.enter_context(DrawingThread(source, process.draw))
        begin_ns = generator.begin()
        time.sleep(LEAD_S / 2)
        begun_s, process_s, drawing_s = time.monotonic(), time.process_time(), cpu_s("draw")
        generator.wait()
        wall_s = time.monotonic() - begun_s
        process_s, drawing_s = time.process_time() - process_s, cpu_s("draw") - drawing_s
        settle(host)
        streams = list(host.stats().patches.values())
        published_ms, _ = reader.since(begin_ns)
        counts = None if thread is None else thread.counts
    return {
        "fields": sum(stream.solved for stream in streams),
        "skipped": sum(stream.skipped for stream in streams),
        "chunks lost": sum(stream.assembler.chunks_lost for stream in streams),
        "p50": float(np.percentile(published_ms, 50)),
        "p99": float(np.percentile(published_ms, 99)),
        "process": process_s / wall_s,
        "thread": drawing_s / wall_s,
        "drawn_hz": 0.0 if counts is None else counts.drawn / seconds / len(streams),
        "dropped": 0 if counts is None else counts.dropped,
    }


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    touched = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[:1])
    rows: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    print(f"load average {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        hand = full_hand(4, True, 3.0, "udp", "", Path(folder), one_worker=True)
        hand = hand.model_copy(update={"sync": hand.sync.model_copy(update={"period_ms": PERIOD_MS})})
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        with (
            closing(Generator(hand, seconds, touched=touched, core=cores[-1])) as generator,
            without_long_collections(),
        ):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            for number in range(2 * ROUNDS):
                viewed = bool(number % 2)
                row = measure(hand, generator, cores[-1], seconds, viewed=viewed)
                rows[viewed].append(row)
                values = "  ".join(f"{name} {value:.4g}" for name, value in row.items())
                print(f"{'with' if viewed else 'without'} view: {values}", flush=True)
    for name in ("skipped", "p50", "p99", "process", "thread", "drawn_hz"):
        without, with_ = (statistics.median(row[name] for row in rows[viewed]) for viewed in (False, True))
        print(f"median {name}: {without:.4g} without, {with_:.4g} with")


if __name__ == "__main__":
    main()
