"""What all PDO payloads of a patch share: the length, and the error for another length. All little-endian."""

from __future__ import annotations

from typing import Final

from skinnode.errors import CodecError
from skinnode.text.words import counted

PDO_BYTES: Final = 8
"""Bytes of a classic chunk and of every summary."""


def require_length(data: bytes, length: int, cob_id: int, what: str) -> None:
    """Check the length of a payload.

    Args:
        data: the payload.
        length: the bytes that it must have.
        cob_id: named in the error.
        what: name of the message, for the error.

    Raises:
        CodecError: if the payload has another length.
    """
    if len(data) != length:
        raise CodecError(cob_id, data, f"{counted(length, 'byte')} ({what})")
