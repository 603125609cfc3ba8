"""Packs and unpacks the summary, which a patch sends in TPDO2 at the end of each scan."""

from __future__ import annotations

import enum
import struct
from typing import Final, NamedTuple

from skinnode.canopen import indices as od
from skinnode.protocol.device_time import TIME_SHIFT
from skinnode.protocol.payload import PDO_BYTES, require_length
from skinnode.protocol.scan_check import scan_check

_COB_ID: Final = od.summary_cob_id(0)
_SUMMARY: Final = struct.Struct("<BBHI")
_HEAD: Final = struct.Struct("<BBHH")

HEAD_BYTES: Final = _HEAD.size
"""Number of leading summary bytes that are covered by the scan check."""


class SummaryFlag(enum.IntFlag):
    """Flags of a scan summary. Undefined bits are sent as 0 and ignored on reception."""

    CHANGED_ONLY = 0x01
    """Only changed chunks were sent. All other chunks are the same as in the previous scan."""
    OVERRUN = 0x02
    """Some chunks of the scan were not sent, so their codes are unknown."""
    WIRE_FAULT = 0x04
    """At least one wire is open or shorted; see 0x2030 and 0x2031."""
    BASELINE_CHANGED = 0x08
    """This scan is the first with a new baseline. The host must read the objects at 0x2200 and above
    again."""
    SOURCE_FAILED = 0x10
    """The converter returned no valid reading. No chunks were sent, and the codes are unknown."""
    CHECKED = 0x20
    """Bytes 4 to 7 of the summary contain the u16 device time in steps of 64 µs and the u16 scan check.
    Without this flag, as in revision 1.0 patches, bytes 4 to 7 contain the u32 device time in µs."""
    CONVERSIONS = 0xC0
    """Two-bit conversion phase. The phase cycles through 1, 2 and 3, and advances if the converter has
    completed a conversion of all crossings since the previous scan. Two successive scans with the same phase
    therefore contain the same conversion. The phase is 0 if the patch does not count its conversions."""


class Summary(NamedTuple):
    """Contents of a scan summary, as sent on the bus."""

    scan: int
    """Scan counter, u8."""
    flags: int
    """Bits of :class:`SummaryFlag`."""
    chunks: int
    """Number of chunks sent in this scan."""
    device_time_us: int
    """Time on the node's clock in µs, 0 to 2³² − 1. In a summary with a ``check``, only bits 6 to 21 are
    known and all others are 0; see :mod:`skinnode.protocol.device_time`."""
    check: int | None = None
    """Scan check (:mod:`skinnode.protocol.scan_check`); None if :attr:`SummaryFlag.CHECKED` is not set."""


PHASES: Final = 3
"""Number of conversion phases, not counting 0. A phase can be compared only with the phase of the previous
scan: after missed scans, the phase may have wrapped."""
PHASE_SHIFT: Final = 6
"""Position of the conversion phase's lowest bit in the flags."""

_CHECKED: Final = int(SummaryFlag.CHECKED)  # ten times as fast to test as an enum flag


def conversion_phase(flags: int) -> int:
    """Return the conversion phase from a summary's flags; 0 if the patch does not count its conversions."""
    return flags >> PHASE_SHIFT & 3


def conversion_flags(phase: int) -> int:
    """Return the summary flags that encode a conversion phase, 0 to 3."""
    return phase << PHASE_SHIFT


def pack_summary(scan: int, flags: int, chunks: int, device_time_us: int) -> bytes:
    """Pack a summary without a check into the payload of TPDO2, for a revision 1.0 patch.

    Args:
        scan: Scan counter, 0 to 255.
        flags: Bits of :class:`SummaryFlag` without ``CHECKED``.
        chunks: Number of chunks sent in this scan.
        device_time_us: Time on the node's clock in µs; wraps at 2³².

    Raises:
        ValueError: If the scan counter, the flags or the number of chunks does not fit in its field.
    """
    try:
        return _SUMMARY.pack(scan, flags, chunks, device_time_us & 0xFFFF_FFFF)
    except struct.error as error:
        raise ValueError(f"summary: got scan {scan}, flags {flags}, chunks {chunks}: {error}") from None


def pack_checked_summary(
    scan: int, flags: int, chunks: int, device_time_us: int, check_of_codes: int
) -> bytes:
    """Pack a summary with a check into the payload of TPDO2 and set :attr:`SummaryFlag.CHECKED`.

    Args:
        scan: Scan counter, 0 to 255.
        flags: Bits of :class:`SummaryFlag`.
        chunks: Number of chunks sent in this scan.
        device_time_us: Time on the node's clock in µs; wraps at 2³².
        check_of_codes: Result of :func:`~skinnode.protocol.scan_check.check_of_codes` for all codes after
            this scan, including those of unsent chunks.

    Raises:
        ValueError: If the scan counter, the flags or the number of chunks does not fit in its field.
    """
    steps = device_time_us >> TIME_SHIFT & 0xFFFF
    try:
        head = _HEAD.pack(scan, flags | _CHECKED, chunks, steps)
    except struct.error as error:
        raise ValueError(f"summary: got scan {scan}, flags {flags}, chunks {chunks}: {error}") from None
    return head + scan_check(check_of_codes, head).to_bytes(2, "little")


def pack_summary_record(payload: bytes, device_time_us: int) -> bytes:
    """Return the contents of record 0x2011 for a summary.

    In a summary with a check, the full device time is inserted before the 16-bit device time.

    Args:
        payload: The payload of TPDO2.
        device_time_us: Time on the node's clock in µs; wraps at 2³².
    """
    if not payload[1] & _CHECKED:
        return payload
    return payload[:4] + (device_time_us & 0xFFFF_FFFF).to_bytes(4, "little") + payload[4:]


def unpack_summary(data: bytes, *, cob_id: int = _COB_ID) -> Summary:
    """Unpack a summary (with or without a check) from the payload of TPDO2.

    Args:
        data: Payload of the frame.
        cob_id: COB-ID for the error message.

    Raises:
        CodecError: If the payload is not 8 bytes long.
    """
    require_length(data, PDO_BYTES, cob_id, "scan summary")
    scan, flags, chunks, rest = _SUMMARY.unpack(data)
    if not flags & _CHECKED:
        return Summary(scan, flags, chunks, rest)
    return Summary(scan, flags, chunks, (rest & 0xFFFF) << TIME_SHIFT, rest >> 16)
