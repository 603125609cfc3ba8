"""Computes the exact duration of CAN frames on the bus (ISO 11898-1:2015), and the resulting bus load.

In a classic frame, five consecutive equal bits between the start of frame and the end of the CRC sequence are
followed by a stuff bit of the opposite value. A stuff bit can be the first of the next five equal bits. The
13-bit tail has no stuff bits; it consists of the CRC delimiter, the ACK slot, the ACK delimiter, the 7-bit
end of frame and the 3-bit inter-frame space. The 15-bit CRC has the polynomial 0x4599 and the initial value
0.

CRC and stuff bits are looked up in tables, one byte at a time, so leading filler bits pad the head of a frame
to whole bytes. For the CRC, the filler bits are zeros, which leave the initial value of 0 unchanged. For
stuffing, the filler bits alternate and end with a 1, so that the dominant start of frame begins a new run.

The CAN FD frames of a hand have 11-bit identifiers and switch the bit rate; only :func:`exact_fd_bits`
supports other CAN FD frames. In CAN FD, the stuffing rule of classic CAN applies up to the end of the data.
The CRC field contains a 4-bit stuff count, 17 CRC bits (21 for more than 16 data bytes), and fixed stuff
bits: one before the first bit and one after every 4 bits. The bits from ESI to the CRC delimiter are sent at
the data bit rate, all others at the nominal bit rate: the 17 bits before ESI (36 with a 29-bit identifier)
and the 12 bits after the CRC delimiter (ACK slot, ACK delimiter, 7-bit end of frame and 3-bit inter-frame
space).
"""

from __future__ import annotations

import functools
from array import array
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.bus_load import stuffing
from skinnode.bus_load.stuffing import (
    ALTERNATING,
    CRC_BITS,
    FD_NOMINAL_BITS,
    HEAD_BITS,
    TAIL_BITS,
    tables,
)
from skinnode.canopen.data_length import FD_LENGTHS
from skinnode.errors import ConfigError
from skinnode.text.words import counted

_EXTENDED_HEAD_BITS: Final = 39  # SOF, 11-bit base ID, SRR, IDE, 18-bit extension, RTR, r1, r0, 4-bit DLC
_EXTENDED_FD_NOMINAL_BITS: Final = FD_NOMINAL_BITS + 19  # SRR, 18-bit extension
_FD_CODES: Final = {length: code for code, length in enumerate(FD_LENGTHS)}
_RUN: Final = 5
_NO_RUN: Final = 0
_Int = NDArray[np.int64]


def nominal_bits(dlc: int, *, extended: bool = False) -> int:
    """Return the number of bits in a frame, excluding stuff bits.

    Args:
        dlc: number of data bytes.
        extended: whether the identifier has 29 bits.
    """
    return (_EXTENDED_HEAD_BITS if extended else HEAD_BITS) + 8 * dlc + CRC_BITS + TAIL_BITS


def worst_case_bits(dlc: int, *, extended: bool = False) -> int:
    """Return the maximum number of bits in a frame: a stuff bit after the first 5 bits and every 4 more.

    Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis", 2007, eq. 1.
    """
    nominal = nominal_bits(dlc, extended=extended)
    return nominal + (nominal - TAIL_BITS - 1) // (_RUN - 1)


def exact_bits(
    can_id: int, data: bytes, *, extended: bool = False, remote: bool = False, dlc: int | None = None
) -> int:
    """Return the exact number of bits in a classic frame, including stuff bits and inter-frame space.

    Args:
        can_id: identifier.
        data: data bytes.
        extended: whether the identifier has 29 bits.
        remote: whether the frame is a remote frame, which has no data.
        dlc: length code of a remote frame.

    Raises:
        ValueError: if the identifier is too large, or there are more than 8 data bytes.
    """
    if not 0 <= can_id < 1 << (29 if extended else 11):
        raise ValueError(f"can_id: got 0x{can_id:X}, must fit {29 if extended else 11} bits")
    if len(data) > 8:
        raise ValueError(f"data: got {counted(len(data), 'byte')}, must be at most 8")
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
        head_bits = HEAD_BITS
    head_bytes = -(-head_bits // 8)
    crc_table, next_run, stuffed = tables()
    crc = 0
    for byte in head.to_bytes(head_bytes, "big") + data:
        crc = (crc << 8 & 0x7FFF) ^ crc_table[crc >> 7 ^ byte]

    n_bits = head_bits + 8 * len(data) + CRC_BITS
    bits = (head << 8 * len(data) | int.from_bytes(data, "big")) << CRC_BITS | crc
    n_bytes = -(-n_bits // 8)
    filler = ALTERNATING & ((1 << 8 * n_bytes - n_bits) - 1)
    run, stuff = _NO_RUN, 0
    for byte in (filler << n_bits | bits).to_bytes(n_bytes, "big"):
        at = run << 8 | byte
        stuff += stuffed[at]
        run = next_run[at]
    return n_bits + stuff + TAIL_BITS


def exact_fd_bits(
    can_id: int, data: bytes, *, extended: bool = False, brs: bool = True, esi: bool = False
) -> tuple[int, int]:
    """Return the exact number of bits in a CAN FD frame, including stuff bits and inter-frame space.

    Args:
        can_id: identifier.
        data: data bytes.
        extended: whether the identifier has 29 bits.
        brs: whether the frame switches to the data bit rate; if not, all bits are sent at the nominal bit
            rate.
        esi: whether the error state indicator is recessive, as sent by an error-passive node.

    Returns:
        The numbers of bits at the nominal bit rate and at the data bit rate.

    Raises:
        ValueError: if the identifier is too large, or the length is not valid in CAN FD.
    """
    if not 0 <= can_id < 1 << (29 if extended else 11):
        raise ValueError(f"can_id: got 0x{can_id:X}, must fit {29 if extended else 11} bits")
    code = _FD_CODES.get(len(data))
    if code is None:
        raise ValueError(f"data: got {counted(len(data), 'byte')}, must be one of {FD_LENGTHS}")
    # The last byte of the head consists of FDF, res, BRS, ESI and the length code. FDF and res differ and, if
    # the bit rate is switched, so do res and BRS. No stuff bit therefore falls between FDF and ESI.
    last = 0x80 | brs << 5 | esi << 4 | code
    if extended:  # filler, SOF, base identifier, SRR, IDE, identifier extension, RRS
        before = (0b1010101 << 33 | (can_id >> 18) << 21 | 0b11 << 19 | (can_id & 0x3FFFF) << 1).to_bytes(5)
        nominal = _EXTENDED_FD_NOMINAL_BITS
    else:  # filler, SOF, identifier, RRS, IDE
        before = (0b01 << 14 | can_id << 2).to_bytes(2)
        nominal = FD_NOMINAL_BITS
    _, next_run, stuffed = tables()
    run, stuff = _NO_RUN, 0
    for byte in before:
        at = run << 8 | byte
        stuff += stuffed[at]
        run = next_run[at]
    nominal += stuff
    stuff = 0
    for byte in (last, *data):
        at = run << 8 | byte
        stuff += stuffed[at]
        run = next_run[at]
    # The first fixed stuff bit replaces a stuff bit that is due after the last bit.
    if run - 1 >> 2 != ((data[-1] if data else code) & 1):
        stuff -= 1
    crc_bits, fixed = (17, 6) if len(data) <= 16 else (21, 7)
    fast = 1 + 4 + 8 * len(data) + 4 + crc_bits + fixed + 1 + stuff
    return (nominal, fast) if brs else (nominal + fast, 0)


def fd_bits(can_id: ArrayLike, data: ArrayLike) -> tuple[_Int, _Int]:
    """Count the bits of each CAN FD frame; all frames have the same length.

    Args:
        can_id: (n,) identifiers.
        data: (n, length) bytes.

    Returns:
        (n,) numbers of bits at the nominal bit rate, including inter-frame space, and (n,) at the data bit
        rate.

    Raises:
        ValueError: if a shape is wrong, an identifier has more than 11 bits, or the length is not valid in
        CAN FD.
    """
    ids, payload = np.asarray(can_id, np.int64), np.asarray(data, np.uint8)
    if ids.ndim != 1 or payload.ndim != 2 or len(payload) != len(ids):
        raise ValueError(f"can_id, data: got shapes {ids.shape}, {payload.shape}, must be (n,), (n, length)")
    length = payload.shape[1]
    if length not in FD_LENGTHS or np.any((ids < 0) | (ids > 0x7FF)):
        raise ValueError(
            f"can_id, data: got {counted(length, 'byte')}, must be one of {FD_LENGTHS}, with 11-bit IDs"
        )
    nominal, fast = np.empty((2, len(ids)), np.int64)
    lengths = np.full(len(ids), length, np.uint8)
    stuffing.fd_bits(ids.astype(np.uint32), lengths, payload.flatten(), nominal, fast)
    return nominal, fast


@functools.cache
def fd_worst_case_bits(length: int) -> tuple[int, int]:
    """Return the maximum number of bits in a CAN FD frame with the given data length.

    Args:
        length: number of data bytes.

    Returns:
        The numbers of bits at the nominal bit rate and at the data bit rate, as in :func:`fd_bits`.

    Raises:
        ValueError: if the length is not valid in CAN FD.
    """
    if length not in FD_LENGTHS:
        raise ValueError(f"length: got {length}, must be one of {FD_LENGTHS}")
    # The 14 bits from SOF to IDE have at most one stuff bit after the first 5 bits and after every 4 more.
    # FDF, res and BRS alternate, ESI is 0, and the length code is known, so the first run is the single
    # recessive bit BRS. The data bits are assumed to be the worst case.
    stuff = {(1 << 2) + 1: 0}
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
                # The first fixed stuff bit replaces a stuff bit that is due after the last bit.
                total = count + (stuffed and number < len(choices))
                after[state] = max(after.get(state, 0), total)
        stuff = after
    crc_bits, fixed = (17, 6) if length <= 16 else (21, 7)
    data_bits = 1 + 4 + 8 * length + 4 + crc_bits + fixed + 1
    return FD_NOMINAL_BITS + (14 - 1) // (_RUN - 1), data_bits + max(stuff.values())


def exact_bits_batch(can_id: ArrayLike, dlc: ArrayLike, data: ArrayLike) -> _Int:
    """Count the bits of each classic data frame, like :func:`exact_bits` for a single frame.

    Args:
        can_id: (n,) identifiers of 11 bits.
        dlc: (n,) data lengths, in bytes.
        data: (n, 8) bytes; bytes beyond the length are ignored.

    Returns:
        (n,) bits.

    Raises:
        ValueError: if a shape, an identifier or a length is wrong.
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
    bits = np.empty(n, np.int64)
    stuffing.classic_bits(ids.astype(np.uint32), lengths.astype(np.uint8), payload.flatten(), 8, bits)
    return bits


class BusLoad:
    """Counts frames and their exact number of bits.

    Adding a frame is fast, because bits are counted later, for a batch of frames. Instances are not
    thread-safe.

    Args:
        bitrate_bps: nominal bit rate, in bit/s.
        data_bitrate_bps: CAN FD data bit rate, in bit/s; defaults to the nominal bit rate.

    Raises:
        ConfigError: if a bit rate is not positive.
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

    def add(  # noqa: PLR0913 - the properties of a frame
        self,
        can_id: int,
        data: bytes,
        *,
        extended: bool = False,
        remote: bool = False,
        dlc: int = 0,
        fd: bool = False,
    ) -> None:
        """Add a frame; its bits are counted as in :func:`exact_bits` or, for CAN FD, :func:`fd_bits`.

        Only a reference to ``data`` is stored until the bits are counted.
        """
        if extended or remote:
            self._bits += exact_bits(can_id, data, extended=extended, remote=remote, dlc=dlc)
            self._frames += 1
            return
        self.add_all(((can_id, data),), fd=fd)

    def add_all(self, frames: Iterable[tuple[int, bytes, *tuple[object, ...]]], *, fd: bool = False) -> None:
        """Count data frames with 11-bit identifiers.

        Args:
            frames: for each frame, a tuple of identifier and data; further items are ignored.
            fd: whether the frames are CAN FD frames.
        """
        ids, data = self._fd if fd else self._classic
        ids += [frame[0] for frame in frames]
        data += [frame[1] for frame in frames]
        if len(ids) >= self._BATCH:
            self._work_off()

    @property
    def frames(self) -> int:
        """Number of frames counted so far."""
        return self._frames + len(self._classic[0]) + len(self._fd[0])

    @property
    def bits(self) -> int:
        """Total duration of all counted frames, in nominal bit times."""
        self._work_off()
        return self._bits + round(self._fast_bits * self._data_bit)

    def load(self, time_s: float) -> float:
        """Return the duration of all counted frames divided by ``time_s``; the ratio can exceed 1.

        Args:
            time_s: length of the interval, in s.
        """
        return self.bits / (self.bitrate_bps * time_s) if time_s > 0 else 0.0

    def _work_off(self) -> None:
        ids, data = self._classic
        self._frames += len(ids)
        if not stuffing.are_loaded():  # loading the kernels would noticeably delay a short command
            self._bits += sum(map(exact_bits, ids, data))
        elif ids:
            self._bits += stuffing.classic_bits(*_packed(ids, data), 0, np.empty(len(ids), np.int64))
        ids.clear()
        data.clear()
        ids, data = self._fd
        self._frames += len(ids)
        if ids:
            nominal, fast = np.empty((2, len(ids)), np.int64)
            stuffing.fd_bits(*_packed(ids, data), nominal, fast)
            self._bits += int(nominal.sum())
            self._fast_bits += int(fast.sum())
        ids.clear()
        data.clear()


def _packed(
    ids: list[int], data: list[bytes]
) -> tuple[NDArray[np.uint32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the (n,) identifiers, the (n,) lengths and the concatenated data as arrays.

    The arrays are writable copies, because numba would recompile the kernels for read-only arrays.
    """
    lengths, joined = bytearray(map(len, data)), bytearray().join(data)
    return np.array(array("I", ids)), np.frombuffer(lengths, np.uint8), np.array(joined, np.uint8)
