"""Counts the bits of many frames, including stuff bits, for :mod:`skinnode.bus_load.timing`.

The compiled kernels are in :mod:`skinnode.bus_load.stuffing_kernels`, which is imported on first use: a node
and the simulator on a kernel CAN bus do not count bits, so they need not load numba.
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray

HEAD_BITS: Final = 19  # bits of SOF, 11-bit identifier, RTR, IDE, r0 and 4-bit DLC
CRC_BITS: Final = 15
TAIL_BITS: Final = 13
"""Number of bits in the CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and inter-frame space
(3)."""
FD_NOMINAL_BITS: Final = 17 + 12  # SOF, 11-bit identifier, RRS, IDE, FDF, res and BRS; plus the tail
_CRC_POLYNOMIAL: Final = 0x4599
_RUN: Final = 5
ALTERNATING: Final = 0x5555_5555_5555  # ends in 1

_Int = NDArray[np.int64]
_Bytes = NDArray[np.uint8]


@functools.cache
def tables() -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """Return three lookup tables: CRC, next run, and number of stuff bits.

    The CRC table is indexed by byte, the other two by ``run << 8 | byte``. ``run`` encodes the 1 to 4 equal
    bits before the byte as (value << 2 | length − 1) + 1, or 0 at the start of a frame. Five equal bits are
    followed by a stuff bit, which begins a new run.
    """
    crc_table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = crc << 1 ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        crc_table.append(crc & 0x7FFF)
    next_run, stuffed = [], []
    for run in range(9):
        for byte in range(256):
            value, length = ((run - 1) >> 2, (run - 1 & 3) + 1) if run else (-1, 0)
            stuff = 0
            for shift in range(7, -1, -1):
                bit = byte >> shift & 1
                length = length + 1 if bit == value else 1
                value = bit
                if length == _RUN:
                    stuff += 1
                    value, length = 1 - bit, 1
            next_run.append((value << 2 | length - 1) + 1)
            stuffed.append(stuff)
    return tuple(crc_table), tuple(next_run), tuple(stuffed)


@functools.cache
def _arrays() -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return two arrays: the CRC table, and a table with entries ``next run << 8 | number of stuff bits``."""
    crc, next_run, stuffed = (np.array(table, np.uint16) for table in tables())
    return crc, np.asarray(next_run << 8 | stuffed, np.uint16)


@functools.cache
def _kernels() -> ModuleType:
    from skinnode.bus_load import stuffing_kernels

    return stuffing_kernels


_loaded = False


def are_loaded() -> bool:
    """Return whether :func:`load_kernels` has been called."""
    return _loaded


def load_kernels() -> None:
    """Compile the kernels, or load them from the cache.

    Call this function before communication starts. Loading takes half a second, during which a receiving
    thread cannot answer requests.
    """
    global _loaded
    _loaded = True
    none, nothing, bits = np.zeros(0, np.uint32), np.zeros(0, np.uint8), np.zeros(0, np.int64)
    classic_bits(none, nothing, nothing, 0, bits)
    fd_bits(none, nothing, nothing, bits, bits)


def classic_bits(ids: NDArray[np.uint32], lengths: _Bytes, payload: _Bytes, stride: int, bits: _Int) -> int:
    """Count the bits of each classic data frame.

    Args:
        ids: (n,) identifiers.
        lengths: (n,) data lengths, in bytes.
        payload: the data of all frames, concatenated.
        stride: distance between the data of consecutive frames in ``payload``, in bytes; 0 if the data are
            contiguous.
        bits: (n,) output, number of bits in each frame.

    Returns:
        Total number of bits.
    """
    return int(_kernels().classic(ids, lengths, payload, stride, *_arrays(), bits))


def fd_bits(ids: NDArray[np.uint32], lengths: _Bytes, payload: _Bytes, nominal: _Int, fast: _Int) -> None:
    """Count the bits of each CAN FD frame.

    Args:
        ids: (n,) identifiers.
        lengths: (n,) valid CAN FD data lengths, in bytes.
        payload: the data of all frames, concatenated.
        nominal: (n,) output, bits at the nominal bit rate.
        fast: (n,) output, bits at the data bit rate.
    """
    _kernels().fd(ids, lengths, payload, _arrays()[1], nominal, fast)


def classic_frame_bits(head: int, data: bytes) -> int:
    """Count the bits of a classic frame with an 11-bit identifier; five times as fast as ``exact_bits``.

    The first call takes longer, because it loads a kernel.

    Args:
        head: the 19 bits from the start of frame to the data length code, as a number.
        data: data bytes, at most 8.

    Returns:
        Number of bits, including stuff bits and inter-frame space.
    """
    # The data are passed in two halves, because numba would recompile the kernel for numbers of 2⁶³ or
    # more.
    word = int.from_bytes(data, "big")
    return int(_kernels().classic_one(head, len(data), word >> 32, word & 0xFFFF_FFFF, *_arrays()))
