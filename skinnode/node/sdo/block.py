"""SDO block transfers (CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.15), with one acknowledgement per block.

CAN delivers a frame twice if the last bit of its end-of-frame field is disturbed (ISO 11898-1).
Acknowledgements contain no block number, so a duplicate would be mistaken for the acknowledgement of the next
block, and segments would be skipped. A frame identical to the previous frame is therefore ignored, unless the
protocol allows two identical frames in succession.
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
"""Initial mean interval between segments, in ns.

The resulting rate of 2000 frames/s is below the 2200 frames/s available on a 1 Mbit/s bus with 70 % PDO load,
so the transmit queue does not fill up. A block of 127 segments takes 64 ms, which is well within client
time-outs (the canopen library waits 300 ms). Whenever a segment cannot be sent, for example at a lower bit
rate, the interval is doubled for the rest of the transfer.
"""
SLOWEST_SEGMENT_NS: Final = 8 * SEGMENT_NS
"""Maximum mean interval between segments, in ns. At this interval, segments use a quarter of the capacity of
a 125 kbit/s bus."""
SEGMENTS_AT_ONCE: Final = 4
"""Maximum number of segments sent at once after the thread has woken up late.

Two bursts in quick succession must fit in the transmit queue, which holds 10 frames on Linux.
"""
TWICE_NS: Final = 3_000_000
"""Maximum time in ns between a frame and its duplicate: the duration of two maximum-length frames and an
error frame at 125 kbit/s.
"""

_LAST: Final = 0x80
_SEQUENCE: Final = 0x7F
_END: Final = struct.Struct("<BH5x")
_FIVE_ZEROS: Final = bytes(5)


class _Client(IntEnum):
    """Client subcommand of a block upload: the lower two bits of a request."""

    END = 1
    ACKNOWLEDGE = 2
    START = 3


class _Upload(Enum):
    """Event that a block upload is waiting for."""

    START = auto()
    TIME = auto()
    """Time at which the next segment is due."""
    ACKNOWLEDGEMENT = auto()
    END = auto()


@dataclass(frozen=True, slots=True)
class Upload:
    """Value and options of a block upload."""

    data: bytes
    """Value of the object."""
    block_size: int
    """Number of segments in the first block. Each acknowledgement contains the number for the next block."""
    crc: bool
    """Whether the client supports a CRC."""


class BlockUpload(Transfer):
    """Block upload. The constructor sends the response to the initiate request.

    Args:
        channel: SDO server channel.
        target: Object to read.
        upload: Value and options.
        t_ns: Arrival time of the initiate request, in ns.

    Raises:
        Refused: If the block size is not in the range 1 to 127.
    """

    def __init__(self, channel: Channel, target: Target, upload: Upload, t_ns: int) -> None:
        super().__init__(channel, target, t_ns)
        data, crc = upload.data, upload.crc
        self._data, self._crc = data, crc
        self._segments = max(1, -(-len(data) // SEGMENT_BYTES))  # even an empty value needs one segment
        self._block_size = _checked(upload.block_size)
        self._first = 0  # number of segments before the current block
        self._pace_ns = SEGMENT_NS
        self._sent = 0  # number of segments sent in the current block
        self._waits_for = _Upload.START
        self._previous, self._previous_ns = b"", t_ns
        # Offer a CRC only if the client supports it: if the server offers a CRC, some clients expect it even
        # if they have not requested it.
        channel.send(MULTIPLEXER_U32.pack(0xC2 | crc << 2, target.index, target.subindex, len(data)))

    def wants(self, request: bytes) -> bool:
        """Return whether a request belongs to this transfer."""
        return request[0] >> 5 == 5 and request[0] & 3 != 0

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a request that belongs to this transfer. Return whether the transfer has ended."""
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
        """Send the segments due at ``t_ns``, or abort the transfer if it has timed out."""
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
        except BusError:  # this segment will be sent again
            self._pace_ns = min(2 * self._pace_ns, SLOWEST_SEGMENT_NS)
            raise
        self._sent += 1
        if last or self._sent == self._block_size:
            self._waits_for = _Upload.ACKNOWLEDGEMENT

    def _acknowledge(self, received: int, block_size: int, t_ns: int) -> None:
        """Continue after the first ``received`` segments of the block, which the client has acknowledged."""
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

    At the end of a block, the server acknowledges the segments before the first lost segment. If the last
    segment of a block is lost, the transfer times out.

    Args:
        channel: SDO server channel.
        target: Object to write.
        announced: Size in bytes announced by the client, or None.
        t_ns: Arrival time of the initiate request, in ns.
        crc: Whether the client supports a CRC.

    Raises:
        Refused: If the object is not writable or rejects the announced size.
    """

    def __init__(
        self, channel: Channel, target: Target, announced: int | None, t_ns: int, *, crc: bool
    ) -> None:
        super().__init__(channel, target, t_ns)
        self._incoming = Incoming(channel.store, target, announced)
        self._crc = crc
        self._received = 0  # number of segments before the first lost segment in the current block
        # last segment of the transfer; the end request states how many of its bytes are data
        self._last: bytes | None = None
        self._previous = b""  # last segment of the acknowledged block, used to recognise a duplicate
        channel.send(MULTIPLEXER_U32.pack(0xA0 | crc << 2, target.index, target.subindex, MAX_BLOCK_SEGMENTS))

    def wants(self, request: bytes) -> bool:
        """Return whether a request belongs to this transfer. Within a block, every request does."""
        return self._last is None or _is_end(request) or request == self._previous

    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a request that belongs to this transfer. Return whether the transfer has ended."""
        # Check for the end first, because an end request may be identical to the last segment.
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
