"""Measure the cost of `skinnode view` for 16 patches on four CAN FD buses at 30 SYNCs per second.

    python docs/view_cost.py [SECONDS [TOUCHED [ROUNDS]]]

As in `skinnode bench pipeline`, a child process replays the frames of a hand over UDP. The first TOUCHED
patches are pressed and stroked: 4 by default. The script alternates between runs without a view, runs with a
view that writes to the browser's data server, and runs beside an unrelated program. The unrelated program
takes as much CPU time on the other core as the drawing and the data server, so a difference between the last
two kinds of run is due to the view rather than to a computer whose cores slow each other down. The host runs
on one core; the generator, the drawing and the data server run on another. If permitted, the generator has
real-time priority, because frames that it sends late would look like a slow host.

A round is one run of each kind, 5 rounds by default. The end of the output gives the mean difference between
the runs with and without the view over the rounds, with its 95 % confidence interval.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit

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

PERIOD_MS: Final = 33
KINDS: Final = ("without view", "with view", "beside another program")
_OTHER: Final = """
import os, sys, time
import numpy as np

os.nice(10)
data = np.zeros(4000)
while True:
    end = time.process_time() + float(sys.argv[1]) * 0.033
    while time.process_time() < end:
        str(np.sin(data).tolist())
    time.sleep(0.033 * (1.0 - float(sys.argv[1])))
"""
"""Program that occupies the given share of a core, in a burst for each drawn frame."""


def cpu_s(name: str) -> float:
    """Return the total CPU time (s) of this process's threads with the given name."""
    ids = [thread.native_id for thread in threading.enumerate() if thread.name == name]
    texts = [Path(f"/proc/self/task/{number}/schedstat").read_text() for number in ids]
    return sum(int(text.split()[0]) * 1e-9 for text in texts)


def children_cpu_s(process: int | str = "self") -> float:
    """Return the CPU time (s) of the running child processes and of their child processes."""
    total = 0.0
    with suppress(FileNotFoundError):
        for task in Path(f"/proc/{process}/task").iterdir():
            for child in (task / "children").read_text().split():
                values = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
                total += (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")
                total += children_cpu_s(child)
    return total


@contextmanager
def other_program(share: float, core: int) -> Iterator[None]:
    """Run a program that occupies the given share of the core."""
    with subprocess.Popen([sys.executable, "-c", _OTHER, str(share)]) as program:
        os.sched_setaffinity(program.pid, {core})
        time.sleep(1.0)
        try:
            yield
        finally:
            program.kill()


def measure(
    hand: Any, generator: Generator, core: int, seconds: float, *, viewed: bool, other: float
) -> dict[str, float]:
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
        if other:
            stack.enter_context(other_program(other, core))
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
        children_s = children_cpu_s()
        generator.wait()
        wall_s = time.monotonic() - begun_s
        children_s = children_cpu_s() - children_s
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
        "children": children_s / wall_s,
        "drawn_hz": 0.0 if counts is None else counts.drawn / seconds / len(streams),
        "dropped": 0 if counts is None else counts.dropped,
    }


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    touched = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    rounds = int(sys.argv[3]) if len(sys.argv) > 3 else 5
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[:1])
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
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
            for number in range(rounds):
                for kind in KINDS if number % 2 == 0 else (*KINDS[1::-1], KINDS[2]):
                    other = share(rows) if kind == KINDS[2] else 0.0
                    row = measure(hand, generator, cores[-1], seconds, viewed=kind == KINDS[1], other=other)
                    rows[kind].append(row)
                    values = "  ".join(f"{name} {value:.4g}" for name, value in row.items())
                    print(f"{kind}: {values}", flush=True)
    for name in ("skipped", "p50", "p99", "process", "thread", "children", "drawn_hz"):
        medians = (statistics.median(row[name] for row in rows[kind]) for kind in KINDS)
        texts = [f"{value:.4g} {kind}" for value, kind in zip(medians, KINDS, strict=True)]
        print(f"median {name}:", ", ".join(texts))
    for name in ("skipped", "p50", "p99"):
        for kind in (KINDS[0], KINDS[2]):
            print(f"{name} with view - {kind}: {difference(rows, name, kind)}")


def share(rows: dict[str, list[dict[str, float]]]) -> float:
    """Return the median share of a core that the drawing and the data server took so far."""
    without, with_ = (statistics.median(row["children"] for row in rows[kind]) for kind in KINDS[:2])
    return max(0.01, with_ - without)


def difference(rows: dict[str, list[dict[str, float]]], name: str, kind: str) -> str:
    """Return the mean difference to the runs of a kind and its 95 % confidence interval (Student's t)."""
    pairs = zip(rows[KINDS[1]], rows[kind], strict=True)
    values = np.array([with_view[name] - other[name] for with_view, other in pairs])
    if values.size < 2:
        return f"{values.mean():.3g}"
    half = stdtrit(values.size - 1, 0.975) * values.std(ddof=1) / np.sqrt(values.size)
    return f"{values.mean():.3g} ({values.mean() - half:.3g} to {values.mean() + half:.3g})"


if __name__ == "__main__":
    main()
