"""Emergency (EMCY) error codes, and texts for these codes, the error register and the error history.

The codes are defined in CiA 301 v4.2, 7.2.7, tables 26 and 48. Patches of this project use some of them in a
narrower sense. Manufacturer-specific bytes are decoded only if the sender is such a patch.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from skinnode.text.words import counted


class EmcyCode(IntEnum):
    """Error codes that a patch sends."""

    RESET = 0x0000
    HARDWARE = 0x5000
    DATA_SET = 0x6300
    CAN_OVERRUN = 0x8110
    CAN_PASSIVE = 0x8120
    HEARTBEAT = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    CAN_ID_COLLISION = 0x8150
    SYNC_WINDOW = 0x8200
    """A synchronous TPDO was not ready within the synchronous window (0x1007). Detail: u16 TPDO number. CiA
    301 defines no specific code, so this is the generic protocol error."""
    PDO_NOT_PROCESSED = 0x8210
    PDO_LENGTH_EXCEEDED = 0x8220
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250
    SOURCE = 0xFF00
    """The converter returned no valid reading. Detail: u8 fault (1 failed, 2 wrong array shape), u16 number
    of failures.
    """

    @property
    def register_bit(self) -> int:
        """Error register bit that this error sets: communication or manufacturer-specific."""
        return 0x10 if self >> 12 == 8 else 0x80


TOO_SLOW: Final = 1
"""Third detail byte of EMCY 0x8110 if scans were skipped because the node's computer or the bus was too slow.

If the byte is 0, the scan period is too short to send all chunks at intervals of the inhibit time. The first
two detail bytes are the number of skipped scans.
"""

_CODES: Final = {
    0x0000: "no error, or an error has ended",
    0x8110: "CAN overrun: messages lost",
    0x8120: "CAN error passive",
    0x8130: "heartbeat or guarding lost",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO not processed: wrong length",
    0x8220: "PDO too long",
    0x8230: "multiplexed PDO not processed: no such object",
    0x8240: "SYNC of unexpected length",
    0x8250: "RPDO timed out",
}
_OWN_CODES: Final[dict[int, str]] = {
    EmcyCode.HARDWARE: "wire open or shorted",
    EmcyCode.DATA_SET: "stored data",
    EmcyCode.CAN_OVERRUN: "overrun: messages or scans lost",
    EmcyCode.CAN_ID_COLLISION: "CAN-ID collision: another node has this node-ID",
    EmcyCode.SYNC_WINDOW: "synchronous PDO too late",
    EmcyCode.PDO_NOT_PROCESSED: "PDO not processed: too short",
    EmcyCode.SOURCE: "no reading from the converter",
}
"""Texts for the error codes that a patch uses in a narrower sense than CiA 301 does."""
_CLASSES: Final = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "hardware",
    0x60: "software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device-specific",
}
_WIRE_FAULTS: Final = ("upper wire open", "upper wire shorted", "lower wire open", "lower wire shorted")
_DATA_FAULTS: Final = {
    1: "the memory is unreadable",
    2: "the memory is damaged",
    3: "the memory belongs to another patch",
    4: "an object does not accept its stored value",
    5: "could not be saved",
}
_SOURCE_FAULTS: Final = {1: "the source failed", 2: "the source returned an array of the wrong shape"}
_REGISTER: Final = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "profile-specific",
    "reserved",
    "manufacturer-specific",
)


def error_text(code: int, detail: bytes = b"", *, ours: bool) -> str:
    """Return a description of an emergency error code.

    Args:
        code: error code.
        detail: manufacturer-specific bytes; the error history contains only the first two.
        ours: whether the sender is a patch of this project, according to its vendor-ID and product code. If
            not, the description follows CiA 301.
    """
    own = _OWN_CODES.get(code) if ours else None
    text = own or _CODES.get(code) or _CLASSES.get(code >> 8) or f"error of class 0x{code >> 12:X}000"
    more = _detail_text(code, detail) if ours else ""
    return f"{text}: {more}" if more else text


def history_text(entry: int, *, ours: bool) -> str:
    """Return a description of an entry in the error history (0x1003).

    Args:
        entry: error code (lower 16 bits) and manufacturer-specific information (upper 16 bits).
        ours: whether the sender is a patch of this project. If not, the manufacturer-specific information is
            shown as a number.
    """
    code, more = entry & 0xFFFF, entry >> 16
    text = f"0x{code:04X} {error_text(code, more.to_bytes(2, 'little'), ours=ours)}"
    return text if ours or not more else f"{text} (manufacturer-specific: 0x{more:04X})"


def says_too_slow(code: int, detail: bytes) -> bool:
    """Return whether an emergency message reports that scans were skipped because of a slow computer or bus.

    Such a message does not indicate a fault in the skin.

    Args:
        code: error code.
        detail: manufacturer-specific bytes.
    """
    return code == EmcyCode.CAN_OVERRUN and detail[:2] != b"\0\0" and detail[2:3] == bytes((TOO_SLOW,))


def register_text(register: int) -> str:
    """Return the names of the bits set in an error register (0x1001)."""
    return ", ".join(name for bit, name in enumerate(_REGISTER) if register >> bit & 1) or "no error"


def _detail_text(code: int, detail: bytes) -> str:
    explain = _DETAILS.get(code)
    return explain(detail) if explain is not None and len(detail) >= 2 else ""


def _word(detail: bytes) -> int:
    return int.from_bytes(detail[:2], "little")


def _wires(detail: bytes) -> str:
    kind, wire = detail[0], detail[1]
    if kind >= len(_WIRE_FAULTS):
        return ""
    count = int.from_bytes(detail[2:4], "little") if len(detail) >= 4 else 1
    return f"{_WIRE_FAULTS[kind]} {wire}" + (f", {count} wires in total" if count > 1 else "")


def _skipped(detail: bytes) -> str:
    if not _word(detail):
        return ""
    skipped = f"{counted(_word(detail), 'scan')} skipped so far"
    slow = says_too_slow(EmcyCode.CAN_OVERRUN, detail)
    return f"{skipped} because the computer running the node is too slow" if slow else skipped


def _silent(detail: bytes) -> str:
    if not detail[0]:
        return "master"
    return f"node {detail[0]} restarted" if detail[1] else f"node {detail[0]}"


def _wrong_length(detail: bytes) -> str:
    number = detail[0] | (detail[3] << 8 if len(detail) > 3 else 0)
    got = f"RPDO{number}, {counted(detail[1], 'byte')}"
    return f"{got} instead of {detail[2]}" if len(detail) >= 3 else got


_DETAILS: Final[dict[int, Callable[[bytes], str]]] = {
    EmcyCode.HARDWARE: _wires,
    EmcyCode.DATA_SET: lambda detail: _DATA_FAULTS.get(detail[0], ""),
    EmcyCode.CAN_OVERRUN: _skipped,
    EmcyCode.HEARTBEAT: _silent,
    EmcyCode.PDO_NOT_PROCESSED: _wrong_length,
    EmcyCode.PDO_LENGTH_EXCEEDED: _wrong_length,
    EmcyCode.SYNC_LENGTH: lambda detail: f"{counted(detail[0], 'byte')} instead of {detail[1]}",
    EmcyCode.SYNC_WINDOW: lambda detail: f"TPDO{_word(detail)}" if _word(detail) else "",
    EmcyCode.RPDO_TIMEOUT: lambda detail: f"RPDO{_word(detail)}",
    EmcyCode.CAN_ID_COLLISION: lambda detail: f"0x{_word(detail):03X}",
    EmcyCode.SOURCE: lambda detail: _SOURCE_FAULTS.get(detail[0], ""),
}
"""Functions that describe the manufacturer-specific bytes from a patch, keyed by error code. They require at
least two bytes."""
