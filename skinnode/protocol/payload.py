"""Lengths of PDO payloads. All numbers in payloads are little-endian."""

from __future__ import annotations

from typing import Final

from skinnode.errors import CodecError
from skinnode.text.words import counted

PDO_BYTES: Final = 8
"""Length in bytes of a summary and of a chunk on classic CAN."""


def require_length(data: bytes, length: int, cob_id: int, what: str) -> None:
    """Check the length of a payload.

    Args:
        data: Payload of the frame.
        length: Required length, in bytes.
        cob_id: COB-ID for the error message.
        what: Name of the payload for the error message.

    Raises:
        CodecError: If the payload does not have the required length.
    """
    if len(data) != length:
        raise CodecError(cob_id, data, f"{counted(length, 'byte')} ({what})")
