"""CRC-16/IBM-3740 bit by bit, as its definition says, apart from the code under test."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def crc16(data: bytes, value: int = 0xFFFF) -> int:
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def check_of_scan(codes: ArrayLike, bits: int, head: bytes) -> int:
    """Over codes in row-major order, little-endian in their width, then the first 6 bytes of the summary."""
    body = b"".join(int(code).to_bytes(bits // 8, "little") for code in np.ravel(codes).tolist())
    return crc16(body + head)
