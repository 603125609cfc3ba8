"""Encodes the number, time and publisher of a message as rmw_zenoh does (``attachment_helpers.cpp``).

Zenoh's serialization writes two little-endian int64 values, then the length and the 16 bytes of the
publisher's ID.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

GID_BYTES: Final = 16
_LAYOUT: Final = struct.Struct("<qqB16s")


class Attachment(NamedTuple):
    """Attachment of a message."""

    sequence: int
    """Sequence number of the message on its topic, starting at 1."""
    sent_ns: int
    """Unix time at which the message was sent, in ns."""
    gid: bytes
    """ID of the publisher, 16 bytes."""

    def encode(self) -> bytes:
        """Encode the attachment as bytes."""
        return _LAYOUT.pack(self.sequence, self.sent_ns, GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: bytes) -> Attachment:
        """Decode an attachment from bytes.

        Raises:
            ValueError: The bytes are not an rmw_zenoh attachment.
        """
        if len(data) != _LAYOUT.size or data[16] != GID_BYTES:
            raise ValueError(f"attachment: got {len(data)} bytes, must be {_LAYOUT.size} as by rmw_zenoh")
        sequence, sent_ns, _, gid = _LAYOUT.unpack(data)
        return cls(sequence, sent_ns, gid)
