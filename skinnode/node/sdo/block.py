"""SDO block transfer (CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.15): up to 127 segments, then one acknowledgement.

CAN delivers a frame twice when the very last bit of its end is disturbed (ISO 11898-1), and nothing in a
frame says which block it belongs to: an acknowledgement taken for one of the next block would leave segments
out. A frame that equals the one before is therefore ignored, where the protocol knows no reason for another.
"""

from __future__ import annotations

import binascii
import struct
from enum import Enum, IntEnum, auto
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.sdo import MAX_BLOCK_SEGMENTS, SEGMENT_BYTES
from skinnode.errors import BusError
from skinnode.node.sdo.transfer import MULTIPLEXER_U32, Channel, Incoming, Transfer

SEGMENT_NS: Final = 500_000
"""Shortest mean time between two segments. PDOs may take 70 % of a bus; of 1 Mbit/s that leaves at least 2200
frames/s, of which this takes 2000, so that the queue that the PDOs are in, too, does not fill. A block takes
64 ms, 100 ms where the thread wakes late, and clients wait 300 ms (canopen library) and longer for a single
frame. Doubled for the rest of a transfer whenever the bus takes no more, as slower ones do."""
SLOWEST_SEGMENT_NS: Final = 8 * SEGMENT_NS
"""A quarter of 125 kbit/s: what keeps the bus from taking more than that has nothing to do with the pace."""
SEGMENTS_AT_ONCE: Final = 4
"""Most segments sent in one turn, to make up for a thread that wakes late (2 ms by default). The queue of a
Linux CAN interface is 10 frames long, and a thread that was held up may take two turns one upon the other."""
TWICE_NS: Final = 3_000_000
"""Two of the longest frames at 125 kbit/s and the error frame between: how far apart one frame that is
delivered twice can be. A client that means its second acknowledgement has seen more segments since."""

_LAST: Final = 0x80
_SEQUENCE: Final = 0x7F
_END: Final = struct.Struct("<BH5x")
_FIVE_ZEROS: Final = bytes(5)


class _Client(IntEnum):
    """Sub-commands of a client in a block upload: the lowest two bits."""

    END = 1
    ACKNOWLEDGE = 2
    START = 3


class _Upload(Enum):
    """What a block upload waits for."""

    START = auto()
    TIME = auto()
    """To send the next segment."""
    ACKNOWLEDGEMENT = auto()
    END = auto()


class BlockUpload(Transfer):
    """``data`` on its way to the client, ``block_size`` segments at a time until the client asks for another
    number. Sends the answer to the initiate request itself."""

    def __init__(
        self,
        channel: Channel,
        index: int,
        subindex: int,
        data: bytes,
        block_size: int,
        t_ns: int,
        *,
        crc: bool,
    ) -> None:
        super().__init__(channel, index, subindex, t_ns)
        self._data, self._crc = data, crc
        self._segments = max(1, -(-len(data) // SEGMENT_BYTES))  # nothing at all takes a segment too
        self._block_size = _checked(block_size)
        self._first = 0  # segments before the present block
        self._sent = 0  # segments of the present block
        self._pace_ns = SEGMENT_NS
        self._waits_for = _Upload.START
        self._previous, self._previous_ns = b"", t_ns
        # A CRC is agreed on where both sides offer it. Clients are known that expect one, not asked for,
        # from a server that says it could.
        channel.send(MULTIPLEXER_U32.pack(0xC2 | crc << 2, index, subindex, len(data)))

    def wants(self, request: bytes) -> bool:
        return request[0] >> 5 == 5 and request[0] & 3 != 0

    def on_request(self, request: bytes, t_ns: int) -> bool:
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
        except BusError:  # the segment has not gone and is sent again
            self._pace_ns = min(2 * self._pace_ns, SLOWEST_SEGMENT_NS)
            raise
        self._sent += 1
        if last or self._sent == self._block_size:
            self._waits_for = _Upload.ACKNOWLEDGEMENT

    def _acknowledge(self, received: int, block_size: int, t_ns: int) -> None:
        """The client has segments up to number ``received`` of the block; the others are sent again."""
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
    """A value on its way from the client. Sends the answer to the initiate request itself.

    Blocks are acknowledged at their end, with the number of the last segment before a gap; a client that does
    not get to the end of a block runs into the time-out.
    """

    def __init__(
        self, channel: Channel, index: int, subindex: int, announced: int | None, t_ns: int, *, crc: bool
    ) -> None:
        super().__init__(channel, index, subindex, t_ns)
        self._incoming = Incoming(channel.store, index, subindex, announced)
        self._crc = crc
        self._received = 0  # segments of the present block without a gap
        self._last: bytes | None = None  # the last segment of all, not known yet how much of it is data
        self._previous = b""  # the last request, if it was acknowledged
        channel.send(MULTIPLEXER_U32.pack(0xA0 | crc << 2, index, subindex, MAX_BLOCK_SEGMENTS))

    def wants(self, request: bytes) -> bool:
        """Whatever comes while blocks do is a segment."""
        return self._last is None or _is_end(request) or request == self._previous

    def on_request(self, request: bytes, t_ns: int) -> bool:
        if self._last is not None and _is_end(request):  # the last segment may look the same
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
