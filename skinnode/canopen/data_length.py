"""Payload lengths of CAN FD frames (ISO 11898-1:2015, 8.4.2.4)."""

from __future__ import annotations

from typing import Final

from skinnode.text.words import counted

FD_LENGTHS: Final[tuple[int, ...]] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Data lengths of CAN FD frames, bytes, indexed by data length code (DLC)."""


def fd_length(n_bytes: int) -> int:
    """Return the shortest CAN FD data length, in bytes, that is at least ``n_bytes``.

    Args:
        n_bytes: number of bytes to send.

    Raises:
        ValueError: if ``n_bytes`` exceeds 64, the maximum data length of a CAN FD frame.
    """
    for length in FD_LENGTHS:
        if n_bytes <= length:
            return length
    raise ValueError(f"data: got {counted(n_bytes, 'byte')}, must be at most {FD_LENGTHS[-1]}")
