"""Exchanges frames in UDP multicast packets, compatible with python-can's udp_multicast interface.

python-can opens and configures the socket, and defines the packet format: a msgpack map with one entry per
attribute of ``can.Message``. Converting every frame to ``can.Message`` and msgpack would take longer than
sending it. However, packets of the same kind differ only in their timestamps and data, so python-can converts
each kind only once:

- When a frame is sent, its data is inserted into a packet that python-can has packed for this identifier and
  length.
- A received packet is compared, ignoring its timestamp and data, with the packets that python-can has already
  unpacked. If the packet differs from all of these or has a different layout, python-can unpacks it.

Like python-can's interface, this interface has no arbitration and does not guarantee delivery or order: it is
meant for testing programs, not for testing a bus under load.

Packets are received in batches, with kernel timestamps and the kernel's drop counter. An endpoint also
receives its own packets. It identifies them by a tag in the channel field and skips them. python-can
transmits this field but does not use it.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import time
import uuid
from typing import Final, NamedTuple

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from skinnode.process import clock
from skinnode.transport.frame import Frame
from skinnode.transport.hardware_time import OLDEST_NS
from skinnode.transport.recvmmsg import MessageBatch
from skinnode.transport.sendto import PacketSender
from skinnode.transport.socket_options import SO_RXQ_OVFL

# From <linux/in.h> and <linux/in6.h>; Python does not define these constants.
_IP_MULTICAST_ALL: Final = 49
_IPV6_MULTICAST_ALL: Final = 29

_DELIVERY_S: Final = 0.05
"""Maximum time (s) for the kernel to deliver a frame. The longest time observed was 28 ms."""

_BATCH_PACKETS: Final = 256
_PACKET_BYTES: Final = 4096
"""Maximum packet length in bytes, as in python-can. Longer packets are truncated."""

_STAMP: Final = struct.Struct("@qq")  # struct timespec: s and ns
_DROPS: Final = struct.Struct("@I")
_CONTROL: Final = struct.Struct("@Nii")  # struct cmsghdr: length including the header, level, type
_STAMPED_BYTES: Final = socket.CMSG_SPACE(_STAMP.size)
_COUNTED_BYTES: Final = _STAMPED_BYTES + socket.CMSG_SPACE(_DROPS.size)
_HEAD: Final = b"\x8b\xa9timestamp\xcb"  # a map with 11 entries, the first of which is a 64-bit float
_HEAD_BYTES: Final = len(_HEAD) + 8
"""Length of a packet up to the end of the timestamp, in bytes."""
_DATA: Final = b"\xa4data\xc4"  # data key and byte-string type; followed by the length (u8)


def new_tag() -> str:
    """Return a unique tag for the channel field of an endpoint's packets."""
    return f"skinnode-{uuid.uuid4().hex}"


_TAG_BYTES: Final = len(new_tag())
_TAG_AT: Final = pack_message(
    can.Message(arbitration_id=0x7FF, is_extended_id=False, channel=new_tag())
).index(b"skinnode-")
"""Offset of the tag in this program's packets with identifiers of 0x100 or higher, in bytes."""
_TAG_END: Final = _TAG_AT + _TAG_BYTES

_RECORD: Final = struct.Struct(
    f"@{_TAG_AT}x{_TAG_BYTES}s{_PACKET_BYTES - _TAG_END}x{_CONTROL.size}xqq{_CONTROL.size}xI4x"
)
"""Memory layout of a received message: packet with tag, timestamp, drop counter. Once the kernel has dropped
a packet, it adds the drop counter after the timestamp."""

_MOST_KINDS: Final = 4096
"""Maximum number of packet kinds to remember. Sixteen patches send 100 kinds."""

_NEWEST_NS: Final = 100_000_000
"""Maximum time, in ns, by which a frame's timestamp can plausibly be later than the time at which the frame
is read."""


class _Kind(NamedTuple):
    """Frame without its data and arrival time."""

    can_id: int
    remote: bool
    error: bool
    extended: bool
    fd: bool


class MulticastSocket:
    """Endpoint in a multicast group. Any thread may send, but only one thread may receive.

    Args:
        bus: Open python-can bus. The endpoint duplicates the bus's socket and shuts down the bus.
        group: Address of the multicast group.
        tag: Result of :func:`new_tag`.
    """

    def __init__(self, bus: can.BusABC, group: str, tag: str) -> None:
        self._sock = socket.socket(fileno=os.dup(bus.fileno()))
        bus.shutdown()
        self._sender = PacketSender(self._sock, group, self._sock.getsockname()[1])
        self._tag = tag
        self._packed: dict[tuple[int, int, bool, bool], tuple[bytes, bytes]] = {}
        self._kinds: dict[bytes, _Kind | None] = {}
        self._batch = MessageBatch(_BATCH_PACKETS, _PACKET_BYTES, _COUNTED_BYTES)
        self._waiting: list[Frame] = []
        self.dropped = 0
        """Number of packets, including the endpoint's own, dropped because the receive buffer was full."""
        self.malformed = 0
        """Number of received packets that were not CAN frames."""
        self._sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)

    def fileno(self) -> int:
        """Return the socket's file descriptor, or -1 if the socket is closed."""
        return self._sock.fileno()

    def shutdown(self) -> None:
        """Close the socket."""
        self._sock.close()

    # --- sending

    def send_frame(self, can_id: int, data: bytes, *, remote: bool, fd: bool) -> None:
        """Send a frame with an 11-bit identifier. CAN FD frames use bit rate switching.

        Raises:
            OSError: if the network rejects the packet or the socket is closed.
        """
        if remote:
            data = b""
        kind = can_id, len(data), remote, fd
        packed = self._packed.get(kind)
        if packed is None:
            packed = self._packed[kind] = self._pack(can_id, len(data), remote, fd)
        self._sender.send(packed[0] + data + packed[1])

    def _pack(self, can_id: int, n_bytes: int, remote: bool, fd: bool) -> tuple[bytes, bytes]:
        """Return the parts of a packet before and after the data."""
        message = can.Message(
            arbitration_id=can_id,
            is_extended_id=False,
            is_remote_frame=remote,
            is_fd=fd,
            bitrate_switch=fd,
            channel=self._tag,
            data=bytes(n_bytes),
        )
        packet = pack_message(message)
        at = packet.index(_DATA) + len(_DATA) + 1
        return packet[:at], packet[at + n_bytes :]

    # --- receiving

    def read_frames(self, timeout_s: float, most: int) -> list[Frame]:
        """Return the frames that have arrived; if there are none, wait for the next frame.

        Args:
            timeout_s: Maximum time to wait for a frame, in s.
            most: Maximum number of frames.

        Raises:
            OSError: if receiving fails.
            ValueError: if the socket is closed.
        """
        if not self._waiting and not self._fetch() and timeout_s > 0.0:
            self._wait(timeout_s)
        frames = self._waiting
        if len(frames) <= most:
            self._waiting = []
            return frames
        self._waiting = frames[most:]
        return frames[:most]

    def _wait(self, timeout_s: float) -> None:
        """Wait for frames and fetch them. Unwanted packets do not end the wait."""
        end_s = time.monotonic() + timeout_s
        while timeout_s > 0.0:
            # Unlike poll(2), select(2) does not round the timeout to ms.
            if select.select((self._sock,), (), (), timeout_s)[0] and self._fetch():
                return
            timeout_s = end_s - time.monotonic()

    def _fetch(self) -> bool:
        """Fetch packets until a frame is found or no packets remain. Return whether there are frames."""
        while count := self._batch.receive(self._sock, _BATCH_PACKETS):
            self._waiting = self._unpack_batch()
            if self._waiting:
                return True
            if count < _BATCH_PACKETS:
                break
        return False

    def _unpack_batch(self) -> list[Frame]:
        """Return the batch's frames from other endpoints."""
        batch, unpack, own = self._batch, self._unpack, self._tag.encode()
        now_ns = time.monotonic_ns()
        wall_to_mono_ns = now_ns - time.time_ns()
        earliest_ns, latest_ns = now_ns - OLDEST_NS, now_ns + _NEWEST_NS
        frames: list[Frame] = []
        new = tuple.__new__  # twice as fast as Frame.__new__
        records = zip(batch.used(), _RECORD.iter_unpack(batch.taken()), strict=True)
        for number, ((control, length), (tag, seconds, nanoseconds, drops)) in enumerate(records):
            if control == _COUNTED_BYTES:
                self.dropped = drops
            if tag == own and length >= _TAG_END:  # three times faster than unpack()
                continue
            kind, data = unpack(batch.payload(number, length))
            if kind is None:
                continue
            t_ns = seconds * 1_000_000_000 + nanoseconds + wall_to_mono_ns
            if control < _STAMPED_BYTES or not earliest_ns < t_ns < latest_ns:
                t_ns = now_ns
            can_id, remote, error, extended, fd = kind
            frames.append(new(Frame, (can_id, data, t_ns, remote, error, extended, fd)))
        return frames

    def _unpack(self, packet: bytes) -> tuple[_Kind | None, bytes]:
        """Return a packet's kind and data. The kind of an unwanted packet is None."""
        at = packet.find(_DATA, _HEAD_BYTES) + len(_DATA) + 1
        end = at + packet[at - 1] if at <= len(packet) else at
        data = packet[at:end]
        key = packet[_HEAD_BYTES:at] + packet[end:]
        kinds = self._kinds
        if key in kinds and packet.startswith(_HEAD):
            return kinds[key], data
        try:
            message = unpack_message(packet, replace={"timestamp": 0.0}, check=True)
        except Exception:  # msgpack and can.Message raise various exceptions for other packets
            self.malformed += 1
            return None, b""
        kind = self._kind(message)
        if packet.startswith(_HEAD) and data == message.data:
            if len(kinds) >= _MOST_KINDS:
                kinds.clear()
            kinds[key] = kind
        return kind, bytes(message.data)

    def _kind(self, message: can.Message) -> _Kind | None:
        if message.channel == self._tag:
            return None
        return _Kind(
            message.arbitration_id,
            message.is_remote_frame,
            message.is_error_frame,
            message.is_extended_id,
            message.is_fd,
        )


def limit_to_group(sock: socket.socket) -> None:
    """Limit a multicast socket to the groups it has joined, and discard the packets received so far.

    python-can binds the socket to all addresses. Such a socket receives the packets of every multicast group
    that any program on this machine has joined, unless the socket option IP_MULTICAST_ALL or
    IPV6_MULTICAST_ALL is 0.
    """
    if sock.family == socket.AF_INET:
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    else:
        sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
    _discard_other_groups(sock)


def _discard_other_groups(sock: socket.socket) -> None:
    """Discard packets received before reception was limited to one multicast group.

    If there were any, discard packets again after a pause, because the kernel may still be delivering
    packets.
    """
    if _discard_waiting(sock):
        clock.sleep(_DELIVERY_S)
        _discard_waiting(sock)


def _discard_waiting(sock: socket.socket) -> int:
    """Discard all packets in a socket's receive buffer, and return their number."""
    count = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            sock.recv(1, socket.MSG_DONTWAIT)
            count += 1
    return count
