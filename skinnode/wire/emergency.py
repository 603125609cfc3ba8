"""Emergency messages, the error register and the error history in words (CiA 301 v4.2, 7.2.7, tables 26 and
48; what follows a code is the patch's own)."""

from __future__ import annotations

from typing import Final

_CODES: Final = {
    0x0000: "no error, or an error is over",
    0x5000: "wire open or shorted",
    0x6300: "stored data",
    0x8110: "overrun: messages or scans lost",
    0x8120: "CAN error passive",
    0x8130: "heartbeat or guarding lost",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision: another node has this node-ID",
    0x8210: "PDO not processed: too short",
    0x8220: "PDO too long",
    0x8240: "SYNC of unexpected length",
    0x8250: "RPDO timed out",
    0xFF00: "no reading from the converter",
}
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
    3: "the memory is of another patch",
    4: "an object refuses what was stored",
    5: "could not be saved",
}
_SOURCE_FAULTS: Final = {1: "it failed", 2: "it gave an array of another shape"}
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


def error_text(code: int, detail: bytes = b"") -> str:
    """An emergency error code in words. ``detail``: what follows it, of a patch of ours; the first two bytes
    are in the history as well."""
    text = _CODES.get(code) or _CLASSES.get(code >> 8) or f"error of class 0x{code >> 12:X}000"
    more = _detail_text(code, detail)
    return f"{text}: {more}" if more else text


def history_text(entry: int, *, ours: bool) -> str:
    """An entry of 0x1003: the code, and above it two bytes of the maker, here known if it is ``ours``."""
    code = entry & 0xFFFF
    return f"0x{code:04X} {error_text(code, (entry >> 16).to_bytes(2, 'little') if ours else b'')}"


def register_text(register: int) -> str:
    """The bits of the error register (0x1001) that are set."""
    return ", ".join(name for bit, name in enumerate(_REGISTER) if register >> bit & 1) or "no error"


def _detail_text(code: int, detail: bytes) -> str:
    if len(detail) < 2:
        return ""
    first, second = detail[0], detail[1]
    word = first | second << 8
    match code:
        case 0x5000 if first < len(_WIRE_FAULTS):
            count = int.from_bytes(detail[2:4], "little") if len(detail) >= 4 else 1
            return f"{_WIRE_FAULTS[first]} {second}" + (f", {count} wires in all" if count > 1 else "")
        case 0x6300:
            return _DATA_FAULTS.get(first, "")
        case 0x8110 if word:
            return f"{word} scans skipped so far"
        case 0x8130 if first:
            return f"node {first} restarted" if second else f"of node {first}"
        case 0x8130:
            return "of the master"
        case 0x8210 | 0x8220 if len(detail) >= 3:
            return f"RPDO{first}, {second} bytes in place of {detail[2]}"
        case 0x8210 | 0x8220:
            return f"RPDO{first}, {second} bytes"
        case 0x8240:
            return f"{first} bytes in place of {second}"
        case 0x8250:
            return f"RPDO{word}"
        case 0x8150:
            return f"0x{word:03X}"
        case 0xFF00:
            return _SOURCE_FAULTS.get(first, "")
    return ""
