"""Replays a recording and solves its scans with the code that decodes live frames.

A replay uses the host's own dispatcher, assembler, decoder, stream, solver and publisher, but runs them in a
single thread: each scan is solved when its last frame is dispatched.

The fields are identical to those of the live run, bit for bit, if these conditions are met:

- the recording is complete and began before the host started;
- the software and the processor are the same;
- no live solve was cut short by its deadline.

Times refer to the clock of the recording host, with the 1 µs resolution of log files. If frames are missing
or damaged, the frame counts in the journal no longer match the log. The times of the frames then determine
when journal events take effect and when incomplete scans time out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host.dispatcher import BusStats
from skinnode.host.health import PatchHealth, faults_of
from skinnode.host.node_facts import NodeFacts
from skinnode.host.patch_stream import StreamStats
from skinnode.host.publish import Publisher
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.record.open_recording import OpenRecording, open_log, open_recording
from skinnode.record.replayed_bus import ReplayedBus
from skinnode.text.words import counted
from skinnode.transport.frame_log import LoggedFrame

LONGEST_SILENCE_S: Final = 60.0
"""Maximum pause between replayed frames, in s.

Longer pauses are shortened, because they may be due to damaged timestamps.
"""

_SLICE_S: Final = 0.1
"""Maximum delay before :meth:`Replay.stop` takes effect, in s."""


MakeSolver = Callable[[NodeFacts, HandConfig, Callable[[], int]], ScanSolver]
"""Function that returns a patch's solver, given its facts, the hand and the clock (ns) for the stamps."""


def live_solver(facts: NodeFacts, hand: HandConfig, now: Callable[[], int]) -> ScanSolver:
    """Return the solver that a live host uses for a patch."""
    return ScanSolver(facts, hand.solver, now, period_s=hand.sync.period_s)


def _never() -> bool:
    return False


def replay(
    path: Path | str,
    *,
    speed: float | None = None,
    cancelled: Callable[[], bool] = _never,
    hand: HandConfig | None = None,
) -> Replay:
    """Open a recording and return an iterable of its fields.

    Example::

        for field in skinnode.record.replay("runs/hand-20260102-030405.log"):
            ...

    At any ``speed``, the replay solves every scan that was solved live.

    Args:
        path: File ending in .mcap, or in .log, .blf or .asc with its journal in the same folder.
        speed: Replay speed relative to the recording: 2 is twice as fast; None replays as fast as possible.
        cancelled: Function called before each frame; returning True has the same effect as
            :meth:`Replay.stop`.
        hand: Hand for a log without a journal, such as a candump log of another master. See
            :func:`skinnode.record.open_recording.open_log`.

    Raises:
        ConfigError: The recording cannot be read, ``speed`` is not positive, or ``hand`` is given although
            the recording has a journal.
    """
    path = Path(path)
    if speed is not None and not 0 < speed < float("inf"):
        raise ConfigError("speed", speed, "a positive number")
    recording = open_recording(path) if hand is None else open_log(path, hand)
    return Replay(recording, speed, cancelled)


class Replay:
    """Replay of a recording, created by :func:`replay`. A replay can be iterated only once.

    Args:
        recording: Open recording; the replay closes its file.
        speed: See :func:`replay`.
        cancelled: See :func:`replay`.
        solver: Function that returns the solver of a patch; default: the solver of a live host.
        buses: Names of the buses to replay; None for all. The buses do not affect each other.
    """

    def __init__(
        self,
        recording: OpenRecording,
        speed: float | None = None,
        cancelled: Callable[[], bool] = _never,
        *,
        solver: MakeSolver | None = None,
        buses: Collection[str] | None = None,
    ) -> None:
        header, events, self.complaints = recording.header, recording.events, recording.complaints
        """One-line message for each unreadable part of the journal."""
        self.hand, self.started = header.hand, header.started
        self.layoutless = header.layoutless
        """Names of the patches whose layout file is missing from an old journal."""
        self._speed, self._offset_ns = speed, header.wall_minus_mono_ns
        self.log = recording.frames
        """Reader of the log; ``damaged`` and ``damages`` describe its unreadable parts."""
        self.has_baselines = any(event["event"] == "resumed" for event in events)
        """Whether the journal contains a baseline; if not, no scan can be decoded."""
        repairs = [event for event in events if event["event"] == "repaired"]
        ends = [event for event in events if event["event"] == "ended"] or repairs
        self.ended = bool(ends)
        """Whether the recording was closed properly or has been repaired; False if its process was killed."""
        self._recorded: int | None = ends[0].get("frames") if ends else None
        self._lacking = any(event["damaged"] for event in repairs)  # frames before the end
        self._read = 0
        self._first_ns: int | None = None
        self._journal = recording.journal
        name = recording.frames.path.name
        repaired = [f"{name} was repaired; it contains the readable part of a recording"] if repairs else []
        self.notes = (*recording.notes, *repaired)
        """Messages about a repair, and about assumptions made because the log has no journal."""
        self.incomplete: str | None = None
        """Description of the frames missing from the log; None if none are known to be missing."""
        self.dropped = sum(e["frames"] for e in events if e["event"] == "dropped")
        """Number of frames that the recorder could not write."""
        self._now_ns = 0
        self._stopped, self._cancelled = False, cancelled
        self._publisher = Publisher(tuple(patch.name for patch in self.hand.patches))
        self._buses = {
            bus.name: ReplayedBus(bus, self, [event for event in events if event["bus"] == bus.name])
            for bus in self.hand.buses
            if buses is None or bus.name in buses
        }
        self._channels = recording.channels
        self.foreign = recording.foreign
        self._make_solver = live_solver if solver is None else solver
        self._finished = 0  # number of buses whose last journal events have been applied
        self.strange = 0
        """Number of frames on channels that do not belong to any bus of the hand."""

    def __iter__(self) -> Iterator[FieldFrame]:
        fields = self._publisher.subscribe(64, None, None)
        for frame, channel, sent in self.frames():
            name = self._channels.bus(channel)
            if name is None or name not in self._buses:
                continue
            self._buses[name].take(
                frame, sent=sent, whole=not (self.log.damaged or self.foreign or self._lacking)
            )
            while (field := fields.get(0.0)) is not None:
                yield field
        for number, bus in enumerate(self.hand.buses, 1):
            self._finished = number
            if bus.name in self._buses:
                self._buses[bus.name].finish()
        while (field := fields.get(0.0)) is not None:
            yield field

    def frames(self) -> Iterator[LoggedFrame]:
        """Yield the frames at the requested speed without decoding them; ``t_ns`` is a monotonic time.

        Iterate over either the fields or the frames.
        """
        pace = _Pace(self._speed, self._wait)
        for logged in self.log:
            frame = logged.frame._replace(t_ns=logged.frame.t_ns - self._offset_ns)
            pace.wait_for(frame.t_ns)
            if self.stopped:
                break
            self._now_ns = frame.t_ns
            self._read += 1
            if self._first_ns is None:
                self._first_ns = frame.t_ns
            self.strange += self._channels.bus(logged.channel) is None
            yield logged._replace(frame=frame)
        self.log.close()
        if not self.stopped:
            self.incomplete = self._lack()

    def _lack(self) -> str | None:
        if self.foreign:
            return None if self._read else "contains no frames"
        if not self.ended:
            span_s = (self._now_ns - (self._first_ns or 0)) * 1e-9
            return "was not ended properly: " + (
                f"readable up to {span_s:.1f} s" if self._read else "no frames"
            )
        if self._recorded is None or self._read == self._recorded:
            return None
        return f"has {self._read} frames, but {self._recorded} were recorded"

    @property
    def flaws(self) -> list[str]:
        """Messages about missing or unreadable parts, complete after a full iteration."""
        found = [f"{self.log.path.name} {damage}" for damage in self.log.damages]
        if self.log.damaged > len(found):
            found.append(f"{self.log.damaged - len(found)} more damaged places")
        if self.incomplete is not None:
            found.append(f"{self.log.path.name} {self.incomplete}")
        found += self.complaints
        if self.dropped:
            lost = counted(self.dropped, "frame was", "frames were")
            found.append(f"{lost} not recorded: the disk was too slow")
        if self.strange:
            found.append(f"{counted(self.strange, 'frame')} on channels not used by any bus of the hand")
        return found

    def stop(self) -> None:
        """End the iteration within 0.1 s; can be called from any thread."""
        self._stopped = True

    @property
    def stopped(self) -> bool:
        """Whether :meth:`stop` has been called or ``cancelled`` has returned True."""
        return self._stopped or self._cancelled()

    def health(self, patch: str) -> PatchHealth:
        """Return the health of a patch at the current replay time. Raises KeyError for an unknown patch."""
        bus = self._buses[self.hand.patch(patch).bus]
        solver = bus.solver(patch)
        # on a bus run by another master, the nodes' heartbeat period may differ from that in the hand file
        heartbeat_s = self.hand.bring_up.heartbeat_s if solver is None else solver.facts.heartbeat_s
        health = bus.patches[patch].monitor.health(self._now_ns, heartbeat_s, self.hand.sync.period_s)
        return replace(health, faults=faults_of(self._publisher.latest(patch)))

    def bus_stats(self) -> dict[str, BusStats]:
        """Return the counters of each bus."""
        return {name: bus.stats() for name, bus in self._buses.items()}

    def patch_stats(self) -> dict[str, StreamStats]:
        """Return the counters of each patch."""
        patches = [patch for patch in self.hand.patches if patch.bus in self._buses]
        return {patch.name: self._stream_stats(patch.name) for patch in patches}

    @property
    def place(self) -> tuple[int, int]:
        """Current position in the recording, by which the fields are ordered.

        The position consists of the number of frames read and the number of buses whose last journal events
        have been applied.
        """
        return self._read, self._finished

    def solver_of(self, facts: NodeFacts) -> ScanSolver:
        """Return a solver for the scans of a patch."""
        return self._make_solver(facts, self.hand, self.clock)

    def _stream_stats(self, patch: str) -> StreamStats:
        return self._buses[self.hand.patch(patch).bus].patches[patch].stream.stats()

    def _wait(self, seconds: float) -> None:
        end_s = clock.monotonic() + seconds
        while not self.stopped and (left_s := end_s - clock.monotonic()) > 0:
            clock.sleep(min(left_s, _SLICE_S))

    def complain(self, event: dict[str, Any], what: str) -> None:
        """Add a message about a malformed journal event to ``complaints``."""
        self.complaints.append(f"{self._journal} line {event['line']}: {what}")

    def layout(self, patch: str) -> PatchLayout:
        """Return the layout used to solve a patch's scans. Raises KeyError for an unknown patch."""
        config = self.hand.patch(patch)
        solver = self._buses[config.bus].solver(patch)
        return config.layout.build() if solver is None else solver.facts.layout

    @property
    def wall_minus_mono_ns(self) -> int:
        """Difference between the Unix time and the recording host's monotonic clock, in ns."""
        return self._offset_ns

    def clock(self) -> int:
        """Return the current replay time on the recording host's monotonic clock, in ns."""
        return self._now_ns

    @property
    def publisher(self) -> Publisher:
        """Publisher that passes replayed fields to subscribers."""
        return self._publisher


class _Pace:
    """Delays frames so that they are replayed at the requested speed."""

    def __init__(self, speed: float | None, wait: Callable[[float], None]) -> None:
        self._speed, self._wait = speed, wait
        self._last_ns: int | None = None
        self._due_s = clock.monotonic()

    def wait_for(self, t_ns: int) -> None:
        if self._speed is None:
            return
        gap_s = 0.0 if self._last_ns is None else (t_ns - self._last_ns) * 1e-9
        self._last_ns = t_ns
        self._due_s += max(-1.0, min(gap_s, LONGEST_SILENCE_S)) / self._speed
        ahead_s = self._due_s - clock.monotonic()
        if ahead_s > 0:
            self._wait(ahead_s)
