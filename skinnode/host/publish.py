"""Pass fields from the worker threads to the subscribers' bounded queues."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import queue
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Iterator

from skinnode.errors import SkinError
from skinnode.host.containment import Defects
from skinnode.host.drop_oldest_queue import DropOldestQueue, End
from skinnode.host.touch_changes import TouchChanges
from skinnode.model.frames import FieldFrame
from skinnode.process.closing import Closing


def check_timeout(timeout_s: float | None) -> None:
    """Check a timeout.

    Raises:
        ValueError: if the timeout is negative, not a number, or above the operating system's limit.
    """
    if timeout_s is not None and not 0 <= timeout_s <= threading.TIMEOUT_MAX:
        raise ValueError(f"timeout_s: got {timeout_s!r}, must be from 0 to {threading.TIMEOUT_MAX:.0f}")


def check_capacity(capacity: int) -> None:
    """Check a queue's capacity.

    Raises:
        ValueError: if the capacity is not a positive integer.
    """
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity: got {capacity!r}, must be an integer of at least 1")


class Subscription(Closing):
    """Subscription to fields. Read it with ``for``, ``async for`` or :meth:`get`.

    Fields are delivered in publication order. A full queue drops its oldest field; ``dropped`` counts these
    fields. A subscription accepts fields until it is closed, its ``with`` block exits or the last reference
    to it is deleted. Any thread or event loop may read it.
    """

    def __init__(self, capacity: int, timeout_s: float | None, patches: frozenset[str]) -> None:
        self._queue: DropOldestQueue[FieldFrame] = DropOldestQueue(capacity)
        self._timeout_s = timeout_s
        self._subscribed = patches
        # One counter per patch, because only one worker at a time publishes a patch's fields.
        self._dropped = dict.fromkeys([*patches, ""], 0)
        self._wakers: dict[object, Callable[[], object]] = {}  # one wake-up function per waiting task

    @property
    def dropped(self) -> int:
        """Number of fields lost because the subscriber was too slow."""
        return sum(self._dropped.values())

    def get(self, timeout_s: float | None = None) -> FieldFrame | None:
        """Wait for the next field and return it.

        Args:
            timeout_s: Time limit (s); None for no limit.

        Returns:
            Next field; None on timeout, or once the host or the subscription has closed.

        Raises:
            SkinError: the error that stopped the host, if any.
        """
        try:
            return self.take(timeout_s)
        except queue.Empty:
            return None

    def take(self, timeout_s: float | None) -> FieldFrame | None:
        """Return the next field; None once the host or the subscription has closed.

        Raises:
            queue.Empty: if no field arrives within ``timeout_s``.
            SkinError: the error that stopped the host, if any.
        """
        check_timeout(timeout_s)
        return self._open(self._queue.get(timeout_s))

    async def take_async(self, timeout_s: float | None) -> FieldFrame | None:
        """Return the next field; asynchronous version of :meth:`take`."""
        check_timeout(timeout_s)
        loop, arrived, key = asyncio.get_running_loop(), asyncio.Event(), object()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the event loop has closed
                loop.call_soon_threadsafe(arrived.set)

        self._wakers[key] = wake
        limit = asyncio.timeout(timeout_s)
        try:
            async with limit:
                while True:
                    await asyncio.sleep(0)  # let other tasks run even if a field is always waiting
                    arrived.clear()
                    try:
                        return self._open(self._queue.get(0.0))
                    except queue.Empty:
                        await arrived.wait()
        except TimeoutError:
            if not limit.expired():  # the error that stopped the host is a TimeoutError
                raise
            return self._open(self._queue.get(0.0))  # a field may have been waiting from the start
        finally:
            del self._wakers[key]

    def close(self) -> None:
        """Stop accepting fields, and end the readers' loops after the last queued field. Thread-safe."""
        self._subscribed = frozenset()
        self.offer(End(), "")

    def __iter__(self) -> Iterator[FieldFrame]:
        """Yield fields until the host or the subscription closes.

        Raises:
            TimeoutError: if no field arrives within the subscription's timeout.
            SkinError: the error that stopped the host, if any.
        """
        while True:
            try:
                field = self.take(self._timeout_s)
            except queue.Empty:
                raise self._too_long() from None
            if field is None:
                return
            yield field

    async def __aiter__(self) -> AsyncIterator[FieldFrame]:
        """Yield fields until the host or the subscription closes.

        Asynchronous version of :meth:`__iter__`.
        """
        while True:
            try:
                field = await self.take_async(self._timeout_s)
            except queue.Empty:
                raise self._too_long() from None
            if field is None:
                return
            yield field

    def _too_long(self) -> TimeoutError:
        return TimeoutError(f"no field within {self._timeout_s} s")

    def offer(self, item: FieldFrame | End, patch: str) -> None:
        """Queue a field of a subscribed patch, or an end marker. Thread-safe.

        Never blocks.
        """
        if patch and patch not in self._subscribed:
            return
        self._dropped[patch] += self._queue.put(item)
        self._wake()

    def _open(self, item: FieldFrame | End) -> FieldFrame | None:
        if isinstance(item, FieldFrame):
            return item
        self._wake()  # every reader must get the end marker
        if item.error is not None:
            raise item.error
        return None

    def _wake(self) -> None:
        for wake in list(self._wakers.values()):
            wake()


class Publisher:
    """A host's subscriptions, and the newest field of each patch.

    If passing a field to a subscriber raises an exception, only that subscriber loses the field. The
    exception is reported to ``defects``.

    Threads: only workers may publish, one at a time per patch. Any thread may call the other methods.

    Attributes:
        touches: Onsets and releases of touches in the published fields.
    """

    def __init__(self, patches: tuple[str, ...], defects: Defects | None = None) -> None:
        self._patches = frozenset(patches)
        self._defects = Defects("host") if defects is None else defects
        self._latest: dict[str, FieldFrame] = {}
        self._subscriptions: dict[int, weakref.ref[Subscription]] = {}
        self._keys = itertools.count()
        self._last: End | None = None
        self.touches = TouchChanges()

    def subscribe(self, capacity: int, timeout_s: float | None, patch: str | None) -> Subscription:
        """Create a subscription to the fields of one patch, or of all patches if ``patch`` is None.

        Raises:
            ValueError: if ``capacity`` or ``timeout_s`` is out of range, or there is no such patch.
        """
        check_capacity(capacity)
        check_timeout(timeout_s)
        if patch is not None and patch not in self._patches:
            raise ValueError(f"patch: got {patch!r}, must be one of {', '.join(sorted(self._patches))}")
        chosen = self._patches if patch is None else frozenset([patch])
        subscription = Subscription(capacity, timeout_s, chosen)
        key = next(self._keys)
        # No lock is needed: setting and removing dict items is atomic, and readers copy the dict.
        forget = self._subscriptions
        self._subscriptions[key] = weakref.ref(subscription, lambda _: forget.pop(key, None))
        if self._last is not None:
            subscription.offer(self._last, "")
        return subscription

    def latest(self, patch: str) -> FieldFrame | None:
        """Return a patch's newest field; None before the first field.

        Raises:
            ValueError: if there is no such patch.
        """
        if patch not in self._patches:
            raise ValueError(f"patch: got {patch!r}, must be one of {', '.join(sorted(self._patches))}")
        return self._latest.get(patch)

    def publish(self, field: FieldFrame, patch: str) -> None:
        """Pass a field to its subscribers. Never blocks.

        Only the worker that is processing the patch may call this method.
        """
        self._latest[patch] = field
        self.touches.on_field(field, patch)
        self._offer(field, patch)

    @property
    def failure(self) -> SkinError | None:
        """Error that stopped the host; None if the host is running or has been closed."""
        return None if self._last is None else self._last.error

    def fail(self, error: SkinError) -> None:
        """Make every subscription raise ``error`` after its queued fields, because the host has failed."""
        self._last = self._last or End(error)
        self._offer(self._last, "")

    def end(self) -> None:
        """End every subscription after its queued fields, because the host is closing."""
        self._last = self._last or End()
        self._offer(self._last, "")

    def _offer(self, item: FieldFrame | End, patch: str) -> None:
        for reference in list(self._subscriptions.values()):
            subscription = reference()
            if subscription is None:
                continue
            try:
                subscription.offer(item, patch)
            except Exception as error:
                self._defects.report("passing a field to a subscriber", error)
