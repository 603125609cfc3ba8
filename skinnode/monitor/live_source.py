"""Provides data from a running hand (a host or a remote hand) to the monitor and the 3-D view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skinnode.errors import SkinError
from skinnode.host import Host, RunningHand, Subscription
from skinnode.host.dispatcher import BusStats
from skinnode.host.events import HealthEvent
from skinnode.host.patch_stream import StreamStats
from skinnode.model.layout import PatchLayout
from skinnode.monitor.source import QUEUED_EVENTS, Arrivals, Recording, Snapshot, drain, supplied_m
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.record import Recorder
from skinnode.text.words import counted

if TYPE_CHECKING:
    from skinnode.remote import RemoteHand

_CAPACITY: Final = 1


class LiveSource(Closing):
    """Data source for a running hand; the caller must close the hand.

    Args:
        running: The running hand.
        title: Title of the screen.
    """

    live = True
    over = False

    def __init__(self, running: RunningHand, title: str) -> None:
        self.hand, self.title = running.hand, title
        self._running = running
        self._events = running.events(capacity=QUEUED_EVENTS)
        self._fields = running.fields(capacity=_CAPACITY)  # also receives the error that stops the hand

    def events(self) -> list[HealthEvent]:
        """Return the events that have occurred since the last call."""
        return drain(self._events)

    def fields(self, capacity: int) -> Subscription:
        """Subscribe to the fields of all patches."""
        return self._running.fields(capacity=capacity)

    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields."""
        return self._running.layout(patch)

    def now_ns(self) -> int:
        """Return the current time in ns."""
        return clock.monotonic_ns()

    @property
    def wall_minus_mono_ns(self) -> int:
        """Wall-clock time minus monotonic time, in ns."""
        return clock.time_ns() - clock.monotonic_ns()

    @property
    def flaws(self) -> list[str]:
        """Flaws in the recording."""
        return []

    def tare(self, patch: str) -> None:
        """Tare a patch."""
        self._running.tare(patch)

    def reset_node(self, patch: str) -> None:
        """Reset a patch's node."""
        self._running.reset_node(patch)

    def close(self) -> None:
        """Release the source's resources."""
        self._fields.close()

    def _snapshot(
        self,
        arrivals: Mapping[str, Arrivals],
        buses: Mapping[str, BusStats],
        streams: Mapping[str, StreamStats],
        away: str | None = None,
    ) -> Snapshot:
        """Return the current state of the hand, given the data specific to a host or a remote hand.

        Raises the SkinError that stopped the hand, if any.
        """
        for _ in range(_CAPACITY + 1):  # if the hand has failed, the last item in the queue is the error
            self._fields.get(0.0)
        running, names = self._running, [patch.name for patch in self.hand.patches]
        return Snapshot(
            t_ns=clock.monotonic_ns(),
            health={name: running.health(name) for name in names},
            bus_health={bus.name: running.bus_health(bus.name) for bus in self.hand.served_buses},
            fields={name: running.latest(name) for name in names},
            arrivals=arrivals,
            buses=buses,
            streams=streams,
            supplied_m=supplied_m(self.hand, running.layout),
            away=away,
        )


class HostSource(LiveSource):
    """Data source for a host in this process.

    Args:
        host: Running host.
    """

    no_commands = None
    no_recording = None

    def __init__(self, host: Host) -> None:
        super().__init__(host, host.hand.name)
        self._host = host
        self._lost: list[str] = []  # what is missing from the recordings that have ended
        self._recorder: Recorder | None = None
        self._untap: Callable[[], None] | None = None

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand."""
        stats = self._host.stats()
        arrivals = {name: Arrivals(stream.solved) for name, stream in stats.patches.items()}
        return self._snapshot(arrivals, stats.buses, stats.patches)

    @property
    def flaws(self) -> list[str]:
        """Failures of the recordings that have ended, and the number of frames missing from each."""
        return list(self._lost)

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
        if ended.failure is not None:
            self._lost.append(ended.failure)
        if ended.dropped:
            self._lost.append(f"{ended.path}: {counted(ended.dropped, 'frame')} not recorded")
        self._recorder = self._untap = None
        return ended

    def close(self) -> None:
        """Release the source's resources."""
        if self._recorder is not None:
            self.stop_recording()
        super().close()


class RemoteSource(LiveSource):
    """Data source for a hand that another process publishes.

    Args:
        remote: Connection to the hand.
    """

    no_recording = "a remote hand cannot be recorded: run skinnode record --listen on its machine"
    recording = None

    def __init__(self, remote: RemoteHand) -> None:
        super().__init__(remote, f"{remote.hand.name} (remote)")
        self._remote = remote

    def snapshot(self) -> Snapshot:
        """Return the current state of the hand."""
        remote = self._remote
        arrivals = {
            name: Arrivals(counts.received, counts.lost, counts.delay_s if counts.received else None)
            for name, counts in remote.stats().patches.items()
        }
        return self._snapshot(arrivals, {}, {}, remote.away)

    @property
    def no_commands(self) -> str | None:
        """Reason why the daemon does not accept commands; None if it accepts them."""
        return self._remote.no_commands

    def record(self, folder: Path) -> Path:
        """Start a recording."""
        raise SkinError(self.no_recording)

    def stop_recording(self) -> Recording:
        """End the recording."""
        raise SkinError(self.no_recording)
