"""Publishes a hand's topics as rmw_zenoh publishers do."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from skinnode.messages.contacts import WRENCH
from skinnode.messages.definitions import CONTACTS, FIELD, FIELD_INFO, HEALTH_REPORT
from skinnode.messages.fields import POINT_CLOUD
from skinnode.messages.health import DIAGNOSTIC_ARRAY, LOG
from skinnode.messages.poses import TRANSFORMS
from skinnode.messages.topics import DIAGNOSTICS, TF_STATIC, HandTopics
from skinnode.remote import keys
from skinnode.remote.attachment import GID_BYTES, Attachment

if TYPE_CHECKING:
    import zenoh

FIELD_TOPICS: Final = {
    "full_field": FIELD,
    "field": POINT_CLOUD,
    "field_info": FIELD_INFO,
    "contacts": CONTACTS,
    "contact_wrenches": WRENCH,
}
"""Message name of each patch topic."""


class Output:
    """Publishes a topic and declares its liveliness token. Only one thread may call the methods.

    Args:
        session: Session of the daemon; closing the session closes the publisher.
        topic: Name of the topic, with a leading slash.
        message: Name of the message.
        entity: Number of the publisher in the session, from 1.
    """

    def __init__(self, session: zenoh.Session, topic: str, message: str, entity: int) -> None:
        import zenoh

        self._publisher = session.declare_publisher(
            keys.topic_key(topic, message), congestion_control=zenoh.CongestionControl.DROP
        )
        token = keys.publisher_token(str(session.zid()), entity, topic, message)
        self._token = session.liveliness().declare_token(token)
        self._gid = hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
        self._sequence = 0

    @property
    def wanted(self) -> bool:
        """Whether any program subscribes to the topic."""
        status: object = self._publisher.matching_status  # not a bool, although the stubs declare one
        return bool(getattr(status, "matching", status))

    def send(self, data: bytes, sent_ns: int) -> None:
        """Publish a message without waiting.

        Args:
            data: CDR-encoded message.
            sent_ns: Unix time, in ns.
        """
        self._sequence += 1
        attachment = Attachment(self._sequence, sent_ns, self._gid)
        self._publisher.put(data, attachment=attachment.encode())


class Outputs:
    """Publishers for all topics of a hand, and their ROS 2 node. Closing the session closes them.

    Args:
        session: Session of the daemon.
        topics: Topics of the hand.
    """

    def __init__(self, session: zenoh.Session, topics: HandTopics) -> None:
        self._session, self._count = session, 0
        self._node = session.liveliness().declare_token(keys.node_token(str(session.zid())))
        self.patches: Mapping[str, Mapping[str, Output]] = {
            name: {part: self._open(getattr(each, part), message) for part, message in FIELD_TOPICS.items()}
            for name, each in topics.patches.items()
        }
        """Publishers, by patch name and key of :data:`FIELD_TOPICS`."""
        self.events = self._open(topics.events, LOG)
        self.health = self._open(topics.health, HEALTH_REPORT)
        self.diagnostics = self._open(DIAGNOSTICS, DIAGNOSTIC_ARRAY)
        self.transforms = self._open(TF_STATIC, TRANSFORMS)
        self.wanted: frozenset[tuple[str, str]] = frozenset()
        """Patch name and key of each patch topic that has a subscriber; see :meth:`look`."""

    def look(self) -> None:
        """Find the topics that have subscribers. This is too slow to do for every field."""
        self.wanted = frozenset(
            (name, part)
            for name, each in self.patches.items()
            for part, output in each.items()
            if output.wanted
        )

    def _open(self, topic: str, message: str) -> Output:
        self._count += 1
        return Output(self._session, topic, message, self._count)
