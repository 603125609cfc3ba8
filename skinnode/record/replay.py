"""Replays a recording and solves its scans with the code that decodes live frames.

The dispatcher, assembler, decoder, stream, solver and publisher are those of the host, but run in a single
thread: each scan is solved when its last frame is dispatched.

The fields are identical to those of the live run, bit for bit, on these conditions:

- the recording is complete and began before the host started;
- the software and the processor are the same;
- no live solve was cut short by its deadline.

Times refer to the clock of the recording host, with the 1 µs resolution of log files. If frames are missing
or damaged, the frame counts in the journal no longer match the log. The times of the frames then determine
when journal events take effect and when incomplete scans time out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand, NmtState
from skinnode.config import BusConfig
from skinnode.errors import ConfigError
from skinnode.host.containment import Defects
from skinnode.host.dispatcher import BusStats, Dispatcher, PortCounters
from skinnode.host.health import PatchHealth, faults_of
from skinnode.host.patch_stream import StreamOutput, StreamStats
from skinnode.host.publish import Publisher
from skinnode.host.reception import PatchReception, receive_bus, receive_patch
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sync import SyncFollower, Ticks
from skinnode.host.workers import Inline
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record.journal import SUFFIX, facts_of, read_journal
from skinnode.record.recorder import channels
from skinnode.text.words import counted
from skinnode.transport.frame_log_reader import FrameLogReader

LONGEST_SILENCE_S: Final = 60.0
"""Maximum pause between replayed frames, s.

Longer pauses are shortened, because they may be due to damaged timestamps.
"""

_ROUNDING_NS: Final = 2_000
"""Maximum rounding error of a log's timestamps, ns."""

_SLICE_S: Final = 0.1
"""Maximum delay before :meth:`Replay.stop` takes effect, s."""


def _never() -> bool:
    return False


def replay(path: Path | str, *, speed: float | None = None, cancelled: Callable[[], bool] = _never) -> Replay:
    """Open a recording and return an iterable of its fields.

    Example::

        for field in skinnode.record.replay("runs/hand-20260102-030405.log"):
            ...

    At any ``speed``, the replay solves every scan that was solved live.

    Args:
        path: File ending in .log or .blf.
        speed: Replay speed relative to the recording: 2 is twice as fast; None replays as fast as possible.
        cancelled: Function called before each frame; returning True has the effect of :meth:`Replay.stop`.

    Raises:
        ConfigError: The recording cannot be read, or ``speed`` is not positive.
    """
    return Replay(Path(path), speed, cancelled)


class Replay:
    """Replay of a recording, created by :func:`replay`. A replay can be iterated only once."""

    def __init__(self, path: Path, speed: float | None, cancelled: Callable[[], bool] = _never) -> None:
        if speed is not None and not 0 < speed < float("inf"):
            raise ConfigError("speed", speed, "a positive number")
        if not path.name:
            raise ConfigError("recording", str(path), "a file ending in .log or .blf")
        header, events, self.complaints = read_journal(path.with_suffix(SUFFIX))
        """One-line message for each unreadable part of the journal."""
        self.hand, self.started = header.hand, header.started
        self._speed, self._offset_ns = speed, header.wall_minus_mono_ns
        self.log = FrameLogReader(path)
        """Reader of the log; ``damaged`` and ``damages`` describe its unreadable parts."""
        ends = [event for event in events if event["event"] == "ended"]
        self.ended = bool(ends)
        """Whether the recording was closed properly; False if its process was killed."""
        self._recorded: int | None = ends[0].get("frames") if ends else None
        self._read = 0
        self._first_ns: int | None = None
        self._journal = path.with_suffix(SUFFIX).name
        self.incomplete: str | None = None
        """Description of the frames missing from the log; None if none are known to be missing."""
        self.dropped = sum(e["frames"] for e in events if e["event"] == "dropped")
        """Number of frames that the recorder could not write."""
        self._now_ns = 0
        self._stopped, self._cancelled = False, cancelled
        self._publisher = Publisher(tuple(patch.name for patch in self.hand.patches))
        self._buses = {
            bus.name: _Bus(bus, self, [event for event in events if event["bus"] == bus.name])
            for bus in self.hand.buses
        }
        names = channels(self.hand)
        by_number = path.suffix == ".blf"
        self._by_channel = {
            str(number) if by_number else names[bus.name]: self._buses[bus.name]
            for number, bus in enumerate(self.hand.buses)
        }
        self.strange = 0
        """Number of frames on channels that belong to no bus of the hand."""

    def __iter__(self) -> Iterator[FieldFrame]:
        fields = self._publisher.subscribe(64, None, None)
        pace = _Pace(self._speed, self._wait)
        for frame, channel, sent in self.log:
            frame = frame._replace(t_ns=frame.t_ns - self._offset_ns)
            pace.wait_for(frame.t_ns)
            if self.stopped:
                break
            self._now_ns = frame.t_ns
            self._read += 1
            if self._first_ns is None:
                self._first_ns = frame.t_ns
            bus = self._by_channel.get(channel)
            if bus is None:
                self.strange += 1
                continue
            bus.take(frame, sent=sent, whole=not self.log.damaged)
            while (field := fields.get(0.0)) is not None:
                yield field
        self.log.close()
        if not self.stopped:
            self.incomplete = self._lack()
        for bus in self._buses.values():
            bus.finish()
        while (field := fields.get(0.0)) is not None:
            yield field

    def _lack(self) -> str | None:
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
            found.append(f"{counted(self.strange, 'frame')} on channels that belong to no bus of the hand")
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
        heard = self._buses[self.hand.patch(patch).bus].patches[patch]
        health = heard.monitor.health(self._now_ns, self.hand.bring_up.heartbeat_s, self.hand.sync.period_s)
        return replace(health, faults=faults_of(self._publisher.latest(patch)))

    def bus_stats(self) -> dict[str, BusStats]:
        """Return the counters of each bus."""
        return {name: bus.stats() for name, bus in self._buses.items()}

    def patch_stats(self) -> dict[str, StreamStats]:
        """Return the counters of each patch."""
        return {patch.name: self._stream_stats(patch.name) for patch in self.hand.patches}

    def _stream_stats(self, patch: str) -> StreamStats:
        return self._buses[self.hand.patch(patch).bus].patches[patch].stream.stats()

    def _wait(self, seconds: float) -> None:
        end_s = clock.monotonic() + seconds
        while not self.stopped and (left_s := end_s - clock.monotonic()) > 0:
            clock.sleep(min(left_s, _SLICE_S))

    def complain(self, event: dict[str, Any], what: str) -> None:
        """Add a message about a malformed journal event to ``complaints``."""
        self.complaints.append(f"{self._journal} line {event['line']}: {what}")

    def clock(self) -> int:
        """Return the current replay time on the recording host's monotonic clock, ns."""
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


class _PollerlessDispatcher(Dispatcher):
    """Dispatcher that does not poll streams after each batch; the journal determines when to poll."""

    def poll_with(self, poller: Callable[[int], None], defects: Defects | None = None) -> None:
        pass


class _Bus:
    """Receiver for one bus of a recording; contains the streams of all patches on this bus."""

    def __init__(self, config: BusConfig, replay: Replay, events: list[dict[str, Any]]) -> None:
        self._config, self._replay = config, replay
        hand = replay.hand
        self._ticks = Ticks(hand.sync.counter_overflow)
        self._dispatcher = _PollerlessDispatcher(config, {}, 0)
        output = StreamOutput(Inline(), replay.publisher)
        receive_bus(hand, self._dispatcher, self._ticks)
        self._own_syncs = SyncFollower(self._ticks)
        self.patches: dict[str, PatchReception] = {
            patch.name: receive_patch(patch, hand, self._dispatcher, self._ticks, output)
            for patch in hand.patches_on(config.name)
        }
        for name, heard in self.patches.items():
            mine = [e for e in events if e["event"] == "overtaken" and e["patch"] == name]
            heard.stream.leave_out([e["received_ns"] for e in mine], _ROUNDING_NS)
        self._events = deque(events)
        self._solvers: dict[str, ScanSolver | None] = {}
        self._received = self._sent = 0
        self._of_heartbeat = {
            od.heartbeat_cob_id(patch.node_id): self.patches[patch.name].monitor
            for patch in hand.patches_on(config.name)
        }
        self._stood_by: set[int] = set()  # heartbeat COB-IDs of nodes that the host set to pre-operational

    def take(self, frame: Any, *, sent: bool, whole: bool) -> None:
        """Process the next frame of the log; ``whole``: whether the log has been undamaged so far."""
        if sent:
            self._sent += 1
            self._dispatcher.count_sent(frame.can_id, frame.data)
            if frame.can_id == od.SYNC_COB_ID and not frame.extended:
                self._own_syncs.on_sync(frame.data, frame.t_ns)
            if frame.can_id == od.NMT_COB_ID and not frame.extended:
                self._on_command(frame.data)
            return
        while self._events and self._is_due(self._events[0], frame.t_ns, whole=whole):
            self._happen(self._events.popleft())
        self._received += 1
        self._dispatcher.dispatch((frame,))
        if frame.can_id in self._stood_by:
            monitor = self._of_heartbeat[frame.can_id]
            if monitor.nmt_state == NmtState.PRE_OPERATIONAL:  # no fault, because the host commanded it
                monitor.nmt_state = NmtState.OPERATIONAL
        if not whole:
            for heard in self.patches.values():
                heard.stream.poll(frame.t_ns)
        self._dispatcher.measure(frame.t_ns)

    def _on_command(self, data: bytes) -> None:
        """Process an NMT command from the host, which sets its nodes to pre-operational when it exits."""
        if len(data) != 2:
            return
        cob_id = od.heartbeat_cob_id(data[1])
        monitor = self._of_heartbeat.get(cob_id)
        if monitor is None or data[0] == NmtCommand.START:
            self._stood_by.discard(cob_id)
        elif data[0] == NmtCommand.ENTER_PRE_OPERATIONAL and monitor.nmt_state == NmtState.OPERATIONAL:
            self._stood_by.add(cob_id)

    def finish(self) -> None:
        """Apply the journal events that follow the last frame."""
        while self._events:
            self._happen(self._events.popleft())

    def stats(self) -> BusStats:
        return self._dispatcher.count(PortCounters(sent=self._sent))

    def _is_due(self, event: dict[str, Any], t_ns: int, *, whole: bool) -> bool:
        if whole:
            return bool(event["at"] <= self._received)
        return bool(event["t_ns"] <= t_ns)

    def _happen(self, event: dict[str, Any]) -> None:
        stream = self.patches[event["patch"]].stream
        match event["event"]:
            case "withheld":
                stream.withhold()
            case "polled":
                stream.poll(event["t_ns"] + _ROUNDING_NS)
            case "resumed":
                solver = self._solver(event)
                if solver is None:
                    stream.withhold()
                else:
                    stream.resume(solver, stream.withholdings, anew=bool(event.get("anew")))

    def _solver(self, event: dict[str, Any]) -> ScanSolver | None:
        """Return the solver for a journal event; None if the facts about the node are unknown or unusable."""
        name, replay = event["patch"], self._replay
        if "facts" in event:
            self._solvers[name] = None
            try:
                facts = facts_of(event["facts"], replay.hand.patch(name), self._config)
                self._solvers[name] = ScanSolver(
                    facts, replay.hand.solver, replay.clock, period_s=replay.hand.sync.period_s
                )
            except (KeyError, TypeError, OverflowError, ValueError) as error:
                replay.complain(event, f"unusable facts about {name} ({type(error).__name__}: {error})")
        return self._solvers.get(name)
