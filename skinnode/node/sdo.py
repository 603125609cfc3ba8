"""SDO server, expedited and segmented (CiA 301 v4.2, 7.2.4). Block transfer is answered with an abort.

Bytes in, bytes out: no bus, no clock. The canopen library's server does not abort an unknown first command
and knows no time-out, therefore this one.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from skinnode.node.abort import AbortCode, Refused
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.od import MAX_BYTES, ObjectStore

TIMEOUT_NS: Final = 1_000_000_000
"""A client that does not go on for this long has its transfer aborted. CiA 301 leaves the time to the
device."""

_MULTIPLEXER: Final = struct.Struct("<BHB")
_ABORT: Final = struct.Struct("<BHBI")
_SEGMENT_BYTES: Final = 7
_TOGGLE: Final = 0x10


class _Client(IntEnum):
    """Client command specifiers: the top three bits of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4


@dataclass(slots=True)
class _Transfer:
    index: int
    subindex: int
    deadline_ns: int
    toggle: int = 0


@dataclass(slots=True)
class _Upload(_Transfer):
    rest: bytes = b""


@dataclass(slots=True)
class _Download(_Transfer):
    size: int | None = None
    """As announced by the client."""
    limit: int = MAX_BYTES
    received: bytearray = field(default_factory=bytearray)


class SdoServer:
    """One channel to the object dictionary. One transfer at a time; a new initiate ends an unfinished one."""

    def __init__(self, store: ObjectStore, timeout_ns: int = TIMEOUT_NS) -> None:
        self._store = store
        self._timeout_ns = timeout_ns
        self._transfer: _Transfer | None = None

    @property
    def deadline_ns(self) -> int:
        """When :meth:`on_timer` has an abort to send, if the client stays silent."""
        return self._transfer.deadline_ns if self._transfer is not None else NO_DEADLINE_NS

    def reset(self) -> None:
        """Forget a transfer in progress."""
        self._transfer = None

    def on_timer(self, t_ns: int) -> bytes | None:
        """The abort of a transfer whose client went silent."""
        transfer = self._transfer
        if transfer is None or t_ns < transfer.deadline_ns:
            return None
        return self._abort(transfer.index, transfer.subindex, AbortCode.TIMED_OUT)

    def on_request(self, request: bytes, t_ns: int) -> bytes | None:
        """The answer to a frame of a client; None to an abort and to what is no SDO, which always has 8
        bytes."""
        if len(request) != 8:
            return None
        command = request[0] >> 5
        transfer = self._transfer
        if command in (_Client.DOWNLOAD_SEGMENT, _Client.UPLOAD_SEGMENT):
            index, subindex = (transfer.index, transfer.subindex) if transfer is not None else (0, 0)
        else:
            _, index, subindex = _MULTIPLEXER.unpack_from(request)
        try:
            match command:
                case _Client.UPLOAD:
                    return self._start_upload(index, subindex, t_ns)
                case _Client.UPLOAD_SEGMENT if isinstance(transfer, _Upload):
                    return self._upload_segment(transfer, request, t_ns)
                case _Client.DOWNLOAD:
                    return self._start_download(index, subindex, request, t_ns)
                case _Client.DOWNLOAD_SEGMENT if isinstance(transfer, _Download):
                    return self._download_segment(transfer, request, t_ns)
                case _Client.ABORT:
                    self._transfer = None
                    return None
                case _:
                    raise Refused(AbortCode.UNKNOWN_COMMAND)
        except Refused as refused:
            return self._abort(index, subindex, refused.code)

    def _abort(self, index: int, subindex: int, code: AbortCode) -> bytes:
        self._transfer = None
        return _ABORT.pack(0x80, index, subindex, code)

    def _start_upload(self, index: int, subindex: int, t_ns: int) -> bytes:
        self._transfer = None
        data = self._store.read(index, subindex)
        size = len(data)
        if 1 <= size <= 4:  # an empty value cannot be told apart from four bytes when expedited
            return _MULTIPLEXER.pack(0x43 | (4 - size) << 2, index, subindex) + data.ljust(4, b"\0")
        self._transfer = _Upload(index, subindex, t_ns + self._timeout_ns, rest=data)
        return _ABORT.pack(0x41, index, subindex, size)

    def _upload_segment(self, transfer: _Upload, request: bytes, t_ns: int) -> bytes:
        _check_toggle(transfer, request)
        segment, transfer.rest = transfer.rest[:_SEGMENT_BYTES], transfer.rest[_SEGMENT_BYTES:]
        command = transfer.toggle | (_SEGMENT_BYTES - len(segment)) << 1
        transfer.toggle ^= _TOGGLE
        transfer.deadline_ns = t_ns + self._timeout_ns
        if not transfer.rest:
            command |= 1
            self._transfer = None
        return bytes((command,)) + segment.ljust(_SEGMENT_BYTES, b"\0")

    def _start_download(self, index: int, subindex: int, request: bytes, t_ns: int) -> bytes:
        self._transfer = None
        command = request[0]
        fixed = self._store.writable(index, subindex).data_type.bits // 8
        expedited, size_given = command & 2, command & 1
        if expedited:
            # Without a size the object's own decides; an object without one takes all four bytes.
            size = 4 - (command >> 2 & 3) if size_given else min(fixed or 4, 4)
            self._store.write(index, subindex, request[4 : 4 + size])
        else:
            announced = int.from_bytes(request[4:8], "little") if size_given else None
            limit = fixed or MAX_BYTES
            if announced is not None and announced > limit:
                raise Refused(AbortCode.TOO_LONG)
            if announced is not None and announced < fixed:
                raise Refused(AbortCode.TOO_SHORT)
            self._transfer = _Download(index, subindex, t_ns + self._timeout_ns, size=announced, limit=limit)
        return _ABORT.pack(0x60, index, subindex, 0)

    def _download_segment(self, transfer: _Download, request: bytes, t_ns: int) -> bytes:
        _check_toggle(transfer, request)
        command = request[0]
        transfer.received += request[1 : 8 - (command >> 1 & 7)]
        if len(transfer.received) > (transfer.limit if transfer.size is None else transfer.size):
            raise Refused(AbortCode.TOO_LONG)
        answer = bytes((0x20 | transfer.toggle,)) + bytes(7)
        transfer.toggle ^= _TOGGLE
        transfer.deadline_ns = t_ns + self._timeout_ns
        if command & 1:
            if transfer.size is not None and len(transfer.received) < transfer.size:
                raise Refused(AbortCode.TOO_SHORT)
            self._store.write(transfer.index, transfer.subindex, bytes(transfer.received))
            self._transfer = None
        return answer


def _check_toggle(transfer: _Transfer, request: bytes) -> None:
    if request[0] & _TOGGLE != transfer.toggle:
        raise Refused(AbortCode.TOGGLE_BIT)
