"""Payload length shared by the PDOs of a patch, and its check. All payloads are little-endian."""

from __future__ import annotations

from typing import Final

from skinnode.errors import CodecError
from skinnode.text.words import counted

PDO_BYTES: Final = 8
"""Length of a classic chunk and of every summary, bytes."""


def require_length(data: bytes, length: int, cob_id: int, what: str) -> None:
    """Check the length of a payload.

    Args:
        data: the payload.
        length: required length, bytes.
        cob_id: COB-ID shown in the error.
        what: name of the message, shown in the error.

    Raises:
        CodecError: if the payload does not have that length.
    """
    if len(data) != length:
        raise CodecError(cob_id, data, f"{counted(length, 'byte')} ({what})")
