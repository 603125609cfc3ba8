"""Compiled kernels of :mod:`skinnode.bus_load.timing`, which count the bits of frames with stuff bits.

The kernels take identifiers as uint32, lengths and payloads as uint8, and bit counts as int64 arrays.
"""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_brief

HEAD_BITS: Final = 19  # bits of SOF, 11-bit identifier, RTR, IDE, r0 and 4-bit DLC
CRC_BITS: Final = 15
TAIL_BITS: Final = 13
"""Number of bits in CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and inter-frame space (3)."""
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
    """Return two arrays: the CRC table, and a table of ``next run << 8 | number of stuff bits``."""
    crc, next_run, stuffed = (np.array(table, np.uint16) for table in tables())
    return crc, np.asarray(next_run << 8 | stuffed, np.uint16)


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
        lengths: (n,) data lengths, bytes.
        payload: the data of all frames, concatenated.
        stride: distance between the data of consecutive frames in ``payload``, bytes; 0 if the data are
            contiguous.
        bits: (n,) output, number of bits in each frame.

    Returns:
        Total number of bits.
    """
    return int(_classic(ids, lengths, payload, stride, *_arrays(), bits))


def fd_bits(ids: NDArray[np.uint32], lengths: _Bytes, payload: _Bytes, nominal: _Int, fast: _Int) -> None:
    """Count the bits of each CAN FD frame.

    Args:
        ids: (n,) identifiers.
        lengths: (n,) valid CAN FD data lengths, bytes.
        payload: the data of all frames, concatenated.
        nominal: (n,) output, bits at the nominal bit rate.
        fast: (n,) output, bits at the data bit rate.
    """
    _fd(ids, lengths, payload, _arrays()[1], nominal, fast)


def classic_frame_bits(head: int, data: bytes) -> int:
    """Count the bits of a classic frame with an 11-bit identifier, five times as fast as ``exact_bits``.

    The first call takes longer, because it loads a kernel.

    Args:
        head: the 19 bits from the start of frame to the data length code, as a number.
        data: data bytes, at most 8.

    Returns:
        Number of bits, including stuff bits and inter-frame space.
    """
    # The data are passed in two halves, because numba would compile the kernel again for numbers of 2⁶³ or
    # more.
    word = int.from_bytes(data, "big")
    return int(_classic_one(head, len(data), word >> 32, word & 0xFFFF_FFFF, *_arrays()))


@njit_brief
def _classic_one(  # noqa: PLR0913 - arrays of a compiled kernel
    head: int, length: int, high: int, low: int, crc_of: Any, run_of: Any
) -> int:
    crc: Any = np.int64(crc_of[head >> 16])
    crc = (crc << 8 & 0x7FFF) ^ np.int64(crc_of[crc >> 7 ^ (head >> 8 & 0xFF)])
    crc = (crc << 8 & 0x7FFF) ^ np.int64(crc_of[crc >> 7 ^ (head & 0xFF)])
    # The 19-bit head, the 15-bit CRC and six filler bits make up five bytes. Because the head ends inside a
    # byte, each byte to be stuffed is assembled from two adjacent payload bytes.
    stream = (ALTERNATING & 0x3F) << 18 | head >> 1
    stuff: Any = 0
    run: Any = 0
    before: Any = head
    for shift in (16, 8, 0):
        entry = np.int64(run_of[run << 8 | (stream >> shift & 0xFF)])
        stuff, run = stuff + (entry & 0xFF), entry >> 8
    for k in range(length - 1, -1, -1):
        byte = (high >> 8 * (k - 4) if k >= 4 else low >> 8 * k) & 0xFF
        crc = (crc << 8 & 0x7FFF) ^ np.int64(crc_of[crc >> 7 ^ byte])
        entry = np.int64(run_of[run << 8 | (before & 1) << 7 | byte >> 1])
        stuff, run, before = stuff + (entry & 0xFF), entry >> 8, byte
    last = (before & 1) << 15 | crc
    for shift in (8, 0):
        entry = np.int64(run_of[run << 8 | (last >> shift & 0xFF)])
        stuff, run = stuff + (entry & 0xFF), entry >> 8
    return int(HEAD_BITS + 8 * length + CRC_BITS + TAIL_BITS + stuff)


@njit_brief
def _classic(  # noqa: PLR0913 - arrays of a compiled kernel
    ids: Any, lengths: Any, payload: Any, stride: int, crc_of: Any, run_of: Any, bits: Any
) -> int:
    total, begin = 0, 0
    for i in range(ids.size):
        length: Any = np.int64(lengths[i])
        high: Any = 0
        low: Any = 0
        for k in range(begin, begin + length):
            high, low = (high << 8 | low >> 24) & 0xFFFF_FFFF, (low << 8 | np.int64(payload[k])) & 0xFFFF_FFFF
        bits[i] = _classic_one(np.int64(ids[i] & 0x7FF) << 7 | length, length, high, low, crc_of, run_of)
        total += bits[i]
        begin += stride if stride else length
    return total


@njit_brief
def _fd(  # noqa: PLR0913 - arrays of a compiled kernel
    ids: Any, lengths: Any, payload: Any, run_of: Any, nominal: Any, fast: Any
) -> None:
    begin = 0
    for i in range(ids.size):
        length: Any = np.int64(lengths[i])
        if length <= 8:
            code = length
        elif length <= 24:
            code = 6 + length // 4  # 12, 16, 20, 24
        else:
            code = 11 + length // 16  # 32, 48, 64

        # Two filler bits precede the 22 bits from SOF to the length code; the data bytes follow them. The
        # first two bytes are sent at the nominal bit rate. FDF, res and BRS alternate, so no stuff bit falls
        # between these bytes and ESI.
        stream = 0b01 << 22 | np.int64(ids[i] & 0x7FF) << 10 | 0b10100000 | code
        slow: Any = 0
        stuff: Any = 0
        run: Any = 0
        last = code & 1
        for shift in (16, 8, 0):
            entry = np.int64(run_of[run << 8 | (stream >> shift & 0xFF)])
            run = entry >> 8
            if shift:
                slow += entry & 0xFF
            else:
                stuff += entry & 0xFF
        for k in range(begin, begin + length):
            entry = np.int64(run_of[run << 8 | np.int64(payload[k])])
            stuff, run = stuff + (entry & 0xFF), entry >> 8
            last = np.int64(payload[k]) & 1
        # The first fixed stuff bit replaces a stuff bit that is due after the last bit.
        if run - 1 >> 2 != last:
            stuff -= 1
        crc_bits, fixed = (17, 6) if length <= 16 else (21, 7)
        # bits of ESI, DLC, data, stuff count, CRC and CRC delimiter
        fast[i] = 1 + 4 + 8 * length + 4 + crc_bits + fixed + 1 + stuff
        nominal[i] = FD_NOMINAL_BITS + slow
        begin += length
