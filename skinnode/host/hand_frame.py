"""Combine the fields of all patches for one SYNC into a hand frame.

The thread that reads the hand frames also assembles them.
"""

from __future__ import annotations

import functools
import queue
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.host.health import SCANS_MISSED, Condition
from skinnode.host.publish import Subscription, check_timeout
from skinnode.host.skeleton import Skeleton
from skinnode.model.distrust_text import why_not
from skinnode.model.frames import FieldFrame
from skinnode.model.hand_contact import HAND, HandContact, Wrench, wrench_of
from skinnode.model.pose import Pose
from skinnode.process import clock
from skinnode.process.closing import Closing

LATE: Final = "late"
"""Reason for a missing field: the patch is operational, but its field did not arrive before the deadline or
the end."""
OVERTAKEN: Final = "overtaken"
"""Reason for a missing field: the patch has already delivered the field of a newer scan."""

_Number = tuple[int, int]
"""Run and scan number. Scan numbers restart in each run."""
_BEFORE: Final = (0, 0)
"""Run and scan number that precede those of all scans."""


@dataclass(frozen=True, eq=False)
class HandFrame:
    """Fields and contacts of all patches for one SYNC.

    Contacts and wrenches are given in the coordinate frames of the links and of the hand. They are computed
    on first access.
    """

    scan: int
    """Scan number of all fields: the SYNC number, counted from the start of the host. It does not wrap
    around. In a remote hand, numbering restarts with the daemon; ``stamp.run`` of the fields then increases.
    """
    t_sync_ns: int
    """Monotonic time (ns) of the SYNC; 0 if unknown. With staggered SYNC (``sync.stagger_ms``), the buses
    have different SYNC times: this is the latest of them, and each field contains its own bus's time.
    """
    fields: Mapping[str, FieldFrame]
    """Fields by patch name."""
    missing: Mapping[str, str]
    """Reasons for missing fields by patch name: :data:`LATE`, :data:`OVERTAKEN` or a condition such as
    ``lost``.
    """
    skeleton: Skeleton = field(default_factory=Skeleton)
    """Poses of the patches and links on the robot."""

    @property
    def complete(self) -> bool:
        """Whether the fields of all patches are present."""
        return not self.missing

    @property
    def trusted(self) -> bool:
        """Whether the fields of all patches are present and trusted."""
        return not self.missing and all(each.trusted for each in self.fields.values())

    @property
    def precise(self) -> bool:
        """Whether the fields of all patches are present and precise."""
        return not self.missing and all(each.precise for each in self.fields.values())

    @property
    def distrust(self) -> Mapping[str, str]:
        """Human-readable reasons why patches are not trusted, by patch name."""
        reasons = {patch: f"no field: {reason}" for patch, reason in self.missing.items()}
        return reasons | {name: why_not(each) for name, each in self.fields.items() if not each.trusted}

    @functools.cached_property
    def contacts(self) -> tuple[HandContact, ...]:
        """Contacts on all patches in the hand's frame, largest normal force first."""
        return tuple(each.moved(self.skeleton.link_pose(each.link)) for each in self._link_contacts)

    def contacts_on(self, link: str) -> tuple[HandContact, ...]:
        """Return the contacts on a link in the link's frame, largest normal force first.

        Args:
            link: Name of the link; ``hand`` for the patches without a link.

        Raises:
            ValueError: if the link has no patch.
        """
        if link not in self.wrenches:
            raise ValueError(f"link: got {link!r}, must be one of {', '.join(map(repr, self.wrenches))}")
        return tuple(each for each in self._link_contacts if each.link == link)

    @functools.cached_property
    def wrenches(self) -> Mapping[str, Wrench]:
        """Wrench on the skin of each link, by link name.

        The torque is taken about the origin of the link's frame. Every link with a patch has an entry, even
        if nothing touches it. The entry ``hand`` combines the patches without a link.
        """
        patches: dict[str, list[str]] = {}
        for patch in (*self.fields, *self.missing):
            patches.setdefault(self.skeleton.mount(patch).link, []).append(patch)
        return MappingProxyType(
            {
                link: wrench_of(
                    [each for each in self._link_contacts if each.link == link],
                    link,
                    trusted=all(patch in self.fields and self.fields[patch].trusted for patch in names),
                )
                for link, names in sorted(patches.items())
            }
        )

    @functools.cached_property
    def wrench(self) -> Wrench:
        """Wrench on the skin of the whole hand. The torque is taken about the origin of the hand's frame."""
        return wrench_of(self.contacts, HAND, trusted=self.trusted)

    def at(self, link_poses: Mapping[str, Pose]) -> HandFrame:
        """Return a copy with different link poses, for example from the current joint angles.

        Args:
            link_poses: Poses in the hand's frame, by link name. Unlisted links keep their poses. Links
                without patches are ignored.

        Raises:
            ValueError: if ``hand`` is listed. The hand's frame is the reference and has no pose.
        """
        if HAND in link_poses:
            raise ValueError(f"link_poses: got {HAND!r}, must be names of links; the hand has no pose")
        poses = {**self.skeleton.link_poses, **link_poses}
        return replace(self, skeleton=Skeleton(self.skeleton.mounts, poses))

    @functools.cached_property
    def _link_contacts(self) -> tuple[HandContact, ...]:
        """Contacts on all patches, each in its link's frame, largest normal force first."""
        found = [
            HandContact.on_link(contact, patch, self.skeleton.mount(patch), trusted=each.trusted)
            for patch, each in self.fields.items()
            for contact in each.contacts
        ]
        return tuple(sorted(found, key=lambda contact: -contact.normal_force_n))


class HandGatherer:
    """Assembles hand frames and returns them in order of run and scan number. Not thread-safe.

    A hand frame is ready when each awaited patch has delivered the field of this or a later scan. After
    :data:`~skinnode.host.health.SCANS_MISSED` consecutive hand frames without its field, a patch is no longer
    awaited; it is awaited again once its next field arrives. A hand frame is ready no later than
    ``patience_ns`` after its first field.

    Args:
        patches: Names of the patches.
        patience_ns: Time limit (ns) for the other fields of a hand frame, measured from its first field.
        condition: Function that returns the condition of a patch.
        skeleton: Poses of the patches and links on the robot.
    """

    def __init__(
        self,
        patches: Sequence[str],
        patience_ns: int,
        condition: Callable[[str], Condition],
        skeleton: Skeleton | None = None,
    ) -> None:
        self._patches, self._patience_ns, self._condition = tuple(patches), patience_ns, condition
        self._skeleton = Skeleton() if skeleton is None else skeleton
        self._open: dict[_Number, dict[str, FieldFrame]] = {}
        self._until_ns: dict[_Number, int] = {}
        self._newest = dict.fromkeys(self._patches, _BEFORE)
        self._absences = dict.fromkeys(self._patches, 0)
        self._newest_given = _BEFORE
        self.late = 0
        """Number of fields that arrived after their hand frame had been delivered."""

    def add(self, field: FieldFrame, now_ns: int) -> None:
        """Add a field that arrived at monotonic time ``now_ns``."""
        stamp = field.stamp
        assert stamp is not None
        number = stamp.run, stamp.scan
        self._newest[stamp.patch] = number
        self._absences[stamp.patch] = 0
        if number <= self._newest_given:
            self.late += 1
            return
        self._open.setdefault(number, {})[stamp.patch] = field
        self._until_ns.setdefault(number, now_ns + self._patience_ns)

    def next(self, now_ns: int) -> HandFrame | None:
        """Return the oldest hand frame if it is ready at ``now_ns``, otherwise None."""
        if not self._open:
            return None
        number = min(self._open)
        if now_ns < self._until_ns[number] and any(self._awaited(patch, number) for patch in self._patches):
            return None
        return self._given(number)

    def rest(self) -> HandFrame | None:
        """Return the oldest pending hand frame, ready or not, because no more fields follow; None if none."""
        return self._given(min(self._open)) if self._open else None

    def _given(self, number: _Number) -> HandFrame:
        fields = self._open.pop(number)
        del self._until_ns[number]
        self._newest_given = number
        absent = [patch for patch in self._patches if patch not in fields]
        for patch in absent:
            self._absences[patch] += 1
        stamps = [field.stamp for field in fields.values() if field.stamp is not None]
        t_sync_ns = max(stamp.t_sync_ns for stamp in stamps)
        missing = {patch: self._reason(patch, number) for patch in absent}
        return HandFrame(number[1], t_sync_ns, fields, missing, self._skeleton)

    def next_deadline_ns(self) -> int | None:
        """Return the deadline (ns) of the oldest hand frame; None if no hand frame is pending."""
        return self._until_ns[min(self._open)] if self._open else None

    def _awaited(self, patch: str, number: _Number) -> bool:
        return self._newest[patch] < number and self._absences[patch] < SCANS_MISSED

    def _reason(self, patch: str, number: _Number) -> str:
        if self._newest[patch] > number:
            return OVERTAKEN
        condition = self._condition(patch)
        return LATE if condition is Condition.OPERATIONAL else str(condition)


class HandSubscription(Closing):
    """Subscription to hand frames. Read it with ``for``, ``async for`` or :meth:`get`.

    A slow reader loses the oldest fields and gets hand frames with missing fields. ``dropped`` counts the
    lost fields. At the end, pending hand frames are delivered with the fields that have arrived. Only one
    thread may read a subscription.
    """

    def __init__(self, fields: Subscription, gatherer: HandGatherer, timeout_s: float | None) -> None:
        check_timeout(timeout_s)
        self._fields, self._gatherer, self._timeout_s = fields, gatherer, timeout_s

    @property
    def dropped(self) -> int:
        """Number of fields lost because this subscriber was too slow."""
        return self._fields.dropped

    @property
    def late(self) -> int:
        """Number of fields that arrived after their hand frame had been delivered."""
        return self._gatherer.late

    def get(self, timeout_s: float | None = None) -> HandFrame | None:
        """Wait for the next hand frame and return it.

        Args:
            timeout_s: Time limit (s); None for no limit.

        Returns:
            Next hand frame; None on timeout, or once the host or the subscription has closed.

        Raises:
            SkinError: the error that stopped the host, if any.
        """
        try:
            return self._next(timeout_s)
        except queue.Empty:
            return None

    def close(self) -> None:
        """Stop accepting fields, and end the reader's loop. Thread-safe."""
        self._fields.close()

    def __iter__(self) -> Iterator[HandFrame]:
        """Yield hand frames until the host or the subscription closes.

        Raises:
            TimeoutError: if no hand frame arrives within the subscription's timeout.
            SkinError: the error that stopped the host, if any.
        """
        while True:
            try:
                frame = self._next(self._timeout_s)
            except queue.Empty:
                raise self._too_long() from None
            if frame is None:
                return
            yield frame

    async def __aiter__(self) -> AsyncIterator[HandFrame]:
        """Yield hand frames until the host or the subscription closes.

        Asynchronous version of :meth:`__iter__`.
        """
        while True:
            end_ns = _end_ns(self._timeout_s)
            while (frame := self._gatherer.next(clock.monotonic_ns())) is None:
                try:
                    field = await self._fields.take_async(self._wait_s(end_ns))
                except queue.Empty:
                    if end_ns is not None and clock.monotonic_ns() >= end_ns:
                        raise self._too_long() from None
                    continue
                except SkinError as error:
                    frame = self._at_end(error)
                    break
                if field is None:
                    frame = self._at_end()
                    break
                self._gatherer.add(field, clock.monotonic_ns())
            if frame is None:
                return
            yield frame

    def _next(self, timeout_s: float | None) -> HandFrame | None:
        """Return the next hand frame; None once the fields have ended. Raise queue.Empty on timeout."""
        check_timeout(timeout_s)
        end_ns = _end_ns(timeout_s)
        while (frame := self._gatherer.next(clock.monotonic_ns())) is None:
            try:
                field = self._fields.take(self._wait_s(end_ns))
            except queue.Empty:
                if end_ns is not None and clock.monotonic_ns() >= end_ns:
                    raise
                continue
            except SkinError as error:
                return self._at_end(error)
            if field is None:
                return self._at_end()
            self._gatherer.add(field, clock.monotonic_ns())
        return frame

    def _at_end(self, error: SkinError | None = None) -> HandFrame | None:
        """Return the oldest pending hand frame; if there is none, raise ``error`` or return None."""
        frame = self._gatherer.rest()
        if frame is None and error is not None:
            raise error
        return frame

    def _wait_s(self, end_ns: int | None) -> float | None:
        """Return the time (s) to ``end_ns`` or the next deadline, whichever is first; None without either."""
        times = [t_ns for t_ns in (end_ns, self._gatherer.next_deadline_ns()) if t_ns is not None]
        return max(0, min(times) - clock.monotonic_ns()) * 1e-9 if times else None

    def _too_long(self) -> TimeoutError:
        return TimeoutError(f"no hand frame within {self._timeout_s} s")


def require_one_sync(hand: HandConfig) -> None:
    """Check that a single SYNC producer with a counter numbers the scans of all patches.

    Raises:
        ValueError: if the buses of the hand have several SYNC producers, or SYNC has no counter.
    """
    others = {patch.bus for patch in hand.patches if hand.bus(patch.bus).role == "guest"}
    ours = any(patch.bus not in others for patch in hand.patches)
    producers = len(others) + ours
    if producers > 1 or hand.sync.counter_overflow == 0:
        got = "none with a counter" if producers == 1 else f"{producers}"
        raise ValueError(f"SYNC producers: got {got}, must be a single producer with a counter")


def _end_ns(timeout_s: float | None) -> int | None:
    return None if timeout_s is None else clock.monotonic_ns() + int(timeout_s * 1e9)
