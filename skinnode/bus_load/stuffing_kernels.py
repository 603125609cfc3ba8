"""Compiled kernels of :mod:`skinnode.bus_load.stuffing`, which count bits in frames, including stuff bits.

The kernels take identifiers as uint32, lengths and payloads as uint8, and bit counts as int64 arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from skinnode.bus_load.stuffing import ALTERNATING, CRC_BITS, FD_NOMINAL_BITS, HEAD_BITS, TAIL_BITS
from skinnode.compiled.jit import njit_brief


@njit_brief
def classic_one(  # noqa: PLR0913 - arrays of a compiled kernel
    head: int, length: int, high: int, low: int, crc_of: Any, run_of: Any
) -> int:
    """Count the bits of a classic frame, given its 19-bit head and its data in two halves of 32 bits."""
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
def classic(  # noqa: PLR0913 - arrays of a compiled kernel
    ids: Any, lengths: Any, payload: Any, stride: int, crc_of: Any, run_of: Any, bits: Any
) -> int:
    """Implement :func:`skinnode.bus_load.stuffing.classic_bits`."""
    total, begin = 0, 0
    for i in range(ids.size):
        length: Any = np.int64(lengths[i])
        high: Any = 0
        low: Any = 0
        for k in range(begin, begin + length):
            high, low = (high << 8 | low >> 24) & 0xFFFF_FFFF, (low << 8 | np.int64(payload[k])) & 0xFFFF_FFFF
        bits[i] = classic_one(np.int64(ids[i] & 0x7FF) << 7 | length, length, high, low, crc_of, run_of)
        total += bits[i]
        begin += stride if stride else length
    return total


@njit_brief
def fd(  # noqa: PLR0913 - arrays of a compiled kernel
    ids: Any, lengths: Any, payload: Any, run_of: Any, nominal: Any, fast: Any
) -> None:
    """Implement :func:`skinnode.bus_load.stuffing.fd_bits`."""
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
