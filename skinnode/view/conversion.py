"""Draws a complete recording to a file for later viewing, as fast as possible.

Unlike :mod:`skinnode.view.drawing_thread`, this module skips no fields: the replay waits for the drawing. All
times, including event times, are recording times.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from skinnode.config import HandConfig
from skinnode.host.events import Events
from skinnode.host.health_watch import HealthWatch
from skinnode.model.frames import FieldFrame
from skinnode.monitor.replay_source import bus_health_in, health_in, snapshot_of
from skinnode.monitor.session_faults import FaultBook
from skinnode.monitor.source import drain
from skinnode.monitor.view_model import History
from skinnode.record import Replay, replay
from skinnode.view.drawing_thread import RATE_HZ, STATE_S
from skinnode.view.texts import DrawnCounts
from skinnode.view.tick import SuppliedPositions, Tick

_CHECK_NS: Final = 50_000_000
"""Interval between health checks in recording time, in ns; the same as in a running host."""
_EVENTS: Final = 1024

Draw = Callable[[Tick], None]


class Conversion:
    """Conversion of a recording to a drawing; :meth:`run` performs it.

    Args:
        path: Log file of the recording.
        cancelled: Function called before each frame; the conversion ends when it returns True.
        hand: Hand for a log without a journal.

    Raises:
        ConfigError: The recording cannot be read.
    """

    def __init__(
        self,
        path: Path,
        cancelled: Callable[[], bool] = lambda: False,
        *,
        hand: HandConfig | None = None,
    ) -> None:
        self._cancelled = cancelled
        self.replay: Replay = replay(path, cancelled=self._before_frame, hand=hand)
        """The replay; its ``hand`` is the recorded hand."""
        self.faults = FaultBook(live=False)
        self._history = History(self.replay.hand, live=False, maps=False)
        self._positions = SuppliedPositions(self.replay.hand, self.replay.layout)
        events = Events()
        self._events = events.subscribe(_EVENTS)
        self._watch = HealthWatch(
            lambda: health_in(self.replay),
            lambda: bus_health_in(self.replay),
            events,
            touches=self.replay.publisher.touches.take,
            now_ns=self.replay.clock,
        )
        self._draw: Draw | None = None
        self._pending: dict[str, FieldFrame] = {}
        self._drawn = 0
        self._fields_since_ns = self._fields_ns = self._checked_ns = self._state_ns = 0

    @property
    def counts(self) -> DrawnCounts:
        """Field counts so far."""
        return DrawnCounts(self._drawn, 0, 0)

    def run(self, draw: Draw) -> None:
        """Draw all of the recording's fields, and the hand's state.

        Args:
            draw: Function that draws the data for one instant.
        """
        self._draw = draw
        for field in self.replay:
            assert field.stamp is not None
            if field.stamp.patch in self._pending or self._is_due():
                self._flush(ending=False)
            if not self._pending:
                self._fields_since_ns = self.replay.clock()
            self._pending[field.stamp.patch] = field
            self._fields_ns = self.replay.clock()
        self._watch.check()
        self._flush(ending=True)

    def _is_due(self) -> bool:
        return bool(self._pending) and self.replay.clock() - self._fields_since_ns >= 1e9 / RATE_HZ

    def _before_frame(self) -> bool:
        """Check the health and draw the state if either is due; return whether to end the conversion."""
        if self._cancelled():
            return True
        if self._draw is None:
            return False
        now_ns = self.replay.clock()
        if not self._checked_ns <= now_ns < self._checked_ns + _CHECK_NS:
            self._checked_ns = now_ns
            self._watch.check()
            if not self._state_ns <= now_ns < self._state_ns + STATE_S * 1e9 and now_ns:
                self._flush(ending=False, state=True)
            elif self._is_due():
                self._flush(ending=False)
        return False

    def _flush(self, *, ending: bool, state: bool = False) -> None:
        """Draw the pending fields, and the hand's state if ``ending`` or ``state`` is true."""
        assert self._draw is not None
        now_ns, view = self._fields_ns, None
        if state or ending:
            self._state_ns = now_ns = self.replay.clock()
            view = self._history.add(snapshot_of(self.replay))
            self.faults.update(view, now_ns, ending=ending)
        fields, self._pending = self._pending, {}
        self._drawn += len(fields)
        events = drain(self._events)
        self._draw(Tick(now_ns, fields, self.counts, view, events, self._positions.changed()))
