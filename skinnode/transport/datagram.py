"""UDP bus for load tests. Each UDP packet contains one frame in SocketCAN's memory layout.

The packets are received by the reader for SocketCAN frames, so load tests cover its system calls, timestamps
and drop counter. UDP over the loopback device stands in for the kernel's CAN driver and CAN protocol layer.
"""

from __future__ import annotations

import random
import socket
from contextlib import suppress
from typing import Any, Final

import can

from skinnode.errors import BusError
from skinnode.transport.port import CanPort
from skinnode.transport.socket_options import enlarge_receive_buffer
from skinnode.transport.socketcan import HEADER, SocketReader

LOOPBACK: Final = "127.0.0.1"
_CHANNELS: Final = range(20_000, 32_768)
"""Ports below those that Linux and other systems assign automatically."""
_MTU: Final = {False: 8, True: 64}  # data bytes in struct can_frame and struct canfd_frame from <linux/can.h>


def datagram(can_id: int, data: bytes, *, fd: bool = False) -> bytes:
    """Return the UDP packet for a CAN frame with an 11-bit identifier.

    Args:
        can_id: Identifier, 0 to 0x7FF.
        data: Payload of up to 8 bytes, or up to 64 bytes if ``fd``.
        fd: Whether the frame is a CAN FD frame.
    """
    return HEADER.pack(can_id, len(data), 0) + data.ljust(_MTU[fd], b"\0")


def free_channel() -> str:
    """Return the number of a free UDP port on this machine.

    The system does not assign this port to other programs' sockets before the bus is opened.
    """
    rng = random.SystemRandom()
    while True:
        port = rng.choice(_CHANNELS)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, suppress(OSError):
            sock.bind((LOOPBACK, port))
            return str(port)


class DatagramPort(CanPort):
    """Receive-only port on a UDP bus. The ``channel`` of a UDP bus is a UDP port number."""

    def _open(self) -> can.BusABC:
        try:
            return _DatagramBus(self.config.channel)
        except (OSError, ValueError, OverflowError) as error:
            raise BusError(f"{self._where}: cannot be opened ({error}), allowed: a free UDP port") from error

    def _open_reader(self) -> SocketReader | None:
        bus: Any = self._bus
        return SocketReader(bus.socket)


class _DatagramBus(can.BusABC):
    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((LOOPBACK, int(channel)))
            enlarge_receive_buffer(self.socket)
        except BaseException:
            self.socket.close()
            raise

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("a datagram bus only receives")

    def shutdown(self) -> None:
        super().shutdown()
        self.socket.close()
