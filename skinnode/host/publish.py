"""Pass fields from the worker threads to the subscribers' bounded queues."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import queue
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from types import TracebackType
from typing import Self

from skinnode.errors import SkinError
from skinnode.host.containment import Defects
from skinnode.host.drop_oldest_queue import DropOldestQueue, End
from skinnode.model.frames import FieldFrame


def check_timeout(timeout_s: float | None) -> None:
    """Check a timeout.

    Raises:
        ValueError: if the timeout is negative, is not a number, or exceeds the operating system's limit.
    """
    if timeout_s is not None and not 0 <= timeout_s <= threading.TIMEOUT_MAX:
        raise ValueError(f"timeout_s: got {timeout_s!r}, must be from 0 to {threading.TIMEOUT_MAX:.0f}")


def check_capacity(capacity: int) -> None:
    """Check the capacity of a queue.

    Raises:
        ValueError: if the capacity is not an integer of at least 1.
    """
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity: got {capacity!r}, must be an integer of at least 1")


class Subscription:
    """Subscription to fields.

    Read the fields in order of publication with ``for``, ``async for`` or :meth:`get`.

    If the subscription's queue is full, its oldest field is dropped and counted in ``dropped``. The
    subscription ends when :meth:`close` is called, a ``with`` block exits, or the last reference to the
    subscription is deleted. Any thread or event loop may read the subscription.
    """

    def __init__(self, capacity: int, timeout_s: float | None, patches: frozenset[str]) -> None:
        self._queue: DropOldestQueue[FieldFrame] = DropOldestQueue(capacity)
        self._timeout_s = timeout_s
        self._subscribed = patches
        # Each patch has its own counter, so no two workers write the same counter at the same time.
        self._dropped = dict.fromkeys([*patches, ""], 0)
        self._wakers: dict[object, Callable[[], object]] = {}  # one wake-up function per waiting event loop

    @property
    def dropped(self) -> int:
        """Number of fields lost because this subscriber was too slow."""
        return sum(self._dropped.values())

    def get(self, timeout_s: float | None = None) -> FieldFrame | None:
        """Wait for the next field and return it.

        Args:
            timeout_s: Maximum time (s) to wait for a field; None for no limit.

        Returns:
            Next field; None if no field arrived before the timeout or the host has closed.

        Raises:
            SkinError: the error that stopped the host, if any.
        """
        try:
            return self.take(timeout_s)
        except queue.Empty:
            return None

    def take(self, timeout_s: float | None) -> FieldFrame | None:
        """Return the next field, or None if the host has closed.

        Raises:
            queue.Empty: if no field arrived within ``timeout_s``.
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
                    await asyncio.sleep(0)  # yield to other tasks even if fields arrive continuously
                    arrived.clear()
                    try:
                        return self._open(self._queue.get(0.0))
                    except queue.Empty:
                        await arrived.wait()
        except TimeoutError:
            if not limit.expired():  # a TimeoutError stopped the host; the wait itself has not timed out
                raise
            raise queue.Empty from None
        finally:
            del self._wakers[key]

    def close(self) -> None:
        """Stop accepting fields. Queued fields are discarded."""
        self._subscribed = frozenset()

    def end(self) -> None:
        """Stop accepting fields; the reader's loop ends after the last queued field. Any thread."""
        self.close()
        self.offer(End(), "")

    def __iter__(self) -> Iterator[FieldFrame]:
        """Yield fields until the host closes.

        Raises:
            TimeoutError: if no field arrived within the subscription's timeout.
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
        """Yield fields until the host closes; asynchronous version of :meth:`__iter__`."""
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def offer(self, item: FieldFrame | End, patch: str) -> None:
        """Queue an end marker or a field of a subscribed patch; ignore the fields of other patches.

        Never blocks. Any thread.
        """
        if patch and patch not in self._subscribed:
            return
        self._dropped[patch] += self._queue.put(item)
        self._wake()

    def _open(self, item: FieldFrame | End) -> FieldFrame | None:
        if isinstance(item, FieldFrame):
            return item
        self._wake()  # wake the other readers: every reader must receive the end marker
        if item.error is not None:
            raise item.error
        return None

    def _wake(self) -> None:
        for wake in list(self._wakers.values()):
            wake()


class Publisher:
    """All subscriptions of a host, and the newest field of each patch.

    Exceptions raised while passing a field to a subscriber are reported to ``defects``; only that subscriber
    loses the field.

    Threads: only worker threads may publish fields, and only one worker per patch at a time. All other
        methods may be called from any thread.
    """

    def __init__(self, patches: tuple[str, ...], defects: Defects | None = None) -> None:
        self._patches = frozenset(patches)
        self._defects = Defects("host") if defects is None else defects
        self._latest: dict[str, FieldFrame] = {}
        self._subscriptions: dict[int, weakref.ref[Subscription]] = {}
        self._keys = itertools.count()
        self._last: End | None = None

    def subscribe(self, capacity: int, timeout_s: float | None, patch: str | None) -> Subscription:
        """Create a subscription to the fields of one patch, or of all patches if ``patch`` is None.

        Raises:
            ValueError: if the capacity is below 1, the timeout is out of range, or there is no such patch.
        """
        check_capacity(capacity)
        check_timeout(timeout_s)
        if patch is not None and patch not in self._patches:
            raise ValueError(f"patch: got {patch!r}, must be one of {', '.join(sorted(self._patches))}")
        chosen = self._patches if patch is None else frozenset([patch])
        subscription = Subscription(capacity, timeout_s, chosen)
        key = next(self._keys)
        # No lock is needed, because setting and removing a dict item are atomic, and readers copy the dict.
        forget = self._subscriptions
        self._subscriptions[key] = weakref.ref(subscription, lambda _: forget.pop(key, None))
        if self._last is not None:
            subscription.offer(self._last, "")
        return subscription

    def latest(self, patch: str) -> FieldFrame | None:
        """Return a patch's newest field, or None if no field has been published yet.

        Raises:
            ValueError: if there is no such patch.
        """
        if patch not in self._patches:
            raise ValueError(f"patch: got {patch!r}, must be one of {', '.join(sorted(self._patches))}")
        return self._latest.get(patch)

    def publish(self, field: FieldFrame, patch: str) -> None:
        """Pass a field to its subscribers.

        Only the worker that is processing the patch may call this method. Never blocks.
        """
        self._latest[patch] = field
        self._offer(field, patch)

    @property
    def failure(self) -> SkinError | None:
        """Error that stopped the host; None if the host is running or was closed normally."""
        return None if self._last is None else self._last.error

    def fail(self, error: SkinError) -> None:
        """Raise ``error`` in every subscription after its queued fields, because the host has failed."""
        self._last = self._last or End(error)
        self._offer(self._last, "")

    def end(self) -> None:
        """End every subscription after its queued fields. Call when the host closes."""
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
