"""SDO block transfer, with one acknowledgement per block of segments (CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.15).

CAN may deliver a frame twice if the last bit of its end-of-frame field is disturbed (ISO 11898-1). If this
happens to an acknowledgement, the copy could be mistaken for the acknowledgement of the next block, because
frames contain no block number. Segments would then be skipped. A frame identical to the previous frame is
therefore ignored, unless the protocol allows two identical frames in succession.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.sdo import MAX_BLOCK_SEGMENTS, SEGMENT_BYTES
from skinnode.errors import BusError
from skinnode.node.sdo.transfer import MULTIPLEXER_U32, Channel, Incoming, Target, Transfer

SEGMENT_NS: Final = 500_000
"""Minimum mean interval between segments, in ns.

PDOs may cause a bus load of 70 %. A 1 Mbit/s bus then has a remaining capacity of at least 2200 frames/s.
Block transfers use 2000 frames/s, so the transmit queue does not fill up.

A block of 127 segments takes 64 ms, or 100 ms if the thread wakes up late. Clients wait longer for a frame
than one block takes; the canopen library, for example, waits 300 ms. Each time a segment cannot be sent, for
example at a lower bit rate, the interval is doubled for the rest of the transfer.
"""
SLOWEST_SEGMENT_NS: Final = 8 * SEGMENT_NS
"""Maximum mean interval between segments, in ns. At this interval, the segments use only a quarter of the
capacity of a 125 kbit/s bus."""
SEGMENTS_AT_ONCE: Final = 4
"""Maximum number of segments sent per timer event.

Several segments are sent if the thread has woken up late, by default by up to 2 ms. Two timer events in
succession must not overflow the transmit queue, which holds 10 frames on Linux.
"""
TWICE_NS: Final = 3_000_000
"""Maximum interval (ns) between the two receptions of a duplicated frame: the duration of two maximum-length
frames and an error frame at 125 kbit/s.

An acknowledgement that is not a duplicate differs from the previous one, because the client has received more
segments.
"""

_LAST: Final = 0x80
_SEQUENCE: Final = 0x7F
_END: Final = struct.Struct("<BH5x")
_FIVE_ZEROS: Final = bytes(5)


class _Client(IntEnum):
    """Client sub-commands in a block upload (the lowest two bits of a request)."""

    END = 1
    ACKNOWLEDGE = 2
    START = 3


class _Upload(Enum):
    """Event that a block upload is waiting for."""

    START = auto()
    TIME = auto()
    """The next segment becomes due."""
    ACKNOWLEDGEMENT = auto()
    END = auto()


@dataclass(frozen=True, slots=True)
class Upload:
    """Value to send in a block upload, and the options requested by the client."""

    data: bytes
    """Value to be sent."""
    block_size: int
    """Number of segments per block, which the client can change with each acknowledgement."""
    crc: bool
    """Whether the client supports a CRC."""


class BlockUpload(Transfer):
    """Block upload. The constructor sends the response to the initiate request.

    Args:
        channel: SDO server channel.
        target: object to read or write.
        upload: value of the object, and the options requested by the client.
        t_ns: time at which the initiate request was received, ns.

    Raises:
        Refused: if the block size is not from 1 to 127.
    """

    def __init__(self, channel: Channel, target: Target, upload: Upload, t_ns: int) -> None:
        super().__init__(channel, target, t_ns)
        data, crc = upload.data, upload.crc
        self._data, self._crc = data, crc
        self._segments = max(1, -(-len(data) // SEGMENT_BYTES))  # even an empty value needs one segment
        self._block_size = _checked(upload.block_size)
        self._first = 0  # number of acknowledged segments before the current block
        self._pace_ns = SEGMENT_NS
        self._sent = 0  # number of segments of the current block sent so far
        self._waits_for = _Upload.START
        self._previous, self._previous_ns = b"", t_ns
        # The server offers a CRC only if the client supports one: some clients expect a CRC whenever the
        # server offers it, even if they did not request one.
        channel.send(MULTIPLEXER_U32.pack(0xC2 | crc << 2, target.index, target.subindex, len(data)))

    def wants(self, request: bytes) -> bool:
        """Return whether a request from the client belongs to this transfer."""
        return request[0] >> 5 == 5 and request[0] & 3 != 0

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Process a request that belongs to this transfer; return whether the transfer has ended."""
        twice = request == self._previous and t_ns - self._previous_ns < TWICE_NS
        if twice and self._waits_for is not _Upload.ACKNOWLEDGEMENT:
            return False
        self._previous, self._previous_ns = request, t_ns
        match request[0] & 3, self._waits_for:
            case _Client.START, _Upload.START:
                self._start_block(t_ns)
            case _Client.ACKNOWLEDGE, _Upload.TIME | _Upload.ACKNOWLEDGEMENT:
                self._acknowledge(request[1], request[2], t_ns)
            case _Client.END, _Upload.END:
                return True
            case _:
                raise Refused(AbortCode.UNKNOWN_COMMAND)
        return False

    def on_timer(self, t_ns: int) -> None:
        """Send the segments due at ``t_ns``, or abort if the client has not responded in time."""
        if self._waits_for is not _Upload.TIME:
            super().on_timer(t_ns)
        due_ns = max(self.deadline_ns, t_ns - (SEGMENTS_AT_ONCE - 1) * self._pace_ns)
        while due_ns <= t_ns and self._waits_for is _Upload.TIME:
            due_ns += self._pace_ns
            self.deadline_ns = due_ns
            self._send_segment()
        if self._waits_for is _Upload.ACKNOWLEDGEMENT:
            self._await_client(t_ns)

    def _start_block(self, t_ns: int) -> None:
        self._sent = 0
        self._waits_for, self.deadline_ns = _Upload.TIME, t_ns
        self.on_timer(t_ns)

    def _send_segment(self) -> None:
        number = self._first + self._sent + 1
        segment = self._data[(number - 1) * SEGMENT_BYTES : number * SEGMENT_BYTES]
        last = number == self._segments
        head = self._sent + 1 | (_LAST if last else 0)
        try:
            self._channel.send(bytes((head,)) + segment.ljust(SEGMENT_BYTES, b"\0"))
        except BusError:  # the segment was not sent and will be retried at the longer interval
            self._pace_ns = min(2 * self._pace_ns, SLOWEST_SEGMENT_NS)
            raise
        self._sent += 1
        if last or self._sent == self._block_size:
            self._waits_for = _Upload.ACKNOWLEDGEMENT

    def _acknowledge(self, received: int, block_size: int, t_ns: int) -> None:
        """Continue after segment number ``received`` of this block, the last that the client received."""
        if received > self._sent:
            raise Refused(AbortCode.INVALID_SEQUENCE)
        self._block_size = _checked(block_size)
        self._first += received
        if self._first < self._segments:
            self._start_block(t_ns)
            return
        unused = self._segments * SEGMENT_BYTES - len(self._data)
        crc = binascii.crc_hqx(self._data, 0) if self._crc else 0
        self._waits_for = _Upload.END
        self._await_client(t_ns)
        self._channel.send(_END.pack(0xC1 | unused << 2, crc))


class BlockDownload(Transfer):
    """Block download. The constructor sends the response to the initiate request.

    At the end of each block, the server acknowledges the last segment received without a gap. If the last
    segment of a block is lost, the transfer times out.

    Args:
        channel: SDO server channel.
        target: object to read or write.
        announced: size announced by the client, bytes; None if the client announced no size.
        t_ns: time at which the initiate request was received, ns.
        crc: whether the client supports a CRC.

    Raises:
        Refused: if the object is not writable or does not accept a value of the announced size.
    """

    def __init__(
        self, channel: Channel, target: Target, announced: int | None, t_ns: int, *, crc: bool
    ) -> None:
        super().__init__(channel, target, t_ns)
        self._incoming = Incoming(channel.store, target, announced)
        self._crc = crc
        self._received = 0  # number of segments of the current block received without a gap
        # last segment of the transfer; the end request states how many of its bytes are data
        self._last: bytes | None = None
        self._previous = b""  # the last acknowledged request; a copy of this request is ignored
        channel.send(MULTIPLEXER_U32.pack(0xA0 | crc << 2, target.index, target.subindex, MAX_BLOCK_SEGMENTS))

    def wants(self, request: bytes) -> bool:
        """Return whether a frame belongs to this transfer; within a block, every frame is a segment."""
        return self._last is None or _is_end(request) or request == self._previous

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Process a request that belongs to this transfer; return whether the transfer has ended."""
        # End requests must be checked before duplicates, because an end request may equal the previous frame.
        if self._last is not None and _is_end(request):
            self._end(request, self._last)
            return True
        if request == self._previous:
            return False
        self._previous = b""
        number, last = request[0] & _SEQUENCE, request[0] & _LAST
        if number == 0:
            raise Refused(AbortCode.INVALID_SEQUENCE)
        if number == self._received + 1:
            self._received = number
            self._await_client(t_ns)
            if last:
                self._last = request[1:]
            else:
                self._incoming.extend(request[1:])
        if last or number == MAX_BLOCK_SEGMENTS:
            acknowledged, self._received = self._received, 0
            self._previous = request
            self._await_client(t_ns)
            self._channel.send(bytes((0xA2, acknowledged, MAX_BLOCK_SEGMENTS)) + _FIVE_ZEROS)
        return False

    def _end(self, request: bytes, last: bytes) -> None:
        command, crc = _END.unpack(request)
        self._incoming.extend(last[: SEGMENT_BYTES - (command >> 2 & 7)])
        if self._crc and crc != binascii.crc_hqx(self._incoming.data, 0):
            raise Refused(AbortCode.CRC)
        self._incoming.store()
        self._channel.send(b"\xa1".ljust(8, b"\0"))


def _is_end(request: bytes) -> bool:
    return request[0] & 0xE3 == 0xC1


def _checked(block_size: int) -> int:
    if not 1 <= block_size <= MAX_BLOCK_SEGMENTS:
        raise Refused(AbortCode.INVALID_BLOCK_SIZE)
    return block_size
