"""Payload length of PDOs, and a function that checks payload lengths. All payloads are little-endian."""

from __future__ import annotations

from typing import Final

from skinnode.errors import CodecError
from skinnode.text.words import counted

PDO_BYTES: Final = 8
"""Length, in bytes, of a summary, and of a chunk on a classic CAN bus."""


def require_length(data: bytes, length: int, cob_id: int, what: str) -> None:
    """Check the length of a payload.

    Args:
        data: payload of the frame.
        length: required length, bytes.
        cob_id: COB-ID to be shown in the error.
        what: name of the message, shown in the error.

    Raises:
        CodecError: if the payload does not have the required length.
    """
    if len(data) != length:
        raise CodecError(cob_id, data, f"{counted(length, 'byte')} ({what})")
