"""How long a classic CAN frame occupies the bus, to the bit (ISO 11898-1), and what load that makes.

From start of frame to the end of the CRC sequence a stuff bit of the other value follows every five equal
bits, stuff bits included in the count. The tail of 13 bits is not stuffed: CRC delimiter, ACK slot and
delimiter, 7 bits end of frame, 3 bits inter-frame space. CRC: polynomial 0x4599, 15 bits, initially 0.

Both the CRC and the stuffing run bytewise through tables. The head of a frame is filled up on its left to
whole bytes: with zeros for the CRC, which leave it 0, and with alternating bits that end in a 1 for the
stuffing, after which the dominant start of frame begins a new run.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.errors import ConfigError

TAIL_BITS: Final = 13
_CRC_BITS: Final = 15
_CRC_POLYNOMIAL: Final = 0x4599
_HEAD_BITS: Final = 19  # SOF, 11 bits identifier, RTR, IDE, r0, 4 bits DLC
_EXTENDED_HEAD_BITS: Final = 39  # SOF, 11 bits, SRR, IDE, 18 bits, RTR, r1, r0, 4 bits DLC
_RUN: Final = 5
_NO_RUN: Final = 0
_ALTERNATING: Final = 0x5555_5555_5555  # ends in 1

_Int = NDArray[np.int64]


def nominal_bits(dlc: int, *, extended: bool = False) -> int:
    """Bits of a frame without any stuff bit."""
    return (_EXTENDED_HEAD_BITS if extended else _HEAD_BITS) + 8 * dlc + _CRC_BITS + TAIL_BITS


def worst_case_bits(dlc: int, *, extended: bool = False) -> int:
    """Bits of the longest frame with ``dlc`` bytes: a stuff bit after the first 5 bits and each 4 more.

    Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis", 2007, eq. 1.
    """
    nominal = nominal_bits(dlc, extended=extended)
    return nominal + (nominal - TAIL_BITS - 1) // (_RUN - 1)


def exact_bits(
    can_id: int, data: bytes, *, extended: bool = False, remote: bool = False, dlc: int | None = None
) -> int:
    """Bits of a classic data frame on the bus, inter-frame space included.

    A remote frame (``remote``) carries no data; its length code is ``dlc``. Raises ValueError for an
    identifier that does not fit or more than 8 bytes.
    """
    if not 0 <= can_id < 1 << (29 if extended else 11):
        raise ValueError(f"can_id: got 0x{can_id:X}, must fit {29 if extended else 11} bits")
    if len(data) > 8:
        raise ValueError(f"data: got {len(data)} bytes, must be at most 8")
    if remote:
        data, code = b"", dlc or 0
    else:
        code = len(data)
    if extended:
        base, extension = can_id >> 18, can_id & 0x3FFFF
        head = (base << 20 | 0b11 << 18 | extension) << 7 | remote << 6 | code
        head_bits = _EXTENDED_HEAD_BITS
    else:
        head = can_id << 7 | remote << 6 | code
        head_bits = _HEAD_BITS
    head_bytes = -(-head_bits // 8)
    crc_table, next_run, stuffed = _tables()
    crc = 0
    for byte in head.to_bytes(head_bytes, "big") + data:
        crc = (crc << 8 & 0x7FFF) ^ crc_table[crc >> 7 ^ byte]

    n_bits = head_bits + 8 * len(data) + _CRC_BITS
    bits = (head << 8 * len(data) | int.from_bytes(data, "big")) << _CRC_BITS | crc
    n_bytes = -(-n_bits // 8)
    filler = _ALTERNATING & ((1 << 8 * n_bytes - n_bits) - 1)
    run, stuff = _NO_RUN, 0
    for byte in (filler << n_bits | bits).to_bytes(n_bytes, "big"):
        at = run << 8 | byte
        stuff += stuffed[at]
        run = next_run[at]
    return n_bits + stuff + TAIL_BITS


def exact_bits_batch(can_id: ArrayLike, dlc: ArrayLike, data: ArrayLike) -> _Int:
    """:func:`exact_bits` of many standard data frames: (n,) identifiers, (n,) lengths, (n, 8) bytes, as (n,).

    Bytes beyond a frame's length are ignored. Raises ValueError for other shapes, identifiers or lengths.
    """
    ids, lengths, payload = (
        np.asarray(can_id, np.int64),
        np.asarray(dlc, np.int64),
        np.asarray(data, np.uint8),
    )
    n = ids.size
    if ids.shape != (n,) or lengths.shape != (n,) or payload.shape != (n, 8):
        shapes = f"{ids.shape}, {lengths.shape}, {payload.shape}"
        raise ValueError(f"can_id, dlc, data: got shapes {shapes}, must be (n,), (n,), (n, 8)")
    if np.any((ids < 0) | (ids > 0x7FF) | (lengths < 0) | (lengths > 8)):
        raise ValueError("can_id, dlc: got a number out of range, must be 0 to 0x7FF and 0 to 8")
    bits = np.empty(n, dtype=np.int64)
    for length in np.unique(lengths):
        chosen = lengths == length
        bits[chosen] = _bits_of_one_length(ids[chosen], int(length), payload[chosen])
    return bits


def _bits_of_one_length(ids: _Int, length: int, payload: NDArray[np.uint8]) -> _Int:
    crc_table, next_run, stuffed = _array_tables()
    head = ids << 7 | length
    crc = np.zeros_like(ids)
    columns = [head >> 16, head >> 8 & 0xFF, head & 0xFF, *payload[:, :length].T.astype(np.int64)]
    for byte in columns:
        crc = (crc << 8 & 0x7FFF) ^ crc_table[crc >> 7 ^ byte]

    # 19 + 15 bits of head and CRC are two more than four bytes: six bits of filler make it five. The bytes
    # of the stuffed region straddle those of the payload, so they are cut from pairs of neighbours.
    n_bits = _HEAD_BITS + 8 * length + _CRC_BITS
    filler = (_ALTERNATING & 0x3F) << 18 | head >> 1  # 6 + 18 bits: three bytes
    stream = [filler >> 16, filler >> 8 & 0xFF, filler & 0xFF]
    carried = head & 1
    for byte in columns[3:]:
        stream.append(carried << 7 | byte >> 1)
        carried = byte & 1
    last = carried << 15 | crc
    stream += [last >> 8, last & 0xFF]
    run = np.full(ids.shape, _NO_RUN, dtype=np.int64)
    bits = np.full(ids.shape, n_bits + TAIL_BITS, dtype=np.int64)
    for byte in stream:
        at = run << 8 | byte
        bits += stuffed[at]
        run = next_run[at]
    return bits


@functools.cache
def _tables() -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """CRC of a byte; and for run << 8 | byte: the run after the byte and the stuff bits in it.

    A run is 0 before the first bit, else value << 2 | (length − 1) + 1, with lengths 1 … 4: a fifth equal bit
    brings the stuff bit, which begins a run of its own.
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
def _array_tables() -> tuple[_Int, _Int, _Int]:
    crc_table, next_run, stuffed = (np.array(table, dtype=np.int64) for table in _tables())
    return crc_table, next_run, stuffed


class BusLoad:
    """Counts frames and their exact bits. Adding a frame is cheap; the bits are worked out in batches.

    Plain code with one owner. Raises ConfigError for a bit rate that is not positive.
    """

    _BATCH: Final = 4096

    def __init__(self, bitrate_bps: int = 1_000_000) -> None:
        if bitrate_bps <= 0:
            raise ConfigError("bitrate_bps", bitrate_bps, "more than 0")
        self.bitrate_bps = bitrate_bps
        self._frames = 0
        self._bits = 0
        self._ids: list[int] = []
        self._data: list[bytes] = []

    def add(
        self, can_id: int, data: bytes, *, extended: bool = False, remote: bool = False, dlc: int = 0
    ) -> None:
        """Count a frame, as in :func:`exact_bits`. ``data`` is kept until the next batch, not copied."""
        if extended or remote:
            self._bits += exact_bits(can_id, data, extended=extended, remote=remote, dlc=dlc)
            self._frames += 1
            return
        self._ids.append(can_id)
        self._data.append(data)
        if len(self._ids) >= self._BATCH:
            self._work_off()

    @property
    def frames(self) -> int:
        """Frames added so far."""
        return self._frames + len(self._ids)

    @property
    def bits(self) -> int:
        """Bits they were on the bus."""
        self._work_off()
        return self._bits

    def load(self, time_s: float) -> float:
        """Share of ``time_s`` the bus was busy with the frames so far; above 1 they do not fit."""
        return self.bits / (self.bitrate_bps * time_s) if time_s > 0 else 0.0

    def _work_off(self) -> None:
        if not self._ids:
            return
        padded = b"".join([data.ljust(8, b"\0") for data in self._data])
        payload = np.frombuffer(padded, dtype=np.uint8).reshape(-1, 8)
        self._bits += int(exact_bits_batch(self._ids, [len(data) for data in self._data], payload).sum())
        self._frames += len(self._ids)
        self._ids.clear()
        self._data.clear()
