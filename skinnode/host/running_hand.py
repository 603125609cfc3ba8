"""Define an interface to a running hand that does not depend on which process runs the hand."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from skinnode.config import HandConfig
from skinnode.host.callback import Callbacks, FieldCallback
from skinnode.host.events import CAPACITY_EVENTS, Events, EventSubscription
from skinnode.host.hand_frame import HandGatherer, HandSubscription, require_one_sync
from skinnode.host.health import BusHealth, PatchHealth
from skinnode.host.publish import Publisher, Subscription
from skinnode.host.skeleton import Skeleton
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout


class RunningHand(ABC):
    """Running hand: :class:`skinnode.Host` if this process runs it, otherwise :class:`skinnode.RemoteHand`.

    Threads: any thread may call any method.

    Args:
        hand: Configuration of the hand.
        publisher: Subscriptions to fields, and the newest fields.
        events: Subscriptions to events.
        callbacks: Functions that are called with each field.
    """

    def __init__(self, hand: HandConfig, publisher: Publisher, events: Events, callbacks: Callbacks) -> None:
        self.hand = hand
        self._publisher, self._events, self._callbacks = publisher, events, callbacks

    def fields(
        self, *, timeout_s: float | None = None, capacity: int | None = None, patch: str | None = None
    ) -> Subscription:
        """Subscribe to the fields of all scans from now on.

        Iterate over the subscription with ``for`` or ``async for``.

        Args:
            timeout_s: Maximum time (s) to wait for a field before the iteration raises TimeoutError; None for
                no limit.
            capacity: Queue length, in fields; by default, the capacity in the hand file. A full queue drops
                its oldest field.
            patch: Name of the patch; all patches by default.

        Raises:
            ValueError: if there is no such patch, or ``capacity`` or ``timeout_s`` is out of range.
        """
        kept = self.hand.stream.capacity_fields if capacity is None else capacity
        return self._publisher.subscribe(kept, timeout_s, patch)

    def hands(self, *, timeout_s: float | None = None, capacity: int | None = None) -> HandSubscription:
        """Subscribe to hand frames. A hand frame combines the fields of all patches for one SYNC.

        Iterate over the subscription with ``for`` or ``async for``. A hand frame is delivered at most two
        SYNC periods after its first field. Delivery does not wait for absent patches.

        Args:
            timeout_s: Maximum time (s) to wait for a hand frame before the iteration raises TimeoutError;
                None for no limit.
            capacity: Queue length, in hand frames; by default, the capacity in the hand file.

        Raises:
            ValueError: if the buses of the hand have several SYNC producers, or SYNC has no counter.
        """
        require_one_sync(self.hand)
        patches = [patch.name for patch in self.hand.patches]
        kept = (self.hand.stream.capacity_fields if capacity is None else capacity) * len(patches)
        patience_ns = 2 * self.hand.sync.period_ms * 1_000_000
        gatherer = HandGatherer(
            patches, patience_ns, lambda patch: self.health(patch).condition, Skeleton.of(self.hand)
        )
        return HandSubscription(self.fields(capacity=kept), gatherer, timeout_s)

    def on_field(
        self,
        function: Callable[[FieldFrame], object],
        *,
        patch: str | None = None,
        capacity: int | None = None,
    ) -> FieldCallback:
        """Call ``function`` with each new field, on a separate thread.

        The calls end when the hand closes or the callback's ``close()`` is called. A function that blocks or
        raises an exception does not affect other subscribers. The callback counts the fields that it loses.

        Args:
            function: Function to call with each field.
            patch: Name of the patch; all patches by default.
            capacity: Queue length, in fields; by default, the capacity in the hand file.

        Raises:
            TypeError: if ``function`` is not callable, or is async.
            ValueError: if there is no such patch, or ``capacity`` is out of range.
        """
        return self._callbacks.add(function, self.fields(capacity=capacity, patch=patch))

    def latest(self, patch: str) -> FieldFrame | None:
        """Return a patch's newest field without waiting; None before the first field.

        Raises:
            ValueError: if there is no such patch.
        """
        return self._publisher.latest(patch)

    def events(self, *, capacity: int = CAPACITY_EVENTS) -> EventSubscription:
        """Subscribe to touches, and to changes in the health of patches, wires and buses.

        A remote hand also publishes ``away`` and ``back`` events about its daemon, with the subject ``host``.

        Args:
            capacity: Queue length, in events. A full queue drops its oldest event.

        Raises:
            ValueError: if ``capacity`` is below 1.
        """
        return self._events.subscribe(capacity)

    @abstractmethod
    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields.

        Raises:
            KeyError: if there is no such patch.
        """

    @abstractmethod
    def health(self, patch: str) -> PatchHealth:
        """Return the health of a patch.

        Raises:
            KeyError: if there is no such patch.
        """

    @abstractmethod
    def bus_health(self, bus: str) -> BusHealth:
        """Return the health of a bus.

        Raises:
            KeyError: if there is no such bus, or the bus has no patches.
        """

    @abstractmethod
    def tare(self, patch: str, *, deadline_s: float | None = None) -> None:
        """Tare a patch: make its current resistances the baseline.

        Args:
            patch: Name of the patch.
            deadline_s: Time limit (s) for the new baseline; 5 s plus three SYNC periods by default.

        Raises:
            KeyError: if there is no such patch.
            ValueError: if ``deadline_s`` is negative, above 600 s or not a number.
            SkinError: if the patch cannot be tared.
        """

    @abstractmethod
    def reset_node(self, patch: str) -> None:
        """Reset a patch's node (NMT *reset node*). Once the node has booted, the host brings it up again.

        Args:
            patch: Name of the patch.

        Raises:
            KeyError: if there is no such patch.
            SkinError: if the node cannot be reset.
        """
