"""Decodes a daemon's messages in a separate thread and passes them on."""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from skinnode.host.containment import Defects, keep_on
from skinnode.host.drop_oldest_queue import DropOldestQueue, End
from skinnode.host.events import HealthEvent
from skinnode.messages.definitions import FIELD, HEALTH_REPORT
from skinnode.messages.full_field import SendStamp, decode_field
from skinnode.messages.health import LOG, event_of
from skinnode.messages.health_report import HealthReport, decode_report
from skinnode.messages.topics import HandTopics
from skinnode.messages.typestore import decode
from skinnode.model.frames import FieldFrame, sealed
from skinnode.process import clock
from skinnode.remote import keys
from skinnode.remote.attachment import Attachment
from skinnode.remote.description import Description, boot_id

if TYPE_CHECKING:
    import zenoh

QUEUED: Final = 64
"""Capacity of the queue between Zenoh and the thread, in messages per patch."""
TURN_S: Final = 0.05
"""Maximum time between two calls of ``on_turn``, in s."""


@dataclass(frozen=True, slots=True)
class Recipients:
    """Functions that receive the decoded data, called in the receiver's thread."""

    field: Callable[[FieldFrame, SendStamp, int], None]
    """Receives a field with times on this machine's monotonic clock and the message's transit time, in ns."""
    report: Callable[[HealthReport], None]
    event: Callable[[HealthEvent], None]
    on_turn: Callable[[], None]
    """Called after each message, and at least every :data:`TURN_S`."""


class _Item(NamedTuple):
    message: str
    data: bytes
    attachment: bytes
    t_ns: int
    """Unix time at which the message arrived, in ns."""


class Receiver:
    """Queues messages from construction. A thread passes them on from :meth:`start` until :meth:`close`.

    Args:
        session: Session of the program.
        description: Description of the hand.
        recipients: Functions that receive the data.
        defects: Record of malformed messages and other exceptions.
    """

    def __init__(
        self, session: zenoh.Session, description: Description, recipients: Recipients, defects: Defects
    ) -> None:
        hand = description.hand
        self._recipients, self._defects = recipients, defects
        self._boot_id = boot_id()
        self.follow(description, run=0)
        self._inbox: DropOldestQueue[_Item] = DropOldestQueue(QUEUED * len(hand.patches))
        self._events_of: tuple[bytes, int] | None = None
        self.dropped = 0
        """Number of messages dropped because this process was too slow."""
        self.events_lost = 0
        """Number of events that the daemon sent but that did not arrive."""
        self._thread = clock.thread(target=self._run, name="receive")
        topics = HandTopics.of(hand)
        wanted = [(topic.full_field, FIELD) for topic in topics.patches.values()]
        wanted += [(topics.health, HEALTH_REPORT), (topics.events, LOG)]
        self._subscribers = [
            session.declare_subscriber(keys.topic_key(topic, message), self._handler(message))
            for topic, message in wanted
        ]

    def start(self) -> None:
        """Start passing on messages."""
        self._thread.start()

    def follow(self, description: Description, run: int) -> None:
        """Stamp subsequent fields as coming from the daemon that sent ``description``.

        Args:
            description: Description, whose boot ID determines how times are converted.
            run: Number of the daemon's run, for the stamps.
        """
        self._run_number, self._same_clock = run, description.boot_id == self._boot_id != ""

    def close(self) -> None:
        """Stop receiving and wait for the thread to end. Further calls have no effect."""
        subscribers, self._subscribers = self._subscribers, []
        for subscriber in subscribers:
            subscriber.undeclare()
        self._inbox.put(End())
        self._thread.join()

    def _handler(self, message: str) -> Callable[[zenoh.Sample], None]:
        """Return the function that queues a message. Zenoh threads call the function."""

        def queue_it(sample: zenoh.Sample) -> None:
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            item = _Item(message, sample.payload.to_bytes(), attachment, clock.time_ns())
            self.dropped += self._inbox.put(item)

        return queue_it

    # --- the thread

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "receiving")

    def _turn(self) -> bool:
        item: _Item | End | None
        try:
            item = self._inbox.get(TURN_S)
        except queue.Empty:
            item = None
        if isinstance(item, End):  # ends the thread, even if every turn raises an exception
            return False
        try:
            if item is not None:
                self._pass_on(item)
        finally:
            self._recipients.on_turn()
        return True

    def _pass_on(self, item: _Item) -> None:
        if item.message == FIELD:
            self._field(item)
        elif item.message == LOG:
            self._event(item)
        else:
            self._recipients.report(decode_report(item.data))

    def _field(self, item: _Item) -> None:
        field, sent = decode_field(item.data)
        stamp, offset_ns = field.stamp, self._offset_ns(sent.wall_minus_mono_ns)
        assert stamp is not None
        local = replace(
            stamp,
            t_sync_ns=stamp.t_sync_ns and stamp.t_sync_ns + offset_ns,
            t_receive_ns=stamp.t_receive_ns + offset_ns,
            t_solved_ns=stamp.t_solved_ns and stamp.t_solved_ns + offset_ns,
            run=self._run_number,
        )
        self._recipients.field(sealed(field, stamp=local), sent, item.t_ns - sent.sent_ns)

    def _event(self, item: _Item) -> None:
        event, t_ns = event_of(decode(item.data, LOG))
        self._recipients.event(replace(event, t_ns=t_ns - (clock.time_ns() - clock.monotonic_ns())))
        sequence, _, gid = Attachment.decode(item.attachment)
        if self._events_of is not None and self._events_of[0] == gid:
            self.events_lost += max(0, sequence - self._events_of[1] - 1)
        self._events_of = gid, sequence

    def _offset_ns(self, wall_minus_mono_ns: int) -> int:
        """Return this machine's monotonic clock minus the host's, in ns, derived from both wall clocks."""
        if self._same_clock:
            return 0
        return wall_minus_mono_ns - (clock.time_ns() - clock.monotonic_ns())
