"""SDO client for conformance tests (CiA 301 v4.2.0, 7.2.4.3): expedited, segmented and block transfer.

The client checks every byte of a response and can violate the protocol on purpose. It shares no code with
this project's SDO server.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import Final

from skinnode.conformance.tester import ANSWER_S, Failed, Tester, describe
from skinnode.text.words import counted
from skinnode.transport import Frame

GENERAL_ERROR: Final = 0x0800_0000
"""Abort code "general error", which a device may send instead of a specific code."""

MEANINGS: Final = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access",
    0x0601_0001: "write-only",
    0x0601_0002: "read-only",
    0x0602_0000: "no such object",
    0x0604_0041: "cannot be mapped",
    0x0604_0042: "PDO length exceeded",
    0x0604_0043: "parameters incompatible",
    0x0604_0047: "internally incompatible",
    0x0606_0000: "hardware error",
    0x0607_0010: "length does not match",
    0x0607_0012: "length too high",
    0x0607_0013: "length too low",
    0x0609_0011: "no such sub-index",
    0x0609_0030: "invalid value",
    0x0609_0031: "value too high",
    0x0609_0032: "value too low",
    0x0609_0036: "maximum below minimum",
    0x060A_0023: "resource not available",
    0x0800_0000: "general error",
    0x0800_0020: "cannot be stored",
    0x0800_0021: "local control",
    0x0800_0022: "device state",
    0x0800_0023: "no object dictionary",
    0x0800_0024: "no data",
}
"""Meanings of the SDO abort codes (CiA 301 v4.2.0, table 22)."""

_SEGMENT: Final = 7
_MOST_BYTES: Final = 1 << 20  # limits uploads in case the device never sends the last segment
_BLOCK_SIZE: Final = 20


class Aborted(Failed):
    """Raised if the device aborts a transfer that must succeed; ``code`` is the abort code."""

    def __init__(self, what: str, code: int) -> None:
        self.code = code
        super().__init__(what, f"abort {name(code)}")


def name(code: int) -> str:
    """Return an abort code in hexadecimal with its meaning."""
    return f"0x{code:08X} ({MEANINGS.get(code, 'not defined in CiA 301')})"


def crc16(data: bytes) -> int:
    """Return the CRC of a block transfer: x¹⁶ + x¹² + x⁵ + 1, initial value 0 (CiA 301, 7.2.4.3.16)."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def mux(index: int, subindex: int) -> bytes:
    """Return the multiplexer of an SDO message: index and sub-index as three bytes."""
    return struct.pack("<HB", index, subindex)


class SdoClient:
    """SDO client that uses the default SDO of node ``node_id``."""

    def __init__(self, bus: Tester, node_id: int) -> None:
        self._bus = bus
        self.request_id, self.answer_id = 0x600 + node_id, 0x580 + node_id

    # --- frames

    def send(self, request: bytes) -> None:
        """Send an SDO request, padded to eight bytes."""
        self._bus.send(self.request_id, request.ljust(8, b"\0"))

    def answer(self, what: str) -> bytes:
        """Return the next response. Raises Failed if no response of eight bytes arrives."""
        return self._checked(self._bus.take(self.answer_id, ANSWER_S), what)

    def ask(self, request: bytes, what: str) -> bytes:
        """Discard pending responses, send a request, and return the response, which may be an abort."""
        self._bus.pending(self.answer_id)
        self.send(request)
        return self.answer(what)

    def served(self, request: bytes, what: str) -> bytes:
        """Send a request and return the response, like :meth:`ask`. Raises Aborted if the device aborts."""
        return _not_aborted(self.ask(request, what), what)

    def _checked(self, frame: Frame | None, what: str) -> bytes:
        if frame is None:
            raise Failed(f"a response to {what} within {ANSWER_S:g} s", "nothing")
        if len(frame.data) != 8:
            raise Failed(f"a response of 8 bytes to {what}", describe(frame))
        return frame.data

    def abort(self, index: int, subindex: int, code: int = GENERAL_ERROR) -> None:
        """Abort the current transfer; the device does not respond."""
        self.send(b"\x80" + mux(index, subindex) + struct.pack("<I", code))

    def aborts(self, request: bytes, index: int, subindex: int, codes: Collection[int], what: str) -> int:
        """Send a request that the device must abort; return the abort code.

        The abort must name the object and have one of ``codes`` or the general-error code.
        """
        return self.check_abort(self.ask(request, what), index, subindex, codes, what)

    @staticmethod
    def check_abort(answer: bytes, index: int, subindex: int, codes: Collection[int], what: str) -> int:
        """Return the abort code of ``answer``.

        Raises Failed unless ``answer`` is an abort that names the object and has one of ``codes`` or the
        general-error code.
        """
        allowed = " or ".join(f"0x{code:08X}" for code in sorted({*codes, GENERAL_ERROR}))
        expected = f"{what} aborted with {allowed}"
        if answer[0] != 0x80:
            raise Failed(expected, answer.hex(" ").upper())
        code = int.from_bytes(answer[4:8], "little")
        if code not in codes and code != GENERAL_ERROR:
            raise Failed(expected, name(code))
        if answer[1:4] != mux(index, subindex):
            raise Failed(f"an abort that names 0x{index:04X}:{subindex:02X}", answer.hex(" ").upper())
        return code

    # --- upload

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Upload a value by expedited or segmented transfer, depending on the device's response."""
        what = f"read of 0x{index:04X}:{subindex:02X}"
        answer = self.served(b"\x40" + mux(index, subindex), what)
        if answer[0] & 0xE0 != 0x40 or answer[1:4] != mux(index, subindex):
            raise Failed(f"4x {mux(index, subindex).hex(' ')} … to {what}", answer.hex(" ").upper())
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)] if answer[0] & 1 else answer[4:8]
        size = int.from_bytes(answer[4:8], "little") if answer[0] & 1 else None
        data = self._read_segments(what)
        if size is not None and size != len(data):
            raise Failed(f"{counted(size, 'byte')} as announced, {what}", counted(len(data), "byte"))
        return data

    def _read_segments(self, what: str) -> bytes:
        data, toggle = b"", 0
        while len(data) < _MOST_BYTES:
            answer = self.served(bytes((0x60 | toggle,)), f"a segment, {what}")
            if answer[0] & 0xF0 != toggle:
                raise Failed(f"a segment with toggle bit {toggle >> 4}, {what}", answer.hex(" ").upper())
            data += answer[1 : 8 - (answer[0] >> 1 & 7)]
            if answer[0] & 1:
                return data
            toggle ^= 0x10
        raise Failed(f"the last segment within {_MOST_BYTES} bytes, {what}", "none")

    def integer(self, index: int, subindex: int = 0) -> int:
        """Upload an unsigned number."""
        return int.from_bytes(self.read(index, subindex), "little")

    def read_block(
        self, index: int, subindex: int = 0, *, crc: bool = False, size: int = _BLOCK_SIZE
    ) -> bytes:
        """Upload a value by block transfer, and check the sequence numbers, length and CRC.

        The length is checked if the device announces it; the CRC is checked if both sides support it.

        Args:
            index: Index.
            subindex: Sub-index.
            crc: Whether the client announces CRC support.
            size: Number of segments per sub-block.
        """
        what = f"block read of 0x{index:04X}:{subindex:02X}"
        start = bytes((0xA0 | crc << 2,)) + mux(index, subindex) + bytes((size, 0))
        answer = self.served(start, what)
        if answer[0] & 0xF9 != 0xC0 or answer[1:4] != mux(index, subindex):
            raise Failed(
                f"a response to {what} with C0, C2, C4 or C6 and the object", answer.hex(" ").upper()
            )
        announced = int.from_bytes(answer[4:8], "little") if answer[0] & 2 else None
        checked = crc and bool(answer[0] & 4)
        self.send(b"\xa3")
        data, last = b"", False
        while not last and len(data) < _MOST_BYTES:
            block, count, last = self._read_sub_block(size, what)
            data += block
            self.send(bytes((0xA2, count, size)))
        end = _not_aborted(self.answer(f"the end of a {what}"), f"the end of a {what}")
        if end[0] & 0xE3 != 0xC1:
            raise Failed(f"the end (C1 …) of a {what}", end.hex(" ").upper())
        data = data[: len(data) - (end[0] >> 2 & 7)]
        self.send(b"\xa1")
        if announced is not None and announced != len(data):
            raise Failed(f"{counted(announced, 'byte')} as announced, {what}", counted(len(data), "byte"))
        if checked and int.from_bytes(end[1:3], "little") != crc16(data):
            raise Failed(f"CRC {crc16(data):04X}, {what}", f"{int.from_bytes(end[1:3], 'little'):04X}")
        return data

    def _read_sub_block(self, size: int, what: str) -> tuple[bytes, int, bool]:
        """Return the data and segment count of a sub-block, and whether it is the last sub-block."""
        data = b""
        for number in range(1, size + 1):
            segment = _not_aborted(self.answer(f"segment {number}, {what}"), what)
            if segment[0] & 0x7F != number:
                raise Failed(f"sequence number {number}, {what}", segment.hex(" ").upper())
            data += segment[1:]
            if segment[0] & 0x80:
                return data, number, True
        return data, size, False

    # --- download

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download a value: one to four bytes by expedited transfer, otherwise by segmented transfer."""
        if len(data) > 4 or not data:
            self.write_segments(index, subindex, data)
            return
        what = f"write of {data.hex(' ').upper()} to 0x{index:04X}:{subindex:02X}"
        answer = self.served(expedited(index, subindex, data), what)
        _check(answer, b"\x60" + mux(index, subindex) + bytes(4), what)

    def write_integer(self, index: int, subindex: int, value: int, size: int) -> None:
        """Download an unsigned number of ``size`` bytes by expedited transfer."""
        self.write(index, subindex, value.to_bytes(size, "little"))

    def write_segments(self, index: int, subindex: int, data: bytes) -> None:
        """Download a value by segmented transfer, regardless of its length."""
        what = f"segmented write to 0x{index:04X}:{subindex:02X}"
        start = b"\x21" + mux(index, subindex) + struct.pack("<I", len(data))
        _check(self.served(start, what), b"\x60" + mux(index, subindex) + bytes(4), what)
        toggle = 0
        for at in range(0, max(len(data), 1), _SEGMENT):
            part = data[at : at + _SEGMENT]
            last = at + _SEGMENT >= len(data)
            head = toggle | (_SEGMENT - len(part)) << 1 | last
            answer = self.served(bytes((head,)) + part, f"a segment, {what}")
            _check(answer, bytes((0x20 | toggle,)) + bytes(7), what)
            toggle ^= 0x10

    def write_block(
        self, index: int, subindex: int, data: bytes, *, crc: bool = False, wrong_crc: bool = False
    ) -> None:
        """Download by block transfer a value that fits into one sub-block, optionally with a wrong CRC."""
        what = f"block write to 0x{index:04X}:{subindex:02X}"
        start = bytes((0xC2 | crc << 2,)) + mux(index, subindex) + struct.pack("<I", len(data))
        answer = self.served(start, what)
        if answer[0] & 0xFB != 0xA0 or answer[1:4] != mux(index, subindex) or not 1 <= answer[4] <= 127:
            raise Failed(
                f"a response to {what} with A0 or A4, the object and a block size", answer.hex(" ").upper()
            )
        parts = [data[at : at + _SEGMENT] for at in range(0, len(data), _SEGMENT)]
        if len(parts) > answer[4]:
            raise Failed(f"a block size of at least {len(parts)}, {what}", str(answer[4]))
        for number, part in enumerate(parts, 1):
            self.send(bytes((number | (0x80 if number == len(parts) else 0),)) + part)
        answer = _not_aborted(self.answer(f"the segments of a {what}"), what)
        if answer[:2] != bytes((0xA2, len(parts))):
            raise Failed(f"A2 {len(parts):02X} …, {what}", answer.hex(" ").upper())
        unused = _SEGMENT - len(parts[-1])
        check = (crc16(data) ^ (0x5555 if wrong_crc else 0)) if crc else 0
        end = bytes((0xC1 | unused << 2,)) + struct.pack("<H", check)
        answer = self.served(end, f"the end of a {what}")
        _check(answer, b"\xa1" + bytes(7), f"the end of a {what}")


def expedited(index: int, subindex: int, data: bytes) -> bytes:
    """Return the request for an expedited download of one to four bytes."""
    return bytes((0x23 | (4 - len(data)) << 2,)) + mux(index, subindex) + data.ljust(4, b"\0")


def _not_aborted(answer: bytes, what: str) -> bytes:
    if answer[0] == 0x80:
        raise Aborted(what, int.from_bytes(answer[4:8], "little"))
    return answer


def _check(answer: bytes, wanted: bytes, what: str) -> None:
    if answer != wanted:
        raise Failed(f"{wanted.hex(' ').upper()} to {what}", answer.hex(" ").upper())
