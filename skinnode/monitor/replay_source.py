"""Provides the data of a replayed recording to the monitor and the 3-D view."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from pathlib import Path

from skinnode.errors import SkinError
from skinnode.host import PatchHealth, Subscription
from skinnode.host.events import Events, EventSubscription, HealthEvent
from skinnode.host.health import BusHealth
from skinnode.host.health_watch import HealthWatch
from skinnode.model.layout import PatchLayout
from skinnode.monitor.source import QUEUED_EVENTS, Arrivals, Recording, Snapshot, drain, supplied_m
from skinnode.process.closing import Closing
from skinnode.record import Replay


class ReplaySource(Closing):
    """Data source that replays a recording on a separate thread, from construction until :meth:`close`."""

    live = False
    no_commands = "a recording accepts no commands"
    no_recording = "this is already a recording"

    def __init__(self, run: Replay) -> None:
        self.hand, self.title = run.hand, run.log.path.name
        self._run = run
        self._failure: SkinError | None = None
        self._running = ExitStack()
        self._all_events = events = Events()
        self._events: EventSubscription = events.subscribe(QUEUED_EVENTS)
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

    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields."""
        return self._run.layout(patch)

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
        raise SkinError(self.no_commands)

    def reset_node(self, patch: str) -> None:
        """Reset a patch's node."""
        raise SkinError(self.no_commands)

    @property
    def recording(self) -> Recording | None:
        """Progress of the recording being written; None if no recording is being written."""
        return None

    def record(self, folder: Path) -> Path:
        """Start a recording."""
        raise SkinError(self.no_recording)

    def stop_recording(self) -> Recording:
        """End the recording."""
        raise SkinError(self.no_recording)

    def close(self) -> None:
        """Release the source's resources."""
        self._run.stop()
        self._thread.join()
        self._running.close()

    def _play(self) -> None:
        try:
            for _ in self._run:
                pass
            self._running.close()  # checks the health once more, so that no event follows the end
            for flaw in self._run.flaws:
                self._all_events.publish(HealthEvent(self._run.clock(), self.title, "recording", flaw))
        except Exception as error:  # also report unexpected exceptions to the user
            self._failure = error if isinstance(error, SkinError) else SkinError(f"replay: {error!r}")


def snapshot_of(run: Replay) -> Snapshot:
    """Return the state of the hand at the current time of a replay.

    Args:
        run: The replay.
    """
    streams = run.patch_stats()
    return Snapshot(
        t_ns=run.clock(),
        health=health_in(run),
        bus_health=bus_health_in(run),
        fields={patch.name: run.publisher.latest(patch.name) for patch in run.hand.patches},
        arrivals={name: Arrivals(stream.solved) for name, stream in streams.items()},
        buses=run.bus_stats(),
        streams=streams,
        supplied_m=supplied_m(run.hand, run.layout),
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
