"""Publish changes in a hand's health as events to subscribers and in the log."""

from __future__ import annotations

import logging
import queue
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from skinnode.host.containment import Defects
from skinnode.host.drop_oldest_queue import DropOldestQueue, End
from skinnode.host.publish import check_capacity
from skinnode.process import clock

_log = logging.getLogger(__name__)

CAPACITY_EVENTS: Final = 1024
"""Default capacity of a subscriber's event queue; when the queue is full, the oldest event is dropped."""


@dataclass(frozen=True, slots=True)
class HealthEvent:
    """Change in the health of a patch, a bus or the host."""

    t_ns: int
    """Monotonic time of the change, ns."""
    subject: str
    """Subject of the event: name of a patch or bus, or ``host``."""
    what: str
    """Type of the event: a new condition, the name of the counter of :class:`PatchHealth` or
    :class:`BusHealth` that has increased, or ``defects``.
    """
    text: str
    """Human-readable description of the change; does not include the subject's name."""

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}"


class EventSubscription:
    """Subscription to a running host's events.

    Iterate over the subscription until the host closes, or use :meth:`get`. If the subscription's queue is
    full, the oldest event is dropped and counted in ``dropped``. Any thread may read.
    """

    def __init__(self, capacity: int) -> None:
        self._queue: DropOldestQueue[HealthEvent] = DropOldestQueue(capacity)
        self.dropped = 0

    def get(self, timeout_s: float | None = None) -> HealthEvent | None:
        """Wait for the next event and return it; return None on timeout or if the host closes.

        Args:
            timeout_s: Maximum time (s) to wait for an event; None for no limit.

        Returns:
            Next event; None if no event occurred before the timeout or the host has closed.
        """
        try:
            event = self._queue.get(timeout_s)
        except queue.Empty:
            return None
        return None if isinstance(event, End) else event

    def __iter__(self) -> Iterator[HealthEvent]:
        while (event := self.get()) is not None:
            yield event

    def offer(self, event: HealthEvent | End) -> None:
        """Queue an event or an end marker. Never blocks. Any thread."""
        self.dropped += self._queue.put(event)


class Events:
    """All subscriptions to a host's events. Only one thread may publish; any thread may subscribe."""

    def __init__(self, defects: Defects | None = None) -> None:
        self._defects = Defects("host") if defects is None else defects
        self._subscriptions: weakref.WeakSet[EventSubscription] = weakref.WeakSet()
        self._lock = clock.lock()  # guards the set of subscriptions against changes while it is copied
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
