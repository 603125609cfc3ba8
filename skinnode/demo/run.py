"""Runs ``skinnode demo``: simulates patches, solves their scans and compares the fields with the truth."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table

from skinnode.bench.score import EXCESS_LIMIT, Score, Scorer
from skinnode.compiled import jit
from skinnode.config import HandConfig, PatchConfig
from skinnode.demo.plot import PatchTrace
from skinnode.demo.view import BusView, PatchView, panels_in, render
from skinnode.host import Host
from skinnode.host.patch_stream import StreamStats
from skinnode.model.distrust_text import why_not
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.process.garbage_collection import responsive_threads, without_long_collections
from skinnode.protocol.codes import CodeScale
from skinnode.text.json_values import plain
from vcan_sim.fleet import Fleet

BITRATE_BPS: Final = 1_000_000
_REDRAW_S: Final = 0.2
_LINE_S: Final = 1.0
_LULL_S: Final = 0.004
"""Time without a new field, in s, after which all scans of the current SYNC are considered solved."""


@dataclass(frozen=True, slots=True)
class PatchReport:
    """Results for one patch."""

    patch: str
    node_id: int
    scans_sent: int
    scans_solved: int
    scans_skipped: int
    """Number of scans that were skipped because a newer scan arrived before a solver was free."""
    scans_torn: int
    frames_lost: int
    """Number of PDOs that the node sent but the host did not assemble into scans."""
    latency_p50_ms: float
    latency_p99_ms: float
    score: Score
    distrust: str = ""
    """Reason for distrusting the newest untrusted field; empty if all fields were trusted."""


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a demo run."""

    seconds: float
    scan_rate_hz: float
    patches: tuple[PatchReport, ...]
    frames_sent: int
    """Number of PDOs sent by the nodes."""
    frames_received: int
    """Number of PDOs assembled into scans by the host."""
    frames_lost: int
    bus_load: float
    """Equivalent bus load: fraction of the run time for which the frames would occupy a 1 Mbit/s bus."""
    faults: tuple[str, ...]
    """Faults found; any fault causes exit status 1. Empty if the run succeeded."""


@dataclass(frozen=True, slots=True)
class Run:
    """Report and plot data of a run."""

    report: Report
    traces: tuple[PatchTrace, ...]


@dataclass
class _Watch:
    """Data collected for one patch during a run; used only by the main thread."""

    config: PatchConfig
    scorer: Scorer
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=32))
    latency_ms: list[float] = field(default_factory=list)
    history: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Time (s), true depth (m), RMS error (m) and RMS of the reported standard deviations (m) of each
    scan."""
    deepest: tuple[float, Float, Float] | None = None
    newest: FieldFrame | None = None
    distrust: str = ""
    """Reason for distrusting the newest untrusted field; empty if all fields were trusted."""

    def take(self, frame: FieldFrame, true_upper_m: Float, t_start_ns: int) -> None:
        stamp = frame.stamp
        assert stamp is not None  # always true: the host timestamps every field
        truth = true_upper_m - self.scorer.layout.upper_m
        error_m = self.scorer.add(frame, true_upper_m)
        depth_m = float(-truth[..., 2].min())
        reported_m = float(np.sqrt(np.mean(frame.displacement_std_m**2)))
        self.newest = frame
        self.distrust = why_not(frame) or self.distrust
        self.arrivals_s.append(stamp.t_solved_ns * 1e-9)
        self.latency_ms.append((stamp.t_solved_ns - stamp.t_receive_ns) * 1e-6)
        self.history.append(((stamp.t_receive_ns - t_start_ns) * 1e-9, depth_m, error_m, reported_m))
        if self.deepest is None or depth_m > self.deepest[0]:
            self.deepest = depth_m, truth, frame.displacement_m

    @property
    def rate_hz(self) -> float:
        if len(self.arrivals_s) < 2:
            return 0.0
        return (len(self.arrivals_s) - 1) / (self.arrivals_s[-1] - self.arrivals_s[0])

    def view(self, health: str, torn: int) -> PatchView:
        frame = self.newest
        return PatchView(
            name=self.config.name,
            health=health,
            displacement_m=None if frame is None else frame.displacement_m,
            depth_std_m=math.nan if frame is None else _depth_std_m(frame),
            error_m=self.history[-1][2] if self.history else math.nan,
            rate_hz=self.rate_hz,
            torn=torn,
            distrust="" if frame is None else why_not(frame),
        )

    def trace(self) -> PatchTrace | None:
        if self.deepest is None:
            return None
        time_s, depth_m, error_m, reported_m = np.array(self.history).T
        _, truth, decoded = self.deepest
        rest = self.scorer.layout.upper_m
        return PatchTrace(self.config.name, rest, time_s, depth_m, error_m, reported_m, truth, decoded)


def _depth_std_m(frame: FieldFrame) -> float:
    """Return the reported standard deviation of the depth of the deepest electrode."""
    deepest = frame.displacement_m[..., 2].argmin()
    return float(frame.displacement_std_m[..., 2].flat[deepest])


class _Progress:
    """Displays the progress of a run: a live view on a terminal, otherwise one line per second."""

    def __init__(self, console: Console, hand: HandConfig, watches: Sequence[_Watch], seconds: float) -> None:
        self._console, self._watches, self._seconds = console, watches, seconds
        self._full_scale_m = max(p.layout.height_m for p in hand.patches) * hand.simulation.depth
        self._live = (
            Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        )
        self._due_s = _REDRAW_S

    @contextlib.contextmanager
    def shown(self) -> Iterator[None]:
        with self._live or contextlib.nullcontext():
            yield

    def update(self, host: Host, elapsed_s: float, bits_before: int) -> None:
        if elapsed_s < self._due_s:
            return
        stats = host.stats()
        load, lost = (_bits(host) - bits_before) / (BITRATE_BPS * elapsed_s), _losses(host)
        torn = {name: stream.assembler.scans_torn for name, stream in stats.patches.items()}
        latency = np.concatenate([watch.latency_ms for watch in self._watches] or [[]])
        p50, p99 = np.percentile(latency, (50, 99)) if latency.size else (math.nan, math.nan)
        received = sum(bus.received for bus in stats.buses.values())
        if self._live is not None:
            self._due_s = elapsed_s + _REDRAW_S
            views = [
                watch.view(host.health(watch.config.name).condition, torn[watch.config.name])
                for watch in self._watches
            ]
            bus = BusView(elapsed_s, self._seconds, load, received, lost, float(p50), float(p99))
            room = panels_in(self._console.width, self._console.height)
            self._live.update(render(views, bus, self._full_scale_m, room), refresh=True)
            return
        self._due_s = elapsed_s + _LINE_S
        errors = [watch.history[-1] for watch in self._watches if watch.history]
        shown = ", ".join(f"{1e6 * abs(depth):.0f}" for _, depth, _, _ in errors) or "-"
        p99_text = f"{p99:.1f}" if latency.size else "-"
        self._console.print(
            f"{elapsed_s:5.1f} s  {received} frames, {lost} lost, {sum(torn.values())} torn, "
            f"load {100 * load:.0f} %, frame-to-field latency p99 {p99_text} ms, depth {shown} µm",
            soft_wrap=True,
        )


def play(hand: HandConfig, seconds: float, console: Console) -> Run:
    """Run a simulated hand, and compare the decoded fields with the true displacements.

    Args:
        hand: Hand with all patches on virtual buses.
        seconds: Duration of the run.
        console: Console for the progress display.

    Raises:
        SkinError: The simulated patches or the host cannot run.
    """
    if jit.is_cold():
        console.print("compiling the kernels; they are then cached, so the next start is immediate")
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    watches = {
        patch.name: _Watch(patch, Scorer(layouts[patch.name], CodeScale(patch.code_bits).relative_std))
        for patch in hand.patches
    }
    count = len(hand.patches)
    console.print(
        f"bringing up {count} simulated {'patch' if count == 1 else 'patches'} on a virtual CAN bus:  "
        "boot-up, identity, configuration, start",
        soft_wrap=True,
    )
    with responsive_threads(), Fleet(hand) as fleet:
        # without_long_collections() runs a garbage collection here, before the first SYNC.
        with without_long_collections(), Host.from_config(hand) as host:
            bits_before = _bits(host)
            t_start_ns = time.monotonic_ns()
            progress = _Progress(console, hand, list(watches.values()), seconds)
            subscription = host.fields(capacity=64 * count)
            with progress.shown():
                elapsed_s, unscored = 0.0, deque[FieldFrame]()
                while elapsed_s < seconds:
                    frame = subscription.get(_LULL_S)
                    elapsed_s = (time.monotonic_ns() - t_start_ns) * 1e-9
                    if frame is not None:
                        unscored.append(frame)
                        continue
                    # Score and display only while no scan is being solved, to avoid delaying the host.
                    if unscored:
                        _take(unscored.popleft(), watches, fleet, t_start_ns)
                    progress.update(host, elapsed_s, bits_before)
            bits, elapsed_s = _bits(host) - bits_before, (time.monotonic_ns() - t_start_ns) * 1e-9
        while (frame := subscription.get(0.0)) is not None:  # fields solved while the host was closing
            unscored.append(frame)
        for frame in unscored:
            _take(frame, watches, fleet, t_start_ns)
        stats, nodes = host.stats(), {node.patch: node for node in fleet.report()}
    rows = tuple(
        PatchReport(
            patch=name,
            node_id=watch.config.node_id,
            scans_sent=nodes[name].scans_sent,
            scans_solved=stats.patches[name].solved,
            scans_skipped=stats.patches[name].skipped,
            scans_torn=stats.patches[name].assembler.scans_torn,
            frames_lost=nodes[name].pdos_sent - _accepted(stats.patches[name]),
            latency_p50_ms=_percentile(watch.latency_ms, 50),
            latency_p99_ms=_percentile(watch.latency_ms, 99),
            score=watch.scorer.score(),
            distrust=watch.distrust,
        )
        for name, watch in watches.items()
    )
    sent = sum(node.pdos_sent for node in nodes.values())
    received = sum(map(_accepted, stats.patches.values()))
    report = Report(
        seconds=elapsed_s,
        scan_rate_hz=1.0 / hand.sync.period_s,
        patches=rows,
        frames_sent=sent,
        frames_received=received,
        frames_lost=sent - received,
        bus_load=bits / (BITRATE_BPS * elapsed_s),
        faults=_faults(rows, sent - received),
    )
    traces = (watch.trace() for watch in watches.values())
    return Run(report, tuple(trace for trace in traces if trace is not None))


def _take(frame: FieldFrame, watches: dict[str, _Watch], fleet: Fleet, t_start_ns: int) -> None:
    assert frame.stamp is not None  # always true: the host timestamps every field
    if frame.stamp.device_time_us == 0:  # the summary was lost, so the time of the scan is unknown
        return
    true_upper_m = fleet.truth_m(frame.stamp.patch, frame.stamp.device_time_us)
    watches[frame.stamp.patch].take(frame, true_upper_m, t_start_ns)


def _bits(host: Host) -> int:
    return sum(bus.bits for bus in host.stats().buses.values())


def _losses(host: Host) -> int:
    """Return the number of frames dropped from the host's queues plus the number of lost chunks."""
    stats = host.stats()
    dropped = sum(bus.dropped for bus in stats.buses.values())
    return dropped + sum(stream.assembler.chunks_lost for stream in stats.patches.values())


def _accepted(stream: StreamStats) -> int:
    return stream.assembler.chunks_accepted + stream.assembler.summaries_accepted


def _percentile(values: Sequence[float], percent: float) -> float:
    return float(np.percentile(values, percent)) if values else math.nan


def _faults(rows: Sequence[PatchReport], lost: int) -> tuple[str, ...]:
    found = []
    if lost:
        found.append(f"{lost} {'frame' if lost == 1 else 'frames'} lost")
    for row in rows:
        if row.scans_torn:
            found.append(f"{row.patch}: {row.scans_torn} {'scan' if row.scans_torn == 1 else 'scans'} torn")
        if row.score.scans == 0:
            found.append(f"{row.patch}: no scan solved")
        elif not row.score.within_uncertainty:
            score = row.score
            why = f" ({row.distrust})" if row.distrust else ""
            found.append(
                f"{row.patch}: error {1e6 * score.error_rms_m:.2f} µm RMS, "
                f"at most {score.worst_deviations:.1f} standard deviations, "
                f"{score.untrusted} scans not trusted{why}; "
                f"reported ± {1e6 * score.reported_rms_m:.2f} µm"
            )
    return tuple(found)


def print_report(console: Console, report: Report) -> None:
    """Print the results as a table with one row per patch, followed by one line per fault."""
    table = Table(box=None, header_style="dim", padding=(0, 1, 0, 0))
    table.add_column("\npatch")
    for heading in (
        "scans sent/\nsolved/torn",
        "PDOs\nlost",
        "deepest\nµm",
        "error\nµm RMS",
        "reported\n± µm",
        "codes\n± µm",
        "in 95 %\ninterval",
        "latency ms\np50 / p99",
    ):
        table.add_column(heading, justify="right")
    for row in report.patches:
        score = row.score
        table.add_row(
            row.patch,
            f"{row.scans_sent}/{row.scans_solved}/{row.scans_torn}",
            f"{row.frames_lost}",
            f"{1e6 * score.deepest_m:.0f}",
            f"{1e6 * score.error_rms_m:.2f}",
            f"{1e6 * score.reported_rms_m:.2f}",
            f"{1e6 * score.bound_rms_m:.2f}",
            f"{100 * score.coverage95:.1f} %",
            f"{row.latency_p50_ms:.1f} / {row.latency_p99_ms:.1f}",
        )
    console.print(table)
    load = f"{100 * report.bus_load:.0f} %"
    console.print(
        f"{report.frames_sent} PDOs sent, {report.frames_lost} lost; "
        f"{report.scan_rate_hz:.1f} scans/s per patch; equivalent load of a 1 Mbit/s bus: {load}",
        soft_wrap=True,
    )
    pressed = [row.score for row in report.patches if row.score.deepest_m > 10 * row.score.reported_rms_m]
    if pressed:
        shares = [100 * score.relative_error for score in pressed]
        console.print(
            f"error in the deepest scan: {min(shares):.1f} to {max(shares):.1f} % of the displacement field",
            soft_wrap=True,
        )
    else:
        console.print("no patch was pressed during this run; increase --seconds")
    for fault in report.faults:
        console.print("fault: ", style="bold red", end="")
        console.print(fault)
    if not report.faults:
        worst = max(row.score.worst_deviations for row in report.patches)
        console.print(
            "no scan torn, no frame lost, errors consistent with the reported standard deviations",
            style="green",
            end=" ",
            soft_wrap=True,
        )
        console.print(
            f"(RMS at most {EXCESS_LIMIT} times the reported RMS, "
            f"largest error {worst:.1f} standard deviations)",
            soft_wrap=True,
        )


def as_json(report: Report) -> dict[str, Any]:
    """Convert the report to JSON-compatible types; NaN becomes None."""
    result: dict[str, Any] = plain(dataclasses.asdict(report))
    return result
