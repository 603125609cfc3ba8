"""How long a CAN frame occupies the bus, to the bit (ISO 11898-1:2015), and what load that makes.

Classic frames. From start of frame to the end of the CRC sequence a stuff bit of the other value follows
every five equal bits, stuff bits included in the count. The tail of 13 bits is not stuffed: CRC delimiter,
ACK slot and delimiter, 7 bits end of frame, 3 bits inter-frame space. CRC: polynomial 0x4599, 15 bits,
initially 0.

Both the CRC and the stuffing run bytewise through tables. The head of a frame is filled up on its left to
whole bytes: with zeros for the CRC, which leave it 0, and with alternating bits that end in a 1 for the
stuffing, after which the dominant start of frame begins a new run.

CAN FD frames, with an 11-bit identifier and bit-rate switch. Such stuffing ends with the data: in the CRC
field stand 4 bits that count the stuff bits, 17 bits of CRC (21 beyond 16 bytes of data) and a fixed stuff
bit before them and after each 4, whatever their values. The bits from ESI to the CRC delimiter are sent at
the data bit rate; the 17 before them and the 12 after them (ACK slot and delimiter, 7 bits end of frame, 3
bits inter-frame space) at the nominal one.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.errors import ConfigError

TAIL_BITS: Final = 13
_CRC_BITS: Final = 15
_CRC_POLYNOMIAL: Final = 0x4599
_HEAD_BITS: Final = 19  # SOF, 11 bits identifier, RTR, IDE, r0, 4 bits DLC
_EXTENDED_HEAD_BITS: Final = 39  # SOF, 11 bits, SRR, IDE, 18 bits, RTR, r1, r0, 4 bits DLC
FD_LENGTHS: Final[tuple[int, ...]] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can have, by its length code."""
_FD_NOMINAL_BITS: Final = 17 + 12  # SOF, 11 bits identifier, RRS, IDE, FDF, res, BRS; and the tail
_RUN: Final = 5
_NO_RUN: Final = 0
_ALTERNATING: Final = 0x5555_5555_5555  # ends in 1
_STUFF_SHIFT: Final = 12
_FEW: Final = 8
"""So many frames of one length are faster one by one than as arrays."""

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


def fd_length(n_bytes: int) -> int:
    """The shortest data of a CAN FD frame that holds ``n_bytes``. Raises ValueError for more than 64."""
    for length in FD_LENGTHS:
        if n_bytes <= length:
            return length
    raise ValueError(f"data: got {n_bytes} bytes, must be at most {FD_LENGTHS[-1]}")


def fd_bits(can_id: ArrayLike, data: ArrayLike) -> tuple[_Int, _Int]:
    """Bits of CAN FD frames of one length: (n,) identifiers and (n, length) bytes to (n,) bits at the nominal
    bit rate, inter-frame space included, and (n,) at the data bit rate.

    Raises ValueError for other shapes, an identifier of more than 11 bits or a length that no frame has.
    """
    ids, payload = np.asarray(can_id, np.int64), np.asarray(data, np.uint8)
    if ids.ndim != 1 or payload.ndim != 2 or len(payload) != len(ids):
        raise ValueError(f"can_id, data: got shapes {ids.shape}, {payload.shape}, must be (n,), (n, length)")
    length = payload.shape[1]
    if length not in FD_LENGTHS or np.any((ids < 0) | (ids > 0x7FF)):
        raise ValueError(f"can_id, data: got {length} bytes, must be one of {FD_LENGTHS}, and 11-bit numbers")
    # 22 bits up to the length code are two less than three bytes, and the data follow bytewise. FDF, res and
    # BRS alternate: no stuff bit stands between the first two bytes (nominal) and ESI.
    stream = np.empty((3 + length, len(ids)), np.int64)
    stream[:3] = _three_bytes(0b01 << 22 | ids << 10 | 0b10100000 | FD_LENGTHS.index(length))
    stream[3:] = payload.T
    last = stream[-1] & 1
    nominal, fast, run = _stuff_bits(stream, 2)
    # A stuff bit due after the last bit is not sent: the first fixed one stands there.
    fast -= (run - 1 >> 2) != last
    crc_bits, fixed = (17, 6) if length <= 16 else (21, 7)
    data_bits = 1 + 4 + 8 * length + 4 + crc_bits + fixed + 1  # ESI, DLC, data, count, CRC, delimiter
    return _FD_NOMINAL_BITS + nominal, data_bits + fast


@functools.cache
def fd_worst_case_bits(length: int) -> tuple[int, int]:
    """Most bits at the nominal and at the data bit rate of a CAN FD frame with ``length`` bytes, as in
    :func:`fd_bits`: found over all data, run by run.

    Raises ValueError for a length that no frame has.
    """
    if length not in FD_LENGTHS:
        raise ValueError(f"length: got {length}, must be one of {FD_LENGTHS}")
    # From SOF to IDE stand 14 bits, whose first 5 and each 4 more may bring a stuff bit.
    # FDF, res and BRS alternate, ESI is 0 and the length code is known; the data are what is worst.
    stuff = {(1 << 2) + 1: 0}  # a run of one recessive bit, BRS
    code = FD_LENGTHS.index(length)
    choices: list[tuple[int, ...]] = [(0,), *((code >> shift & 1,) for shift in (3, 2, 1, 0))]
    choices += [(0, 1)] * (8 * length)
    for number, bits in enumerate(choices, 1):
        after: dict[int, int] = {}
        for run, count in stuff.items():
            for bit in bits:
                value, equal = (run - 1) >> 2, (run - 1 & 3) + 1
                equal = equal + 1 if bit == value else 1
                stuffed = equal == _RUN
                state = ((1 - bit) << 2) + 1 if stuffed else (bit << 2 | equal - 1) + 1
                # A stuff bit due after the last bit is not sent: the first fixed one stands there.
                total = count + (stuffed and number < len(choices))
                after[state] = max(after.get(state, 0), total)
        stuff = after
    crc_bits, fixed = (17, 6) if length <= 16 else (21, 7)
    data_bits = 1 + 4 + 8 * length + 4 + crc_bits + fixed + 1
    return _FD_NOMINAL_BITS + (14 - 1) // (_RUN - 1), data_bits + max(stuff.values())


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
    head = ids << 7 | length
    columns = np.empty((3 + length, len(ids)), np.int64)
    columns[:3] = _three_bytes(head)
    columns[3:] = payload[:, :length].T
    # The CRC is linear: that of a frame is the sum of those that its bytes would have alone.
    of_byte, place = _crc_by_place(), np.arange(2 + length, -1, -1)
    crc = np.bitwise_xor.reduce(of_byte.take(columns + 256 * place[:, None]), axis=0)

    # 19 + 15 bits of head and CRC are two more than four bytes: six bits of filler make it five. The bytes
    # of the stuffed region straddle those of the payload, so they are cut from pairs of neighbours.
    stream = np.empty((5 + length, len(ids)), np.int64)
    stream[:3] = _three_bytes((_ALTERNATING & 0x3F) << 18 | head >> 1)  # 6 + 18 bits
    stream[3:-2] = (columns[2:-1] & 1) << 7 | columns[3:] >> 1
    last = (columns[-1] & 1) << 15 | crc
    stream[-2], stream[-1] = last >> 8, last & 0xFF
    stuff, _, _ = _stuff_bits(stream, len(stream))
    return _HEAD_BITS + 8 * length + _CRC_BITS + TAIL_BITS + stuff


def _three_bytes(number: _Int) -> tuple[_Int, _Int, _Int]:
    return number >> 16, number >> 8 & 0xFF, number & 0xFF


def _stuff_bits(stream: _Int, first: int) -> tuple[_Int, _Int, _Int]:
    """Of (bytes, n) stuffed from the first bit on, which it overwrites: how many stuff bits are in the
    ``first`` bytes and in the others, and the run that they end with."""
    after, run = _run_and_stuff(), np.full(stream.shape[1], _NO_RUN << 8, np.int64)
    for byte in stream:  # three calls a byte: with a few hundred frames it is the calls that cost
        byte |= run
        after.take(byte, out=byte, mode="clip")
        np.bitwise_and(byte, 0xF00, out=run)
    stream >>= _STUFF_SHIFT
    return stream[:first].sum(axis=0), stream[first:].sum(axis=0), run >> 8


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
def _run_and_stuff() -> _Int:
    """For run << 8 | byte: the run after the byte << 8, and the stuff bits in it << :data:`_STUFF_SHIFT`."""
    _, next_run, stuffed = (np.array(table, dtype=np.int64) for table in _tables())
    return next_run << 8 | stuffed << _STUFF_SHIFT


@functools.cache
def _crc_by_place() -> _Int:
    """For place << 8 | byte: the CRC of that byte with as many zero bytes after it."""
    crc_table = np.array(_tables()[0], dtype=np.int64)
    rows = [crc_table]
    for _ in range(2 + 8):  # a head of three bytes and eight of data
        rows.append((rows[-1] << 8 & 0x7FFF) ^ crc_table[rows[-1] >> 7])
    return np.concatenate(rows)


class BusLoad:
    """Counts frames and their exact bits. Adding a frame is cheap; the bits are worked out in batches.

    Plain code with one owner. Raises ConfigError for a bit rate that is not positive.
    """

    _BATCH: Final = 4096

    def __init__(self, bitrate_bps: int = 1_000_000, data_bitrate_bps: int | None = None) -> None:
        for name, rate in (("bitrate_bps", bitrate_bps), ("data_bitrate_bps", data_bitrate_bps)):
            if rate is not None and rate <= 0:
                raise ConfigError(name, rate, "more than 0")
        self.bitrate_bps = bitrate_bps
        self._data_bit = bitrate_bps / (data_bitrate_bps or bitrate_bps)
        self._frames = 0
        self._bits = self._fast_bits = 0
        self._classic: tuple[list[int], list[bytes]] = [], []
        self._fd: tuple[list[int], list[bytes]] = [], []

    def add(
        self,
        can_id: int,
        data: bytes,
        *,
        extended: bool = False,
        remote: bool = False,
        dlc: int = 0,
        fd: bool = False,
    ) -> None:
        """Count a frame, as in :func:`exact_bits` or, where ``fd``, :func:`fd_bits`. ``data`` is kept until
        the next batch, not copied."""
        if extended or remote:
            self._bits += exact_bits(can_id, data, extended=extended, remote=remote, dlc=dlc)
            self._frames += 1
            return
        self.add_all(((can_id, data),), fd=fd)

    def add_all(self, frames: Iterable[tuple[int, bytes, *tuple[object, ...]]], *, fd: bool = False) -> None:
        """Count standard data frames; of each the identifier and the data come first."""
        ids, data = self._fd if fd else self._classic
        ids += [frame[0] for frame in frames]
        data += [frame[1] for frame in frames]
        if len(ids) >= self._BATCH:
            self._work_off()

    @property
    def frames(self) -> int:
        """Frames added so far."""
        return self._frames + len(self._classic[0]) + len(self._fd[0])

    @property
    def bits(self) -> int:
        """Bits they were on the bus; one at the data bit rate of CAN FD counts as its share of a nominal
        one."""
        self._work_off()
        return self._bits + round(self._fast_bits * self._data_bit)

    def load(self, time_s: float) -> float:
        """Share of ``time_s`` the bus was busy with the frames so far; above 1 they do not fit."""
        return self.bits / (self.bitrate_bps * time_s) if time_s > 0 else 0.0

    def _work_off(self) -> None:
        for can_ids, data in (self._classic, self._fd):
            ids, lengths = np.array(can_ids, np.int64), np.array([len(each) for each in data], np.int64)
            joined, begins = np.frombuffer(b"".join(data), np.uint8), np.cumsum(lengths) - lengths
            self._frames += len(ids)
            can_ids.clear()
            data.clear()
            for length in sorted(set(lengths.tolist())):
                rows = np.flatnonzero(lengths == length)
                payload = joined[begins[rows, None] + np.arange(length)]
                if data is self._fd[1]:
                    nominal, fast = fd_bits(ids[rows], payload)
                    self._bits += int(nominal.sum())
                    self._fast_bits += int(fast.sum())
                elif len(rows) < _FEW:
                    alone = zip(ids[rows].tolist(), payload, strict=True)
                    self._bits += sum(exact_bits(can_id, row.tobytes()) for can_id, row in alone)
                else:
                    self._bits += int(_bits_of_one_length(ids[rows], length, payload).sum())
