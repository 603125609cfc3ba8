"""A hand frame: the fields of all patches of one SYNC. Gathered by whoever reads, out of the fields as they
come; no thread of its own."""

from __future__ import annotations

import queue
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from skinnode.host.health import SCANS_MISSED, Condition
from skinnode.host.publish import Subscription, check_timeout
from skinnode.model.frames import FieldFrame

LATE: Final = "late"
"""Nothing came in time from a patch that is well."""
OVERTAKEN: Final = "overtaken"
"""A newer scan of the patch was there first."""


@dataclass(frozen=True, slots=True, eq=False)
class HandFrame:
    """All patches at one SYNC."""

    scan: int
    """Number of the SYNC since the host started, unwrapped: the scan number of every field."""
    t_sync_ns: int
    """When it was sent or seen on the last of the buses, monotonic; 0 where it was not. Each field has the
    time of its own (``sync.stagger_ms``)."""
    fields: Mapping[str, FieldFrame]
    """By patch."""
    missing: Mapping[str, str]
    """Why a patch is not among them: :data:`LATE`, :data:`OVERTAKEN`, or the condition it is in, such as
    ``lost``."""

    @property
    def complete(self) -> bool:
        """Whether every patch is there."""
        return not self.missing


class HandGatherer:
    """Fields in, hand frames out, in ascending order. Plain code with one owner; times are those handed in.

    A frame is ready when every patch that is waited for has given a field of it or a newer one. A patch that
    gave none for :data:`~skinnode.host.health.SCANS_MISSED` frames running is not waited for until it gives
    one again, nobody longer than ``patience_ns`` after the first field.
    """

    def __init__(
        self, patches: Sequence[str], patience_ns: int, condition: Callable[[str], Condition]
    ) -> None:
        self._patches, self._patience_ns, self._condition = tuple(patches), patience_ns, condition
        self._open: dict[int, dict[str, FieldFrame]] = {}
        self._until_ns: dict[int, int] = {}
        self._newest = dict.fromkeys(self._patches, 0)
        self._absences = dict.fromkeys(self._patches, 0)
        self._told = 0
        self.late = 0
        """Fields that came when the frame they belong to was out."""

    def add(self, field: FieldFrame, now_ns: int) -> None:
        """Take a field."""
        stamp = field.stamp
        assert stamp is not None
        self._newest[stamp.patch] = stamp.scan
        self._absences[stamp.patch] = 0
        if stamp.scan <= self._told:
            self.late += 1
            return
        self._open.setdefault(stamp.scan, {})[stamp.patch] = field
        self._until_ns.setdefault(stamp.scan, now_ns + self._patience_ns)

    def next(self, now_ns: int) -> HandFrame | None:
        """The oldest frame, if it is ready."""
        if not self._open:
            return None
        scan = min(self._open)
        if now_ns < self._until_ns[scan] and any(self._awaited(patch, scan) for patch in self._patches):
            return None
        fields = self._open.pop(scan)
        del self._until_ns[scan]
        self._told = scan
        absent = [patch for patch in self._patches if patch not in fields]
        for patch in absent:
            self._absences[patch] += 1
        stamps = [field.stamp for field in fields.values() if field.stamp is not None]
        t_sync_ns = max(stamp.t_sync_ns for stamp in stamps)
        return HandFrame(scan, t_sync_ns, fields, {patch: self._reason(patch, scan) for patch in absent})

    def next_deadline_ns(self) -> int | None:
        """When :meth:`next` has a frame if no field comes before; None while there is none begun."""
        return self._until_ns[min(self._open)] if self._open else None

    def _awaited(self, patch: str, scan: int) -> bool:
        return self._newest[patch] < scan and self._absences[patch] < SCANS_MISSED

    def _reason(self, patch: str, scan: int) -> str:
        if self._newest[patch] > scan:
            return OVERTAKEN
        condition = self._condition(patch)
        return LATE if condition is Condition.OPERATIONAL else str(condition)


class HandSubscription:
    """The hand frames of a running host. Iterate over it with ``for`` or ``async for``, or ask with
    :meth:`get`. Whoever is slow loses the oldest fields, counted in ``dropped``, and then has hand frames
    with patches missing."""

    def __init__(self, fields: Subscription, gatherer: HandGatherer, timeout_s: float | None) -> None:
        check_timeout(timeout_s)
        self._fields, self._gatherer, self._timeout_s = fields, gatherer, timeout_s

    @property
    def dropped(self) -> int:
        """Fields lost because this subscriber was too slow."""
        return self._fields.dropped

    @property
    def late(self) -> int:
        """Fields that came when the frame they belong to was out."""
        return self._gatherer.late

    def get(self, timeout_s: float | None = None) -> HandFrame | None:
        """The next frame, or None after ``timeout_s``, or None when the host has closed. Raises the SkinError
        that stopped the host, if one did."""
        try:
            return self._next(timeout_s)
        except queue.Empty:
            return None

    def close(self) -> None:
        """Want no more."""
        self._fields.close()

    def __iter__(self) -> Iterator[HandFrame]:
        """Frames until the host closes. Raises TimeoutError when none came for the subscription's timeout and
        the SkinError that stopped the host, if one did."""
        while True:
            try:
                frame = self._next(self._timeout_s)
            except queue.Empty:
                raise self._too_long() from None
            if frame is None:
                return
            yield frame

    async def __aiter__(self) -> AsyncIterator[HandFrame]:
        """As ``for``, in an event loop."""
        while True:
            end_ns = _end_ns(self._timeout_s)
            while (frame := self._gatherer.next(time.monotonic_ns())) is None:
                try:
                    field = await self._fields.take_async(self._wait_s(end_ns))
                except queue.Empty:
                    if end_ns is not None and time.monotonic_ns() >= end_ns:
                        raise self._too_long() from None
                    continue
                if field is None:
                    return
                self._gatherer.add(field, time.monotonic_ns())
            yield frame

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _next(self, timeout_s: float | None) -> HandFrame | None:
        """Raises queue.Empty after ``timeout_s``."""
        check_timeout(timeout_s)
        end_ns = _end_ns(timeout_s)
        while (frame := self._gatherer.next(time.monotonic_ns())) is None:
            try:
                field = self._fields.take(self._wait_s(end_ns))
            except queue.Empty:
                if end_ns is not None and time.monotonic_ns() >= end_ns:
                    raise
                continue
            if field is None:
                return None
            self._gatherer.add(field, time.monotonic_ns())
        return frame

    def _wait_s(self, end_ns: int | None) -> float | None:
        """Until there is something to do."""
        times = [t_ns for t_ns in (end_ns, self._gatherer.next_deadline_ns()) if t_ns is not None]
        return max(0, min(times) - time.monotonic_ns()) * 1e-9 if times else None

    def _too_long(self) -> TimeoutError:
        return TimeoutError(f"no hand frame within {self._timeout_s} s")


def _end_ns(timeout_s: float | None) -> int | None:
    return None if timeout_s is None else time.monotonic_ns() + int(timeout_s * 1e9)
