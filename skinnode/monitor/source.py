"""Provides the monitor's data sources: a running host or a replayed recording.

Sources take only the newest data and never block the host.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.host import Host, PatchHealth, Subscription
from skinnode.host.dispatcher import BusStats
from skinnode.host.events import Events, EventSubscription, HealthEvent
from skinnode.host.health import BusHealth
from skinnode.host.health_watch import HealthWatch
from skinnode.host.patch_stream import StreamStats
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.record import Recorder, Replay

_CAPACITY: Final = 1
_EVENTS: Final = 500
"""Maximum number of events queued between two screen updates."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a hand at one instant; the mappings are keyed by patch or bus name."""

    t_ns: int
    """Time in ns on the monotonic clock of the host or, for a recording, of the host that made it."""
    health: Mapping[str, PatchHealth]
    bus_health: Mapping[str, BusHealth]
    buses: Mapping[str, BusStats]
    streams: Mapping[str, StreamStats]
    fields: Mapping[str, FieldFrame | None]


@dataclass(frozen=True, slots=True)
class Recording:
    """Progress of a recording."""

    path: Path
    frames: int
    dropped: int
    failure: str | None


class Source(Protocol):
    """Protocol implemented by the monitor's data sources.

    All methods except ``record`` and ``stop_recording`` return immediately.
    """

    hand: HandConfig
    title: str
    live: bool
    """Whether patches can be tared and recorded."""

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand. Raises SkinError if the source has failed."""

    def events(self) -> list[HealthEvent]:
        """Return the events that have occurred since the last call."""

    def fields(self, capacity: int) -> Subscription:
        """Subscribe to the fields of all patches; the queue keeps the newest ``capacity`` fields."""

    def now_ns(self) -> int:
        """Return the current time in ns on the monotonic clock used in snapshots."""

    @property
    def wall_minus_mono_ns(self) -> int:
        """Wall-clock time minus the time on the monotonic clock used in snapshots, in ns."""

    @property
    def over(self) -> bool:
        """Whether the source has ended."""

    @property
    def flaws(self) -> list[str]:
        """Descriptions of missing or unreadable data found so far in a recording."""

    def tare(self, patch: str) -> None:
        """Tare a patch, as :meth:`Host.tare` does."""

    @property
    def recording(self) -> Recording | None:
        """Progress of the recording being written; None if no recording is being written."""

    def record(self, folder: Path) -> Path:
        """Start a recording and return its path. Raises ConfigError if the recording cannot be written."""

    def stop_recording(self) -> Recording:
        """End the recording and return its final statistics."""

    def close(self) -> None:
        """Release the source's resources."""


class HostSource(Closing):
    """Data source for a running host. The caller must close the host."""

    live = True

    def __init__(self, host: Host) -> None:
        self.hand, self.title = host.hand, host.hand.name
        self._host = host
        self._events = host.events(capacity=_EVENTS)
        self._fields = host.fields(capacity=_CAPACITY)  # the queue also receives the error if the host fails
        self._recorder: Recorder | None = None
        self._untap: Callable[[], None] | None = None

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand."""
        for _ in range(_CAPACITY + 1):  # if the host has failed, the last item in the queue is the error
            self._fields.get(0.0)
        host, stats = self._host, self._host.stats()
        return Snapshot(
            t_ns=clock.monotonic_ns(),
            health={name: host.health(name) for name in stats.patches},
            bus_health={name: host.bus_health(name) for name in stats.buses},
            buses=stats.buses,
            streams=stats.patches,
            fields={name: host.latest(name) for name in stats.patches},
        )

    def events(self) -> list[HealthEvent]:
        """Return the events that have occurred since the last call."""
        return drain(self._events)

    def fields(self, capacity: int) -> Subscription:
        """Subscribe to the fields of all patches."""
        return self._host.fields(capacity=capacity)

    def now_ns(self) -> int:
        """Return the current time in ns."""
        return clock.monotonic_ns()

    @property
    def wall_minus_mono_ns(self) -> int:
        """Wall-clock time minus monotonic time, in ns."""
        return clock.time_ns() - clock.monotonic_ns()

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return False

    @property
    def flaws(self) -> list[str]:
        """Flaws in the recording."""
        return []

    def tare(self, patch: str) -> None:
        """Tare a patch."""
        self._host.tare(patch)

    @property
    def recording(self) -> Recording | None:
        """Progress of the recording being written; None if no recording is being written."""
        if self._recorder is None:
            return None
        stats = self._recorder.stats()
        return Recording(self._recorder.path, stats.frames, stats.dropped, stats.failure)

    def record(self, folder: Path) -> Path:
        """Start a recording."""
        recorder = Recorder(self.hand, folder)
        self._recorder, self._untap = recorder, self._host.tap(recorder)
        return recorder.path

    def stop_recording(self) -> Recording:
        """End the recording."""
        recorder, untap = self._recorder, self._untap
        assert recorder is not None
        assert untap is not None
        untap()
        recorder.close()
        ended = self.recording
        assert ended is not None
        self._recorder = self._untap = None
        return ended

    def close(self) -> None:
        """Release the source's resources."""
        if self._recorder is not None:
            self.stop_recording()
        self._fields.close()


class ReplaySource(Closing):
    """Data source that replays a recording on a separate thread, from construction until :meth:`close`."""

    live = False

    def __init__(self, run: Replay) -> None:
        self.hand, self.title = run.hand, run.log.path.name
        self._run = run
        self._failure: SkinError | None = None
        self._running = ExitStack()
        self._all_events = events = Events()
        self._events: EventSubscription = events.subscribe(_EVENTS)
        self._running.enter_context(
            HealthWatch(
                lambda: health_in(run),
                lambda: bus_health_in(run),
                events,
                touches=run.publisher.touches.take,
                now_ns=run.clock,
            )
        )
        self._thread = threading.Thread(target=self._play, name="replay", daemon=True)
        self._thread.start()

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand."""
        if self._failure is not None:
            raise self._failure
        return snapshot_of(self._run)

    def events(self) -> list[HealthEvent]:
        """Return the events that have occurred since the last call."""
        return drain(self._events)

    def fields(self, capacity: int) -> Subscription:
        """Subscribe to the fields of all patches."""
        return self._run.publisher.subscribe(capacity, None, None)

    def now_ns(self) -> int:
        """Return the current replay time in ns on the recording host's monotonic clock."""
        return self._run.clock()

    @property
    def wall_minus_mono_ns(self) -> int:
        """Wall-clock time minus monotonic time on the recording host, in ns."""
        return self._run.wall_minus_mono_ns

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return not self._thread.is_alive()

    @property
    def flaws(self) -> list[str]:
        """Flaws in the recording."""
        return self._run.flaws

    def tare(self, patch: str) -> None:
        """Tare a patch."""
        raise SkinError("a recording cannot be tared")

    @property
    def recording(self) -> Recording | None:
        """Progress of the recording being written; None if no recording is being written."""
        return None

    def record(self, folder: Path) -> Path:
        """Start a recording."""
        raise SkinError("this is already a recording")

    def stop_recording(self) -> Recording:
        """End the recording."""
        raise SkinError("this is already a recording")

    def close(self) -> None:
        """Release the source's resources."""
        self._run.stop()
        self._thread.join()
        self._running.close()

    def _play(self) -> None:
        try:
            for _ in self._run:
                pass
            for flaw in self._run.flaws:
                self._all_events.publish(HealthEvent(self._run.clock(), self.title, "recording", flaw))
        except Exception as error:  # also report unexpected exceptions to the user
            self._failure = error if isinstance(error, SkinError) else SkinError(f"replay: {error!r}")


def snapshot_of(run: Replay) -> Snapshot:
    """Return the state of the hand at the current time of a replay.

    Args:
        run: The replay.
    """
    return Snapshot(
        t_ns=run.clock(),
        health=health_in(run),
        bus_health=bus_health_in(run),
        buses=run.bus_stats(),
        streams=run.patch_stats(),
        fields={patch.name: run.publisher.latest(patch.name) for patch in run.hand.patches},
    )


def health_in(run: Replay) -> dict[str, PatchHealth]:
    """Return the health of each patch at the current time of a replay."""
    return {patch.name: run.health(patch.name) for patch in run.hand.patches}


def bus_health_in(run: Replay) -> dict[str, BusHealth]:
    """Return the health of each bus at the current time of a replay."""
    return {
        name: BusHealth(
            bus=name,
            away=None,
            load=stats.load,
            error_frames=stats.error_frames,
            bus_offs=stats.bus_offs,
            outages=0,
            kernel_dropped=0,
            dropped=0,
            malformed=stats.malformed,
            foreign=stats.foreign,
            foreign_ids=tuple(sorted(stats.foreign_ids)),
            other_syncs=0,
            other_masters=0,
            controller=stats.controller,
        )
        for name, stats in run.bus_stats().items()
    }


def drain(subscription: EventSubscription) -> list[HealthEvent]:
    """Return all queued events, without waiting for more."""
    found: list[HealthEvent] = []
    while (event := subscription.get(0.0)) is not None:
        found.append(event)
    return found
