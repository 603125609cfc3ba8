"""SDO server (CiA 301 v4.2, 7.2.4.3) for expedited and segmented transfers.

Block transfers are in :mod:`skinnode.node.sdo.block`. The SDO server of the ``canopen`` library is not a
substitute: it does not reject unknown commands and supports neither time-outs nor block transfers.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.sdo import ABORT, SEGMENT_BYTES
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import NO_DEADLINE_NS
from skinnode.node.sdo.block import BlockDownload, BlockUpload, Upload
from skinnode.node.sdo.transfer import MULTIPLEXER, MULTIPLEXER_U32, Channel, Incoming, Target, Transfer

TIMEOUT_NS: Final = 1_000_000_000
"""Maximum time (ns) to wait for a client's next request before the transfer is aborted. CiA 301 does not
specify this time-out."""

_TOGGLE: Final = 0x10


class _Client(IntEnum):
    """Client command specifier: the upper three bits of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    BLOCK_UPLOAD = 5
    BLOCK_DOWNLOAD = 6


_NAMELESS: Final = (0, 3, 5, 6)
"""Command specifiers of requests that continue a transfer and contain no index."""


class SdoServer:
    """SDO server with one channel, which performs one transfer at a time.

    An initiate request replaces an unfinished transfer, which the client has evidently abandoned. An
    exception from ``send`` propagates to the caller and does not end the transfer.

    Args:
        store: Object dictionary.
        send: Function that sends a response of eight bytes.
        timeout_ns: Maximum time to wait for a client's next request, in ns.
    """

    def __init__(
        self, store: ObjectStore, send: Callable[[bytes], None], timeout_ns: int = TIMEOUT_NS
    ) -> None:
        self._channel = Channel(store, send, timeout_ns)
        self._transfer: Transfer | None = None

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        return self._transfer.deadline_ns if self._transfer is not None else NO_DEADLINE_NS

    def reset(self) -> None:
        """End the current transfer without an abort."""
        self._transfer = None

    def on_timer(self, t_ns: int) -> None:
        """Send the block segments due at ``t_ns``, or abort the transfer if it has timed out."""
        transfer = self._transfer
        if transfer is not None and t_ns >= transfer.deadline_ns:
            try:
                transfer.on_timer(t_ns)
            except Refused as refused:
                self._abort(transfer.target, refused.code)

    def on_request(self, request: bytes, t_ns: int) -> None:
        """Handle a request.

        Args:
            request: Payload of eight bytes.
            t_ns: Arrival time, in ns.
        """
        transfer = self._transfer
        if request[0] == ABORT:
            self._transfer = None
        elif transfer is not None and transfer.wants(request):
            try:
                if transfer.on_request(request, t_ns):
                    self._transfer = None
            except Refused as refused:
                self._abort(transfer.target, refused.code)
        else:
            self._initiate(request, t_ns)

    def _initiate(self, request: bytes, t_ns: int) -> None:
        command, index, subindex = MULTIPLEXER.unpack_from(request)
        target = Target(index, subindex)
        old, self._transfer = self._transfer, None
        try:
            match command >> 5:
                case _Client.UPLOAD:
                    self._start_upload(target, self._read(target), t_ns)
                case _Client.DOWNLOAD:
                    self._download(request, target, t_ns)
                case _Client.BLOCK_UPLOAD if not command & 3:
                    self._block_upload(request, target, t_ns)
                case _Client.BLOCK_DOWNLOAD if not command & 1:
                    announced = int.from_bytes(request[4:8], "little") if command & 2 else None
                    self._transfer = BlockDownload(
                        self._channel, target, announced, t_ns, crc=bool(command & 4)
                    )
                case _:
                    if old is not None:
                        target = old.target
                    elif command >> 5 in _NAMELESS:
                        target = Target(0, 0)
                    raise Refused(AbortCode.UNKNOWN_COMMAND)
        except Refused as refused:
            self._abort(target, refused.code)

    def _abort(self, target: Target, code: AbortCode) -> None:
        self._transfer = None
        self._channel.send(MULTIPLEXER_U32.pack(ABORT, target.index, target.subindex, code))

    def _read(self, target: Target) -> bytes:
        return self._channel.store.read(target.index, target.subindex)

    def _start_upload(self, target: Target, data: bytes, t_ns: int) -> None:
        size = len(data)
        if 1 <= size <= 4:  # an empty value cannot be expedited
            head = MULTIPLEXER.pack(0x43 | (4 - size) << 2, target.index, target.subindex)
            self._channel.send(head + data.ljust(4, b"\0"))
        else:
            self._transfer = _Upload(self._channel, target, data, t_ns)

    def _block_upload(self, request: bytes, target: Target, t_ns: int) -> None:
        data = self._read(target)
        block_size, switch_threshold, crc = request[4], request[5], bool(request[0] & 4)
        # For values up to the protocol switch threshold, the client prefers a normal upload.
        if 0 < len(data) <= switch_threshold:
            self._start_upload(target, data, t_ns)
        else:
            self._transfer = BlockUpload(self._channel, target, Upload(data, block_size, crc), t_ns)

    def _download(self, request: bytes, target: Target, t_ns: int) -> None:
        command = request[0]
        expedited, size_given = command & 2, command & 1
        if not expedited:
            announced = int.from_bytes(request[4:8], "little") if size_given else None
            self._transfer = _Download(self._channel, target, announced, t_ns)
            return
        store = self._channel.store
        # If the request states no size, the object's size is used, up to four bytes.
        index, subindex = target.index, target.subindex
        size = 4 - (command >> 2 & 3) if size_given else min(store.lengths(index, subindex).most, 4)
        store.write(index, subindex, request[4 : 4 + size])
        self._channel.send(MULTIPLEXER_U32.pack(0x60, index, subindex, 0))


class _Upload(Transfer):
    """Segmented upload, with up to seven bytes per request."""

    def __init__(self, channel: Channel, target: Target, data: bytes, t_ns: int) -> None:
        super().__init__(channel, target, t_ns)
        self._data, self._at, self._toggle = data, 0, 0
        channel.send(MULTIPLEXER_U32.pack(0x41, target.index, target.subindex, len(data)))

    def wants(self, request: bytes) -> bool:
        """Return whether a request belongs to this transfer."""
        return request[0] >> 5 == _Client.UPLOAD_SEGMENT

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a request that belongs to this transfer. Return whether the transfer has ended."""
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
    """Segmented download, with up to seven bytes per request."""

    def __init__(self, channel: Channel, target: Target, announced: int | None, t_ns: int) -> None:
        super().__init__(channel, target, t_ns)
        self._incoming = Incoming(channel.store, target, announced)
        self._toggle = 0
        channel.send(MULTIPLEXER_U32.pack(0x60, target.index, target.subindex, 0))

    def wants(self, request: bytes) -> bool:
        """Return whether a request belongs to this transfer."""
        return request[0] >> 5 == _Client.DOWNLOAD_SEGMENT

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a request that belongs to this transfer. Return whether the transfer has ended."""
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
