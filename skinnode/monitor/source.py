"""Where the monitor looks: a running host, or a recording that is played. Only the newest is taken, and
nothing here makes the host wait."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.host import Host, PatchHealth
from skinnode.host.dispatcher import BusStats
from skinnode.host.events import Events, EventSubscription, HealthEvent, HealthWatch
from skinnode.host.health import BusHealth
from skinnode.host.patch_stream import StreamStats
from skinnode.model.frames import FieldFrame
from skinnode.record import Recorder, Replay

_CAPACITY: Final = 1
_EVENTS: Final = 500
"""Events that are kept for a screen that is not drawn meanwhile."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A hand at one instant; by patch or by bus."""

    t_ns: int
    """By the clock of the source, which is the one of all its times: that of a recording for a recording."""
    health: Mapping[str, PatchHealth]
    bus_health: Mapping[str, BusHealth]
    buses: Mapping[str, BusStats]
    streams: Mapping[str, StreamStats]
    fields: Mapping[str, FieldFrame | None]


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording under way."""

    path: Path
    frames: int
    dropped: int
    failure: str | None


class Source(Protocol):
    """What the screen needs. All methods return at once but those of recording."""

    hand: HandConfig
    title: str
    live: bool
    """Whether it can be tared and recorded."""

    def snapshot(self) -> Snapshot:
        """How things are now. Raises the SkinError that ended the source, if one did."""

    def events(self) -> list[HealthEvent]:
        """What happened since it was asked last."""

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""

    @property
    def flaws(self) -> list[str]:
        """What of a recording could not be read or is not there, as far as it was played."""

    def tare(self, patch: str) -> None:
        """See :meth:`Host.tare`."""

    @property
    def recording(self) -> Recording | None: ...

    def record(self, folder: Path) -> Path:
        """Begin to record. Raises ConfigError where it cannot be written."""

    def stop_recording(self) -> Recording:
        """End the recording; what it came to."""

    def close(self) -> None: ...


class HostSource:
    """A running host; its owner closes it."""

    live = True

    def __init__(self, host: Host) -> None:
        self.hand, self.title = host.hand, host.hand.name
        self._host = host
        self._events = host.events(capacity=_EVENTS)
        self._fields = host.fields(capacity=_CAPACITY)  # the host tells its subscribers why it cannot go on
        self._recorder: Recorder | None = None
        self._untap: Callable[[], None] | None = None

    def snapshot(self) -> Snapshot:
        for _ in range(_CAPACITY + 1):  # behind the fields may be a failure
            self._fields.get(0.0)
        host, stats = self._host, self._host.stats()
        return Snapshot(
            t_ns=time.monotonic_ns(),
            health={name: host.health(name) for name in stats.patches},
            bus_health={name: host.bus_health(name) for name in stats.buses},
            buses=stats.buses,
            streams=stats.patches,
            fields={name: host.latest(name) for name in stats.patches},
        )

    def events(self) -> list[HealthEvent]:
        return drain(self._events)

    @property
    def over(self) -> bool:
        return False

    @property
    def flaws(self) -> list[str]:
        return []

    def tare(self, patch: str) -> None:
        self._host.tare(patch)

    @property
    def recording(self) -> Recording | None:
        if self._recorder is None:
            return None
        stats = self._recorder.stats()
        return Recording(self._recorder.path, stats.frames, stats.dropped, stats.failure)

    def record(self, folder: Path) -> Path:
        recorder = Recorder(self.hand, folder)
        self._recorder, self._untap = recorder, self._host.tap(recorder)
        return recorder.path

    def stop_recording(self) -> Recording:
        recorder, untap = self._recorder, self._untap
        assert recorder is not None  # of a recording under way
        assert untap is not None
        untap()
        recorder.close()
        ended = self.recording
        assert ended is not None
        self._recorder = self._untap = None
        return ended

    def close(self) -> None:
        if self._recorder is not None:
            self.stop_recording()
        self._fields.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class ReplaySource:
    """A recording, played on a thread of its own from construction to :meth:`close`."""

    live = False

    def __init__(self, run: Replay) -> None:
        self.hand, self.title = run.hand, run.log.path.name
        self._run = run
        self._failure: SkinError | None = None
        self._running = ExitStack()
        self._tell = tell = Events()
        self._events: EventSubscription = tell.subscribe(_EVENTS)
        self._running.enter_context(HealthWatch(self._health, self._bus_health, tell))
        self._thread = threading.Thread(target=self._play, name="replay", daemon=True)
        self._thread.start()

    def snapshot(self) -> Snapshot:
        if self._failure is not None:
            raise self._failure
        return Snapshot(
            t_ns=self._run.clock(),
            health=self._health(),
            bus_health=self._bus_health(),
            buses=self._run.bus_stats(),
            streams=self._run.patch_stats(),
            fields={patch.name: self._run.publisher.latest(patch.name) for patch in self.hand.patches},
        )

    def events(self) -> list[HealthEvent]:
        return drain(self._events)

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    @property
    def flaws(self) -> list[str]:
        return self._run.flaws

    def tare(self, patch: str) -> None:
        raise SkinError("a recording cannot be tared")

    @property
    def recording(self) -> Recording | None:
        return None

    def record(self, folder: Path) -> Path:
        raise SkinError("this is a recording already")

    def stop_recording(self) -> Recording:
        raise SkinError("this is a recording already")

    def close(self) -> None:
        self._run.stop()
        self._thread.join()
        self._running.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _play(self) -> None:
        try:
            for _ in self._run:
                pass
            for flaw in self._run.flaws:
                self._tell.tell(HealthEvent(self._run.clock(), self.title, "recording", flaw))
        except Exception as error:  # it must reach the user, not die with the thread
            self._failure = error if isinstance(error, SkinError) else SkinError(f"replay: {error!r}")

    def _health(self) -> dict[str, PatchHealth]:
        return {patch.name: self._run.health(patch.name) for patch in self.hand.patches}

    def _bus_health(self) -> dict[str, BusHealth]:
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
            for name, stats in self._run.bus_stats().items()
        }


def drain(subscription: EventSubscription) -> list[HealthEvent]:
    """All events that wait. A closed host has one more item, which is none."""
    found: list[HealthEvent] = []
    while (event := subscription.get(0.0)) is not None:
        found.append(event)
    return found
