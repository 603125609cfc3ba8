"""Publishes one topic, as a publisher of rmw_zenoh does."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from skinnode.remote import keys
from skinnode.remote.attachment import GID_BYTES, Attachment

if TYPE_CHECKING:
    import zenoh


class Output:
    """Publisher of a topic with its liveliness token. Only one thread may call its methods.

    Args:
        session: Session of the daemon, which closes the publisher.
        topic: Name of the topic, with a leading slash.
        message: Name of the message.
        entity: Number of the publisher in the session, from 1.
        express: Whether each message is sent immediately rather than together with later messages.
    """

    def __init__(  # noqa: PLR0913 - one argument per property
        self, session: zenoh.Session, topic: str, message: str, entity: int, *, express: bool = False
    ) -> None:
        import zenoh

        self._publisher = session.declare_publisher(
            keys.topic_key(topic, message), congestion_control=zenoh.CongestionControl.DROP, express=express
        )
        token = keys.publisher_token(str(session.zid()), entity, topic, message)
        self._token = session.liveliness().declare_token(token)
        self._gid = hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
        self._sequence = 0

    @property
    def wanted(self) -> bool:
        """Whether any program subscribes to the topic."""
        status: object = self._publisher.matching_status  # not a bool, as the stubs say
        return bool(getattr(status, "matching", status))

    def send(self, data: bytes, sent_ns: int) -> None:
        """Publish a message. Never waits.

        Args:
            data: The message as CDR.
            sent_ns: Time since 1970, ns.
        """
        self._sequence += 1
        attachment = Attachment(self._sequence, sent_ns, self._gid)
        self._publisher.put(data, attachment=attachment.encode())
