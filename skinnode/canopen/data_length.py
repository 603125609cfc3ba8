"""Payload lengths of CAN FD frames (ISO 11898-1:2015, 8.4.2.4)."""

from __future__ import annotations

from typing import Final

from skinnode.text.words import counted

FD_LENGTHS: Final[tuple[int, ...]] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Payload lengths in bytes, indexed by data length code (DLC)."""


def fd_length(n_bytes: int) -> int:
    """Return the length in bytes of the shortest CAN FD payload that holds ``n_bytes``.

    Args:
        n_bytes: number of bytes to send.

    Raises:
        ValueError: if ``n_bytes`` exceeds 64.
    """
    for length in FD_LENGTHS:
        if n_bytes <= length:
            return length
    raise ValueError(f"data: got {counted(n_bytes, 'byte')}, must be at most {FD_LENGTHS[-1]}")
