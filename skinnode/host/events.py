"""Publish changes in a hand's health as events, to subscribers and to the log."""

from __future__ import annotations

import logging
import queue
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from skinnode.host.containment import Defects
from skinnode.host.drop_oldest_queue import DropOldestQueue, End
from skinnode.host.publish import check_capacity
from skinnode.process import clock

_log = logging.getLogger(__name__)

CAPACITY_EVENTS: Final = 1024
"""Default length of a subscriber's queue, in events."""

Severity = Literal["good", "note", "bad"]
_GOOD: Final = frozenset(
    (
        *("operational", "well", "back", "SYNC", "error active", "rejoins"),
        *("readmitted", "baselines", "touched", "released"),
    )
)
_NOTE: Final = frozenset(("booting", "boot_ups", "foreign", "noisy", "drifting", "left out"))
"""Event types that are not faults, or are not faults yet."""


@dataclass(frozen=True, slots=True)
class HealthEvent:
    """Change in the health of a patch, a bus or the host, or the onset or release of a touch."""

    t_ns: int
    """Monotonic time (ns) of the change. For a touch, this is the time of the scan that showed the change."""
    subject: str
    """Name of a patch or bus, or ``host``."""
    what: str
    """Type of the change, for example ``touched``, ``released``, a new condition, the name of an increased
    counter of :class:`PatchHealth` or :class:`BusHealth`, or ``defects``.
    """
    text: str
    """Human-readable description of the change, without the subject."""

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}"

    @property
    def severity(self) -> Severity:
        """Severity of the change: ``good``, ``note`` or ``bad``."""
        if self.what in _GOOD:
            return "good"
        return "note" if self.what in _NOTE else "bad"


class EventSubscription:
    """Subscription to a running host's events. Read it with ``for`` or :meth:`get`.

    The iteration ends when the host closes. A full queue drops its oldest event; ``dropped`` counts these
    events. Any thread may read.
    """

    def __init__(self, capacity: int) -> None:
        self._queue: DropOldestQueue[HealthEvent] = DropOldestQueue(capacity)
        self.dropped = 0
        self._ended = False

    @property
    def ended(self) -> bool:
        """Whether a reader has reached the end because the host has closed; :meth:`get` no longer waits."""
        return self._ended

    def get(self, timeout_s: float | None = None) -> HealthEvent | None:
        """Wait for the next event and return it.

        Args:
            timeout_s: Time limit (s); None for no limit.

        Returns:
            Next event; None on timeout or once the host has closed.
        """
        try:
            event = self._queue.get(timeout_s)
        except queue.Empty:
            return None
        if isinstance(event, End):
            self._ended = True
            return None
        return event

    def __iter__(self) -> Iterator[HealthEvent]:
        while (event := self.get()) is not None:
            yield event

    def offer(self, event: HealthEvent | End) -> None:
        """Queue an event or an end marker. Never blocks. Thread-safe."""
        self.dropped += self._queue.put(event)


class Events:
    """Subscriptions to a host's events. One thread may publish; any thread may subscribe."""

    def __init__(self, defects: Defects | None = None) -> None:
        self._defects = Defects("host") if defects is None else defects
        self._subscriptions: weakref.WeakSet[EventSubscription] = weakref.WeakSet()
        self._lock = clock.lock()  # protects the set of subscriptions while it is copied
        self._ended = False

    def subscribe(self, capacity: int) -> EventSubscription:
        """Create a subscription to all events.

        Raises:
            ValueError: if ``capacity`` is below 1.
        """
        check_capacity(capacity)
        subscription = EventSubscription(capacity)
        with self._lock:
            self._subscriptions.add(subscription)
            if self._ended:
                subscription.offer(End())
        return subscription

    def publish(self, event: HealthEvent) -> None:
        """Pass an event to all subscribers and to the log. Never raises."""
        try:
            _log.info("%s", event)
        except Exception as error:
            self._defects.report("logging an event", error)
        self._offer(event)

    def end(self) -> None:
        """End all subscriptions when the host closes."""
        self._ended = True
        self._offer(End())

    def _offer(self, event: HealthEvent | End) -> None:
        with self._lock:
            subscriptions = list(self._subscriptions)
        for subscription in subscriptions:
            try:
                subscription.offer(event)
            except Exception as error:
                self._defects.report("passing an event to a subscriber", error)
