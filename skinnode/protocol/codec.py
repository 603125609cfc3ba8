"""Ohm to code to PDO payload and back. Pure functions of numbers and bytes; all payloads are little-endian.

code = round((R/R0 − lo) / (hi − lo) · (2ⁿ − 4)). The codes 0 … 2ⁿ − 4 are measurements; the three above them
are reserved, in ascending order: over-range, short, open.
"""

from __future__ import annotations

import binascii
import enum
import functools
import math
import operator
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.canopen import indices as od
from skinnode.errors import CodecError, ConfigError
from skinnode.model.layout import Float
from skinnode.protocol.profile import DEFAULT_CODE_HI, DEFAULT_CODE_LO, PatchProfile
from skinnode.text.words import counted

Codes = NDArray[np.uint32]

MISSING: Final = 0xFFFF_FFFF
"""Stands where no code was received. Wider than any code, so it is never on the wire and never decodes."""

PDO_BYTES: Final = 8
"""Of a classic chunk and of every summary."""
_CODE_BITS: Final = (16, 24)
_CHUNK_COB_ID: Final = od.chunk_cob_id(0)
_SUMMARY_COB_ID: Final = od.summary_cob_id(0)
_COMMAND_COB_ID: Final = od.command_cob_id(0)


@dataclass(frozen=True)
class CodeScale:
    """How R/R0 maps to codes. ``lo`` and ``hi`` are rounded to REAL32, as the object dictionary keeps them.

    Raises ConfigError for a width other than 16 and 24 bits, or a range that is not 0 ≤ lo < hi < ∞.
    """

    bits: int = 16
    lo: float = DEFAULT_CODE_LO
    hi: float = DEFAULT_CODE_HI

    def __post_init__(self) -> None:
        if self.bits not in _CODE_BITS:
            raise ConfigError("code_bits", self.bits, "16 or 24")
        lo, hi = float(np.float32(self.lo)), float(np.float32(self.hi))
        if not 0.0 <= lo < hi < math.inf:
            raise ConfigError("code range", (self.lo, self.hi), "0 <= lo < hi, both finite")
        object.__setattr__(self, "lo", lo)
        object.__setattr__(self, "hi", hi)

    @functools.cached_property
    def steps(self) -> int:
        """The highest measurement, at ``hi``."""
        return (1 << self.bits) - 4

    @property
    def over_range(self) -> int:
        """Reserved: R/R0 outside lo … hi, or no baseline yet."""
        return self.steps + 1

    @property
    def short(self) -> int:
        """Reserved: no resistance between the wires."""
        return self.steps + 2

    @property
    def open(self) -> int:
        """Reserved: no connection between the wires."""
        return self.steps + 3

    @functools.cached_property
    def step(self) -> float:
        """One code as a share of R0."""
        return (self.hi - self.lo) / self.steps

    @property
    def relative_std(self) -> float:
        """RMS of the rounding error as a share of R0: a uniform error of one step, step / √12."""
        return self.step / math.sqrt(12.0)


def as_baseline(baseline_ohm: ArrayLike) -> Float:
    """R0 as both ends of the bus know it: REAL32."""
    return np.asarray(baseline_ohm, dtype=np.float32).astype(np.float64)


def encode(resistance_ohm: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> Codes:
    """Codes of resistances, any shape; ``baseline_ohm`` (R0) of the same shape or broadcast to it.

    +inf and NaN become open, zero and below short, R/R0 outside lo … hi over-range, and so does a measurement
    without a baseline (R0 not positive and finite). A value within half a step of the range is in the range.
    """
    resistance = np.asarray(resistance_ohm, dtype=np.float64)
    baseline = as_baseline(baseline_ohm)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        code = np.rint((resistance / baseline - scale.lo) / scale.step)
        measured = (code >= 0) & (code <= scale.steps) & (baseline > 0) & (baseline < np.inf)
        codes = np.where(measured, code, scale.over_range)
        codes = np.where(resistance <= 0, scale.short, codes)
        codes = np.where(resistance < np.inf, codes, scale.open)  # NaN is not below inf either
    return codes.astype(np.uint32)


def decode(codes: ArrayLike, baseline_ohm: ArrayLike, scale: CodeScale) -> tuple[Float, NDArray[np.bool_]]:
    """Resistances in ohm and which of them are measurements, both of the shape of ``codes``.

    A reserved code, :data:`MISSING` or a baseline that is not positive and finite gives NaN and False.
    """
    return Decoder(baseline_ohm, scale).decode(codes)


class Decoder:
    """:func:`decode` for many scans with the same baseline."""

    def __init__(self, baseline_ohm: ArrayLike, scale: CodeScale) -> None:
        self._baseline, self._scale = as_baseline(baseline_ohm), scale
        known = (self._baseline > 0) & (self._baseline < np.inf)
        self._known: NDArray[np.bool_] | None = None if known.all() else known

    def decode(self, codes: ArrayLike) -> tuple[Float, NDArray[np.bool_]]:
        """As :func:`decode`."""
        code, scale = np.asarray(codes), self._scale
        valid: NDArray[np.bool_] = code <= scale.steps
        if self._known is not None:
            valid = valid & self._known
        resistance = (scale.lo + code * scale.step) * self._baseline
        if not valid.all():
            resistance = np.where(valid, resistance, np.nan)
        return resistance, valid


# --- chunk (TPDO1)


class Chunk(NamedTuple):
    """A chunk of a scan as it is on the wire."""

    chunk: int
    """Chunk index: its first code is the ``chunk · codes_per_chunk``-th of the scan."""
    scan: int
    codes: tuple[int, ...]


def pack_chunk(chunk: int, scan: int, codes: Sequence[int], bits: int = 16) -> bytes:
    """Payload of TPDO1. ``codes``: up to 3 of 16 bits or 2 of 24; the rest is 0.

    Raises ValueError for a number that does not fit its field.
    """
    width = bits // 8
    if not (0 <= chunk <= 255 and 0 <= scan <= 255):
        raise ValueError(f"chunk, scan: got {chunk}, {scan}, must be from 0 to 255")
    try:
        body = b"".join(int(code).to_bytes(width, "little") for code in codes)
    except OverflowError:
        raise ValueError(f"codes: got {list(codes)}, must be from 0 to {(1 << bits) - 1}") from None
    if len(body) > PDO_BYTES - 2:
        raise ValueError(f"codes: got {len(codes)} of {bits} bits, must be at most {6 // width}")
    return bytes((chunk, scan)) + body.ljust(PDO_BYTES - 2, b"\0")


def unpack_chunk(data: bytes, bits: int = 16, *, cob_id: int = _CHUNK_COB_ID) -> Chunk:
    """The chunk in the payload of TPDO1. Raises CodecError, naming ``cob_id``, unless it is 8 bytes long."""
    _require_length(data, PDO_BYTES, cob_id, "chunk")
    width = bits // 8
    codes = tuple(int.from_bytes(data[at : at + width], "little") for at in range(2, PDO_BYTES, width))
    return Chunk(data[0], data[1], codes)


def pack_scan(codes: ArrayLike, scan: int, profile: PatchProfile) -> list[bytes]:
    """Payloads of all chunks of a scan, in order. ``codes``: (U, K); ``scan``: its u8 counter.

    Raises ValueError for another shape or a code wider than the profile's.
    """
    array = np.asarray(codes, dtype=np.uint32)
    if array.shape != (profile.rows, profile.columns):
        raise ValueError(f"codes: got shape {array.shape}, must be ({profile.rows}, {profile.columns})")
    if int(array.max()) >> profile.code_bits:
        raise ValueError(f"codes: got {int(array.max())}, must be below {1 << profile.code_bits}")
    width, per, size, n = (
        profile.code_bits // 8,
        profile.codes_per_chunk,
        profile.chunk_bytes,
        profile.n_chunks,
    )
    lines = array.reshape(profile.lines, -1)
    padded = np.zeros((profile.lines, profile.chunks_per_line * per), dtype="<u4")
    padded[:, : lines.shape[1]] = lines
    frames = np.zeros((n, size), dtype=np.uint8)
    if profile.bus == "classic":
        frames[:, 0] = np.arange(n)
    else:
        wire, part = np.divmod(np.arange(n), profile.chunks_per_line)
        frames[:, 0] = wire
        frames[:, 2:4] = (part * per).astype("<u2")[:, None].view(np.uint8)
    frames[:, 1] = scan
    head = profile.chunk_head_bytes
    frames[:, head : head + per * width] = padded.view(np.uint8).reshape(-1, 4)[:, :width].reshape(n, -1)
    payload = frames.tobytes()
    return [payload[at : at + size] for at in range(0, len(payload), size)]


def unpack_scan(frames: bytes, profile: PatchProfile) -> Codes:
    """(U, K) codes from the payloads of all chunks of a scan in ascending order, one after the other."""
    return unpack_scan_with_check(frames, profile)[0]


def unpack_scan_with_check(frames: bytes, profile: PatchProfile) -> tuple[Codes, int]:
    """Unpack like :func:`unpack_scan`, and also return the :func:`check_of_codes` of the codes."""
    places = _places_of_codes(profile)
    if profile.code_bits == 16:
        narrow = np.frombuffer(frames, "<u2").take(places)
        return narrow.astype(np.uint32), binascii.crc_hqx(narrow.tobytes(), _CRC_INITIAL)
    wide = np.frombuffer(frames + b"\0", np.uint8).take(places)
    codes: Codes = wide.view("<u4")[:, :, 0]
    return codes, binascii.crc_hqx(wide[:, :, :3].tobytes(), _CRC_INITIAL)


@functools.lru_cache(maxsize=64)
def _places_of_codes(profile: PatchProfile) -> NDArray[np.intp]:
    """Where each code is in the payloads of a scan: (U, K) words of 16 bits, or (U, K, 4) bytes of codes of
    24, the last of which is a zero after the payloads."""
    width, per, head = profile.code_bits // 8, profile.codes_per_chunk, profile.chunk_head_bytes
    lines, shape = profile.lines, (profile.rows, profile.columns)
    numbers = np.arange(profile.n_chunks * profile.chunk_bytes).reshape(profile.n_chunks, -1)
    first = numbers[:, head : head + per * width : width].reshape(lines, -1)  # byte of each code
    first = first[:, : profile.n_codes // lines].reshape(shape)
    if width == 2:
        return first // 2
    return np.stack([first, first + 1, first + 2, np.full(shape, numbers.size)], axis=-1)


@functools.lru_cache(maxsize=64)
def chunk_of_code(profile: PatchProfile) -> NDArray[np.intp]:
    """(U, K) which chunk of a scan carries each code, counted from 0 in the order they are sent."""
    lines, per_line = profile.lines, profile.n_codes // profile.lines
    within = np.arange(per_line) // profile.codes_per_chunk
    chunks = np.arange(lines)[:, None] * profile.chunks_per_line + within
    chunks = chunks.reshape(profile.rows, profile.columns)
    chunks.setflags(write=False)
    return chunks


def chunk_indexer(profile: PatchProfile) -> Callable[[bytes], int]:
    """A function from the payload of a chunk to its number, counted as in :func:`chunk_of_code`. Numbers from
    ``n_chunks`` on are of chunks that the patch does not have. It does not look at the length."""
    if profile.bus == "classic":
        return operator.itemgetter(0)
    rows, columns, n = profile.rows, profile.columns, profile.n_chunks
    per, per_line = profile.codes_per_chunk, profile.chunks_per_line

    def index(data: bytes) -> int:
        column = data[2]
        if data[0] >= rows or data[3] or column >= columns or column % per:  # no patch has 256 columns
            return n
        return data[0] * per_line + column // per

    return index


# --- scan summary (TPDO2)


class SummaryFlag(enum.IntFlag):
    """Flags of a scan summary. Bits not named here are sent as 0 and ignored."""

    CHANGED_ONLY = 0x01
    """Only chunks that changed were sent: any other is as in the scan before."""
    OVERRUN = 0x02
    """The next SYNC came first: chunks were left out, and nothing is known about them."""
    WIRE_FAULT = 0x04
    """A wire is open or shorted: see 0x2030 and 0x2031."""
    BASELINE_CHANGED = 0x08
    """The codes of this scan are the first of a new baseline: read 0x2200 … again."""
    SOURCE_FAILED = 0x10
    """The converter gave no reading: no chunk was sent, and nothing is known of this scan."""
    CHECKED = 0x20
    """Bytes 4 to 7 are u16 device time in steps of 64 µs and u16 scan check. Without this flag, as in patches
    of revision 1.0, they are u32 device time in µs."""


class Summary(NamedTuple):
    """A scan summary as it is on the wire."""

    scan: int
    flags: int
    chunks: int
    """Chunks sent in this scan."""
    device_time_us: int
    """Device time, µs, 0 to 2³² − 1; with a ``check``, a multiple of 64 from 0 to 2²² − 64: see
    :func:`restore_time_us`."""
    check: int | None = None
    """Check of the scan, see :func:`scan_check`; None in a summary without :attr:`SummaryFlag.CHECKED`."""


TIME_STEP_US: Final = 64
"""Unit of the 16-bit device time in a checked summary. It is a power of two, so that the time, which wraps
every 4.2 s, stays in step with the 32-bit time in µs; a host that knows the time to ±2 s restores the upper
bits."""
_CHECKED: Final = int(SummaryFlag.CHECKED)  # testing an int takes a tenth of the time of a flag
_TIME_SHIFT: Final = 6
TIME_WRAP_US: Final = TIME_STEP_US << 16
"""Range of the 16-bit device time, 4.2 s."""

_CRC_INITIAL: Final = 0xFFFF

_SUMMARY: Final = struct.Struct("<BBHI")
_SUMMARY_HEAD: Final = struct.Struct("<BBHH")


def check_of_codes(codes: Codes, profile: PatchProfile) -> int:
    """Return the CRC over the matrix (U, K) alone, which :func:`scan_check` continues."""
    if profile.code_bits == 16:
        return binascii.crc_hqx(codes.astype("<u2").tobytes(), _CRC_INITIAL)
    octets = codes.astype("<u4").view(np.uint8).reshape(*codes.shape, 4)
    return binascii.crc_hqx(octets[:, :, :3].tobytes(), _CRC_INITIAL)


def scan_check(check_of_codes: int, head: bytes) -> int:
    """Return the check over a whole scan: the codes that its receiver must hold, and its summary.

    CRC-16/IBM-3740: polynomial x¹⁶ + x¹² + x⁵ + 1 (0x1021), initial value 0xFFFF, most significant bit first,
    not inverted; check value 0x29B1 for the ASCII digits ``123456789``. It covers, in this order:

    1. All U·K codes, upper wire by upper wire, little-endian: 2 bytes each, or 3 for 24-bit codes.
       These are the codes that a receiver holds after this scan: if only changed chunks are sent, the last
       codes sent of every chunk, which may differ from the newest reading by the delta threshold.
    2. ``head``, the first 6 bytes of the summary: scan counter, flags, chunks sent, device time. A matrix of
       another scan therefore fails.

    The check always detects a change within 16 bits, such as of one 16-bit code; any odd number of wrong
    bits; and two wrong bits, in matrices of up to 4,087 bytes. Of all other damage it misses one case in
    65,536.
    """
    return binascii.crc_hqx(head, check_of_codes)


def pack_summary(scan: int, flags: int, chunks: int, device_time_us: int) -> bytes:
    """Return the payload of TPDO2 of a patch of revision 1.0. ``flags``: those of :class:`SummaryFlag`,
    without ``CHECKED``. ``device_time_us`` wraps at 2³².

    Raises ValueError for another number that does not fit.
    """
    try:
        return _SUMMARY.pack(scan, flags, chunks, device_time_us & 0xFFFF_FFFF)
    except struct.error as error:
        raise ValueError(f"summary: got scan {scan}, flags {flags}, chunks {chunks}: {error}") from None


def pack_checked_summary(
    scan: int, flags: int, chunks: int, device_time_us: int, check_of_codes: int
) -> bytes:
    """Return the payload of TPDO2 with a check and :attr:`SummaryFlag.CHECKED` set. ``device_time_us`` wraps
    at 2³²; ``check_of_codes``: :func:`check_of_codes` of the codes that the receiver must hold.

    Raises ValueError if any other number does not fit.
    """
    steps = device_time_us >> _TIME_SHIFT & 0xFFFF
    try:
        head = _SUMMARY_HEAD.pack(scan, flags | _CHECKED, chunks, steps)
    except struct.error as error:
        raise ValueError(f"summary: got scan {scan}, flags {flags}, chunks {chunks}: {error}") from None
    return head + scan_check(check_of_codes, head).to_bytes(2, "little")


def pack_summary_record(payload: bytes, device_time_us: int) -> bytes:
    """Return the record 0x2011 that belongs to a summary, its sub-objects concatenated."""
    if not payload[1] & _CHECKED:
        return payload
    return payload[:4] + (device_time_us & 0xFFFF_FFFF).to_bytes(4, "little") + payload[4:]


def unpack_summary(data: bytes, *, cob_id: int = _SUMMARY_COB_ID) -> Summary:
    """Unpack a summary, of either form, from the payload of TPDO2. Raises CodecError, naming ``cob_id``,
    unless it is 8 bytes long."""
    _require_length(data, PDO_BYTES, cob_id, "scan summary")
    scan, flags, chunks, rest = _SUMMARY.unpack(data)
    if not flags & _CHECKED:
        return Summary(scan, flags, chunks, rest)
    return Summary(scan, flags, chunks, (rest & 0xFFFF) << _TIME_SHIFT, rest >> 16)


def restore_time_us(low_us: int, expected_us: int) -> int:
    """Return the unwrapped device time in µs whose low bits are ``low_us``, as in a checked summary, nearest
    to ``expected_us``."""
    return expected_us + (low_us - expected_us + TIME_WRAP_US // 2) % TIME_WRAP_US - TIME_WRAP_US // 2


# --- self-test (0x2023)


class SelfTestStatus(enum.IntEnum):
    """0x2023:1."""

    NEVER_RUN = 0
    PASSED = 1
    FAILED = 2


class SelfTestFault(enum.IntFlag):
    """0x2023:2, what a self-test found."""

    SOURCE = 0x01
    """The converter failed to give a reading at least once."""
    NOISE = 0x02
    OPEN_WIRE = 0x04
    SHORTED_WIRE = 0x08
    OUT_OF_RANGE = 0x10
    """Crossings with a baseline that gave no measurement: open, shorted or outside lo … hi."""
    NO_BASELINE = 0x20


class SelfTest(NamedTuple):
    """What a self-test found; 0x2023 from sub-index 2 on."""

    faults: SelfTestFault
    readings: int
    noise: float
    """Relative, RMS over the crossings."""
    open_wires: int
    shorted_wires: int
    out_of_range: int
    untared: int


_SELF_TEST: Final = struct.Struct("<BHBfHHII")
SELF_TEST_NEVER_RUN: Final = bytes(_SELF_TEST.size)


def pack_self_test(test: SelfTest) -> bytes:
    """The record 0x2023, its sub-objects one after the other."""
    return _SELF_TEST.pack(SelfTestStatus.FAILED if test.faults else SelfTestStatus.PASSED, *test)


# --- command (RPDO1)


class SendMode(enum.IntEnum):
    """0x2020:1, which chunks of a scan are sent."""

    FULL = 0
    CHANGED = 1


class Command(NamedTuple):
    """A command as it is on the wire."""

    tare: int
    """:data:`~skinnode.canopen.indices.od.TARE_SIGNATURE` to tare, anything else does nothing."""
    single_scan: int
    send_mode: int


_COMMAND: Final = struct.Struct("<IBB")


def pack_command(
    *, tare: bool = False, single_scan: bool = False, send_mode: SendMode = SendMode.FULL
) -> bytes:
    """Payload of RPDO1. It always carries the send mode, which stays until told otherwise."""
    return _COMMAND.pack(od.TARE_SIGNATURE if tare else 0, single_scan, send_mode)


def unpack_command(data: bytes, *, cob_id: int = _COMMAND_COB_ID) -> Command:
    """The command in the payload of RPDO1, of which bytes beyond the mapped six are ignored (CiA 301).

    Raises CodecError, naming ``cob_id``, when it is shorter.
    """
    if len(data) < _COMMAND.size:
        raise CodecError(cob_id, data, f"at least {_COMMAND.size} bytes (command)")
    return Command(*_COMMAND.unpack_from(data))


def _require_length(data: bytes, length: int, cob_id: int, what: str) -> None:
    if len(data) != length:
        raise CodecError(cob_id, data, f"{counted(length, 'byte')} ({what})")
