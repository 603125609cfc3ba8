"""SDO server (CiA 301 v4.2, 7.2.4.3): which request starts what, expedited and segmented transfer. Block
transfer is in :mod:`skinnode.node.sdo.block`.

No bus, no clock. The canopen library's server does not abort an unknown first command, knows no time-out and
no block transfer, therefore this one.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.sdo import ABORT, SEGMENT_BYTES
from skinnode.node.clock import NO_DEADLINE_NS
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.sdo.block import BlockDownload, BlockUpload
from skinnode.node.sdo.transfer import MULTIPLEXER, MULTIPLEXER_U32, Channel, Incoming, Transfer

TIMEOUT_NS: Final = 1_000_000_000
"""A client that does not go on for this long has its transfer aborted. CiA 301 leaves the time to the
device."""

_TOGGLE: Final = 0x10


class _Client(IntEnum):
    """Client command specifiers: the top three bits of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    BLOCK_UPLOAD = 5
    BLOCK_DOWNLOAD = 6


_NAMELESS: Final = (0, 3, 5, 6)
"""Command specifiers of requests that go on with something and name no object."""


class SdoServer:
    """One channel to the object dictionary. One transfer at a time; a new initiate ends an unfinished one,
    whose client has given up.

    ``send`` takes the eight bytes of an answer. An error that it raises goes to the caller, and the next call
    goes on from there.
    """

    def __init__(
        self, store: ObjectStore, send: Callable[[bytes], None], timeout_ns: int = TIMEOUT_NS
    ) -> None:
        self._channel = Channel(store, send, timeout_ns)
        self._transfer: Transfer | None = None

    @property
    def deadline_ns(self) -> int:
        """When :meth:`on_timer` has something to send: segments of a block, or the abort of a silent
        client."""
        return self._transfer.deadline_ns if self._transfer is not None else NO_DEADLINE_NS

    def reset(self) -> None:
        """Forget a transfer in progress."""
        self._transfer = None

    def on_timer(self, t_ns: int) -> None:
        """Go on with a block, or abort the transfer of a client that went silent."""
        transfer = self._transfer
        if transfer is not None and t_ns >= transfer.deadline_ns:
            try:
                transfer.on_timer(t_ns)
            except Refused as refused:
                self._abort(transfer.index, transfer.subindex, refused.code)

    def on_request(self, request: bytes, t_ns: int) -> None:
        """Take a frame of the client, eight bytes. Nothing is said to an abort."""
        transfer = self._transfer
        if request[0] == ABORT:
            self._transfer = None
        elif transfer is not None and transfer.wants(request):
            try:
                if transfer.on_request(request, t_ns):
                    self._transfer = None
            except Refused as refused:
                self._abort(transfer.index, transfer.subindex, refused.code)
        else:
            self._initiate(request, t_ns)

    def _initiate(self, request: bytes, t_ns: int) -> None:
        command, index, subindex = MULTIPLEXER.unpack_from(request)
        old, self._transfer = self._transfer, None
        try:
            match command >> 5:
                case _Client.UPLOAD:
                    self._upload(index, subindex, t_ns)
                case _Client.DOWNLOAD:
                    self._download(request, index, subindex, t_ns)
                case _Client.BLOCK_UPLOAD if not command & 3:
                    self._block_upload(request, index, subindex, t_ns)
                case _Client.BLOCK_DOWNLOAD if not command & 1:
                    announced = int.from_bytes(request[4:8], "little") if command & 2 else None
                    crc = bool(command & 4)
                    self._transfer = BlockDownload(self._channel, index, subindex, announced, t_ns, crc=crc)
                case _:
                    if old is not None:
                        index, subindex = old.index, old.subindex
                    elif command >> 5 in _NAMELESS:
                        index, subindex = 0, 0
                    raise Refused(AbortCode.UNKNOWN_COMMAND)
        except Refused as refused:
            self._abort(index, subindex, refused.code)

    def _abort(self, index: int, subindex: int, code: AbortCode) -> None:
        self._transfer = None
        self._channel.send(MULTIPLEXER_U32.pack(ABORT, index, subindex, code))

    def _upload(self, index: int, subindex: int, t_ns: int) -> None:
        self._start_upload(index, subindex, self._channel.store.read(index, subindex), t_ns)

    def _start_upload(self, index: int, subindex: int, data: bytes, t_ns: int) -> None:
        size = len(data)
        if 1 <= size <= 4:  # an empty value cannot be told apart from four bytes when expedited
            head = MULTIPLEXER.pack(0x43 | (4 - size) << 2, index, subindex)
            self._channel.send(head + data.ljust(4, b"\0"))
        else:
            self._transfer = _Upload(self._channel, index, subindex, data, t_ns)

    def _block_upload(self, request: bytes, index: int, subindex: int, t_ns: int) -> None:
        data = self._channel.store.read(index, subindex)
        block_size, switch_threshold, crc = request[4], request[5], bool(request[0] & 4)
        if 0 < len(data) <= switch_threshold:  # the client would rather have so little in the plain way
            self._start_upload(index, subindex, data, t_ns)
        else:
            self._transfer = BlockUpload(self._channel, index, subindex, data, block_size, t_ns, crc=crc)

    def _download(self, request: bytes, index: int, subindex: int, t_ns: int) -> None:
        command = request[0]
        expedited, size_given = command & 2, command & 1
        if not expedited:
            announced = int.from_bytes(request[4:8], "little") if size_given else None
            self._transfer = _Download(self._channel, index, subindex, announced, t_ns)
            return
        store = self._channel.store
        # Without a size the object's own decides; an object that may be longer takes all four bytes.
        size = 4 - (command >> 2 & 3) if size_given else min(store.lengths(index, subindex).most, 4)
        store.write(index, subindex, request[4 : 4 + size])
        self._channel.send(MULTIPLEXER_U32.pack(0x60, index, subindex, 0))


class _Upload(Transfer):
    """A value on its way to the client, seven bytes a request."""

    def __init__(self, channel: Channel, index: int, subindex: int, data: bytes, t_ns: int) -> None:
        super().__init__(channel, index, subindex, t_ns)
        self._data, self._at, self._toggle = data, 0, 0
        channel.send(MULTIPLEXER_U32.pack(0x41, index, subindex, len(data)))

    def wants(self, request: bytes) -> bool:
        return request[0] >> 5 == _Client.UPLOAD_SEGMENT

    def on_request(self, request: bytes, t_ns: int) -> bool:
        if request[0] & _TOGGLE != self._toggle:
            raise Refused(AbortCode.TOGGLE_BIT)
        segment = self._data[self._at : self._at + SEGMENT_BYTES]
        self._at += SEGMENT_BYTES
        over = self._at >= len(self._data)
        command = self._toggle | (SEGMENT_BYTES - len(segment)) << 1 | over
        self._toggle ^= _TOGGLE
        self._await_client(t_ns)
        self._channel.send(bytes((command,)) + segment.ljust(SEGMENT_BYTES, b"\0"))
        return over


class _Download(Transfer):
    """A value on its way from the client, seven bytes a request."""

    def __init__(self, channel: Channel, index: int, subindex: int, announced: int | None, t_ns: int) -> None:
        super().__init__(channel, index, subindex, t_ns)
        self._incoming = Incoming(channel.store, index, subindex, announced)
        self._toggle = 0
        channel.send(MULTIPLEXER_U32.pack(0x60, index, subindex, 0))

    def wants(self, request: bytes) -> bool:
        return request[0] >> 5 == _Client.DOWNLOAD_SEGMENT

    def on_request(self, request: bytes, t_ns: int) -> bool:
        command = request[0]
        if command & _TOGGLE != self._toggle:
            raise Refused(AbortCode.TOGGLE_BIT)
        self._incoming.extend(request[1 : 8 - (command >> 1 & 7)])
        over = bool(command & 1)
        if over:
            self._incoming.store()
        answer = bytes((0x20 | self._toggle,)) + bytes(7)
        self._toggle ^= _TOGGLE
        self._await_client(t_ns)
        self._channel.send(answer)
        return over
