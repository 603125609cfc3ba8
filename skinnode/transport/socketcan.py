"""Receives frames in batches from a raw SocketCAN socket, with kernel timestamps and drop counter.

python-can opens the socket and sends frames. It is not used to receive frames, because it makes two system
calls per frame and ignores the drop counter. Structures and constants are from <linux/can.h>,
<linux/can/raw.h>, <asm-generic/socket.h> and <linux/net_tstamp.h>.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import subprocess
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from skinnode.errors import BusError
from skinnode.transport.frame import Frame
from skinnode.transport.hardware_time import OLDEST_NS, HardwareClock
from skinnode.transport.recvmmsg import MessageBatch
from skinnode.transport.socket_options import SO_RXQ_OVFL

if TYPE_CHECKING:
    from skinnode.config import BusConfig

_SO_TIMESTAMPNS: Final = 35
_SO_TIMESTAMPING: Final = 37
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6

HEADER: Final = struct.Struct("<IBB2x")  # identifier with flags, length, FD flags; then 8 or 64 data bytes
FD_MTU: Final = 72
"""Size of struct canfd_frame, in bytes. Struct can_frame is shorter."""
_STAMPS: Final = struct.Struct("@qqqqqq")  # three timestamps in s and ns: software, unused, hardware
_DROPS: Final = struct.Struct("@I")
_CONTROL: Final = struct.Struct("@Nii")  # struct cmsghdr: length including the header, level, type
_ALIGNED: Final = struct.calcsize("@N")
_ANCILLARY_BYTES: Final = socket.CMSG_SPACE(_STAMPS.size) + socket.CMSG_SPACE(_DROPS.size)
_STAMPED_BYTES: Final = socket.CMSG_SPACE(_STAMPS.size)  # length of ancillary data, timestamps only
_RECORD: Final = struct.Struct(f"@IB3x8s56x{_CONTROL.size}xqq16xq8x{_ANCILLARY_BYTES - _STAMPED_BYTES}x")
"""Usual layout of a received frame in memory: identifier, length, 8 data bytes, software and hardware
timestamps."""

_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29

_NEWEST_NS: Final = 100_000_000
"""Maximum time (ns) by which a frame's timestamp can plausibly be later than the time at which the frame is
read."""

_IP_S: Final = 5.0
"""Maximum duration (s) of an ``ip`` command."""

BATCH_FRAMES: Final = 256
"""Maximum number of frames per system call. A fully loaded 1 Mbit/s bus carries 256 frames in 30 ms."""


class SocketReader:
    """Receives batches of frames from a bound SocketCAN socket. Only one thread may use it.

    Arrival times are based on hardware timestamps if the driver provides them (:class:`HardwareClock`).
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        self.dropped = 0
        """Number of frames dropped because the receive buffer was full."""
        self._batch = MessageBatch(BATCH_FRAMES, FD_MTU, _ANCILLARY_BYTES)
        self.hardware_stamps = False
        """Whether the last frame had a hardware timestamp."""
        self._hardware = HardwareClock()
        sock.setsockopt(
            socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0
        )  # python-can enables these timestamps, but a socket supports only one kind
        sock.setsockopt(
            socket.SOL_SOCKET, _SO_TIMESTAMPING, _RX_SOFTWARE | _SOFTWARE | _RX_HARDWARE | _RAW_HARDWARE
        )
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)

    def fileno(self) -> int:
        """Return the file descriptor of the socket, or -1 if it is closed."""
        return self._sock.fileno()

    def read(self, timeout_s: float, most: int = BATCH_FRAMES) -> list[Frame]:
        """Return the frames that have arrived; if there are none, wait for the next frame.

        Args:
            timeout_s: Maximum time to wait for a frame, in s.
            most: Maximum number of frames, up to :data:`BATCH_FRAMES`.

        Raises:
            OSError: if the interface fails.
        """
        batch = self._batch
        if not batch.receive(self._sock, most) and (
            timeout_s <= 0.0
            or not self._poll.poll(round(timeout_s * 1e3))
            or not batch.receive(self._sock, most)
        ):
            return []
        now_ns = time.monotonic_ns()
        wall_to_mono_ns = now_ns - time.time_ns()
        earliest_ns, latest_ns = now_ns - OLDEST_NS, now_ns + _NEWEST_NS
        second = second_ns = 0
        frames: list[Frame] = []
        new = tuple.__new__  # takes half as long as Frame.__new__
        for (control, length), record in zip(batch.used(), _RECORD.iter_unpack(batch.taken()), strict=True):
            word, size, data, seconds, nanoseconds, hardware_s = record
            if control == _STAMPED_BYTES and not hardware_s:
                if seconds != second:
                    second, second_ns = seconds, seconds * 1_000_000_000 + wall_to_mono_ns
                t_ns = second_ns + nanoseconds
                if not earliest_ns < t_ns < latest_ns:
                    t_ns = now_ns
            else:
                t_ns = self._arrival(batch.control(len(frames), control), now_ns, wall_to_mono_ns)
            fd = length == FD_MTU
            if size != 8:
                data = batch.payload(len(frames), length)[HEADER.size : HEADER.size + size]
            if word <= 0x7FF:
                frames.append(new(Frame, (word, data, t_ns, False, False, False, fd)))
                continue
            remote, error, extended = word & _REMOTE != 0, word & _ERROR != 0, word & _EXTENDED != 0
            can_id = word & (0x1FFF_FFFF if extended or error else 0x7FF)
            frames.append(new(Frame, (can_id, b"" if remote else data, t_ns, remote, error, extended, fd)))
        return frames

    def _arrival(self, control: bytes, now_ns: int, wall_to_mono_ns: int) -> int:
        """Return the arrival time of a frame on the monotonic clock (ns) from its ancillary data."""
        t_ns, at = now_ns, 0
        while at < len(control):
            length, _, kind = _CONTROL.unpack_from(control, at)
            if kind == _SO_TIMESTAMPING:
                stamps = _STAMPS.unpack_from(control, at + _CONTROL.size)
                seconds, nanoseconds, _, _, hardware_s, hardware_ns = stamps
                if seconds:
                    t_ns = seconds * 1_000_000_000 + nanoseconds + wall_to_mono_ns
                    if not -_NEWEST_NS < now_ns - t_ns < OLDEST_NS:
                        t_ns = now_ns
                self.hardware_stamps = hardware_s != 0
                if hardware_s:
                    t_ns = self._hardware.arrival_ns(hardware_s * 1_000_000_000 + hardware_ns, t_ns)
            elif kind == SO_RXQ_OVFL:
                (self.dropped,) = _DROPS.unpack_from(control, at + _CONTROL.size)
            at += -(-length // _ALIGNED) * _ALIGNED
        return t_ns


@dataclass(frozen=True, slots=True)
class Link:
    """State of a CAN interface as reported by ``ip``; None for each unknown value."""

    up: bool | None = None
    state: str | None = None
    """State of the controller, such as ``ERROR-ACTIVE``."""
    bitrate_bps: int | None = None
    data_bitrate_bps: int | None = None


def read_link(channel: str) -> Link:
    """Return the state of the CAN interface ``channel``; this requires no privileges."""
    try:
        (link,) = json.loads(_ip("-details", "-json", "link", "show", "dev", channel))
        data = link.get("linkinfo", {}).get("info_data", {})
        rates = (data.get(key, {}).get("bitrate") for key in ("bittiming", "data_bittiming"))
        return Link("UP" in link["flags"], data.get("state"), *rates)
    except (OSError, subprocess.SubprocessError, ValueError, KeyError, AttributeError):
        return Link()


def set_link_bitrate(config: BusConfig) -> None:
    """Set the bit rates of a CAN interface with ``ip link``. The interface is down during the change.

    If the interface is up and has these bit rates, it remains unchanged, and no privileges are required.

    Raises:
        BusError: if ``ip link`` fails. The message contains its error output.
    """
    rates = ["bitrate", str(config.bitrate_bps)]
    if config.fd:
        rates += ["dbitrate", str(config.data_bitrate_bps), "fd", "on"]
    link = read_link(config.channel)
    same = link.bitrate_bps == config.bitrate_bps
    if link.up and same and (not config.fd or link.data_bitrate_bps == config.data_bitrate_bps):
        return
    try:
        _ip_link(config, "down")
        try:
            _ip_link(config, "type", "can", *rates)
        finally:
            _ip_link(config, "up")
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", "") or str(error)
        channel, hint = config.channel, ""
        if "not permitted" in said:
            up = f"ip link set {channel} up type can {' '.join(rates)}"
            hint = f"; as root, run: ip link set {channel} down && {up}"
        raise BusError(
            f"{config.name}: interface 'socketcan', channel {channel!r}: does not accept "
            f"{config.bitrate_bps} bit/s ({' '.join(said.split())}){hint}"
        ) from error


def _ip_link(config: BusConfig, *arguments: str) -> None:
    _ip("link", "set", config.channel, *arguments)


def _ip(*arguments: str) -> str:
    command = ["ip", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=_IP_S).stdout
