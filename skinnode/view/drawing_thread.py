"""Draws the newest fields of a running host or a replayed recording in a separate thread.

The host publishes to a bounded queue, which drops its oldest field when it is full. At most ``rate_hz`` times
per second, the thread takes the newest field of each patch. Slow or blocked drawing therefore does not affect
the host. The thread waits for a moment until the host has solved the newest scan of all patches. It then
runs while the host waits for the next SYNC, and the drawn fields belong to the same scan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skinnode.errors import SkinError
from skinnode.model.frames import FieldFrame
from skinnode.monitor.session_faults import FaultBook
from skinnode.monitor.source import Source
from skinnode.monitor.view_model import History
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.view.texts import DrawnCounts
from skinnode.view.tick import SuppliedPositions, Tick

RATE_HZ: Final = 30.0
"""Default limit on fields drawn per patch per second; screens show at most 60 frames per second."""
STATE_S: Final = 0.5
"""Interval between updates of the health, contact text and bus load, in s."""
_WAIT_S: Final = 1.0 / 60.0
"""Time limit for waiting until the newest scan of all patches is solved, in s."""
_POLL_S: Final = 0.002
_QUEUED: Final = 8
"""Capacity of the queue, in fields per patch."""


class DrawingThread(Closing):
    """Thread that draws the fields of a source, from construction until :meth:`close`.

    Args:
        source: Host, remote hand or recording; the caller closes it.
        draw: Function that draws the new data; called in this thread.
        rate_hz: Maximum number of fields drawn per patch per second.
    """

    def __init__(self, source: Source, draw: Callable[[Tick], None], *, rate_hz: float = RATE_HZ) -> None:
        self._source, self._draw, self._period_s = source, draw, 1.0 / rate_hz
        self.faults = FaultBook(live=source.live)
        self.failure: SkinError | None = None
        """Error from the source or the drawing; None if no error has occurred."""
        self._history = History(source.hand, live=source.live, maps=False)
        self._positions = SuppliedPositions(source.hand, source.layout)
        self._fields = source.fields(_QUEUED * len(source.hand.patches))
        self._recent: set[str] = set()
        """Patches drawn last time."""
        self._drawn = self._left_out = 0
        self._state_due_s = clock.monotonic()
        self._stop = clock.event()
        self._thread = clock.thread(target=self._run, name="draw")
        self._thread.start()

    @property
    def counts(self) -> DrawnCounts:
        """Field counts since the start."""
        return DrawnCounts(self._drawn, self._left_out, self._fields.dropped)

    def close(self) -> None:
        """Draw the fields still queued, then end and join the thread."""
        self._stop.set()
        self._thread.join()
        self._fields.close()

    def _run(self) -> None:
        ending = False
        due_s = clock.monotonic()
        try:
            while not ending:
                ending = self._stop.wait(max(0.0, due_s - clock.monotonic()))
                due_s = max(due_s + self._period_s, clock.monotonic())
                self._turn(ending=ending)
        except SkinError as error:
            self.failure = error
        except Exception as error:  # the host must keep running; the command reports the error
            self.failure = SkinError(f"drawing: {error!r}")

    def _turn(self, *, ending: bool) -> None:
        """Draw the newest field of each patch and, if due, the hand's state."""
        newest: dict[str, FieldFrame] = {}
        until_s = clock.monotonic() + _WAIT_S
        self._take(newest)
        while not (ending or self._complete(newest)) and clock.monotonic() < until_s:
            ending = self._stop.wait(_POLL_S)
            self._take(newest)
        self._recent = set(newest)
        now_s = clock.monotonic()
        due = ending or now_s >= self._state_due_s
        events = self._source.events()
        if not (newest or due or events):
            return
        self._drawn += len(newest)
        snapshot, view = self._source.snapshot() if due else None, None
        if snapshot is not None:
            self._state_due_s = now_s + STATE_S
            view = self._history.add(snapshot)
            self.faults.update(view, clock.monotonic_ns(), ending=ending or self._source.over)
        t_ns = self._source.now_ns() if snapshot is None else snapshot.t_ns
        self._draw(Tick(t_ns, newest, self.counts, view, events, self._positions.changed()))

    def _take(self, newest: dict[str, FieldFrame]) -> None:
        """Replace the fields in ``newest`` by the queued ones."""
        for _ in range(_QUEUED * len(self._source.hand.patches)):  # a fast host must not keep the loop busy
            field = self._fields.get(0.0)
            if field is None:
                break
            assert field.stamp is not None
            self._left_out += field.stamp.patch in newest
            newest[field.stamp.patch] = field

    def _complete(self, newest: dict[str, FieldFrame]) -> bool:
        """Return whether the fields of all patches drawn last time are there, all of the same scan."""
        scans = {field.stamp.scan for field in newest.values() if field.stamp is not None}
        return len(scans) <= 1 and newest.keys() >= self._recent
