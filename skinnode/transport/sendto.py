"""Sends UDP packets without releasing the global interpreter lock (GIL).

``socket.sendto`` releases the GIL for each packet. If several threads have packets to send, as simulated-node
threads do after each SYNC, the GIL passes to another thread with every packet. Switching threads takes longer
than sending the packet.
"""

from __future__ import annotations

import ctypes
import socket
import struct
from typing import Final

_sendto: Final = ctypes.PyDLL(None).sendto
_sendto.argtypes = (
    ctypes.c_int,
    ctypes.c_char_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_char_p,
    ctypes.c_uint,
)

_SOCKADDR_IN: Final = struct.Struct("=H2s4s8x")  # struct sockaddr_in of <netinet/in.h>: family, port, address
_SOCKADDR_IN6: Final = struct.Struct("=H2s4x16s4x")  # flow label and scope are 0


class PacketSender:
    """Sends packets from a socket to one address. Any thread may send.

    Args:
        sock: IPv4 or IPv6 socket; remains owned by the caller.
        host: Numeric address of the receiver.
        port: UDP port of the receiver.
    """

    def __init__(self, sock: socket.socket, host: str, port: int) -> None:
        self._sock, self._to = sock, (host, port)
        layout = _SOCKADDR_IN if sock.family == socket.AF_INET else _SOCKADDR_IN6
        address = socket.inet_pton(sock.family, host)
        self._address = layout.pack(sock.family, port.to_bytes(2, "big"), address)

    def send(self, packet: bytes) -> None:
        """Send a packet. If the send buffer is full, wait until there is room.

        Raises:
            OSError: if the network rejects the packet or the socket is closed.
        """
        address = self._address
        sent = _sendto(self._sock.fileno(), packet, len(packet), socket.MSG_DONTWAIT, address, len(address))
        if sent < 0:  # the next call waits for room or raises the error
            self._sock.sendto(packet, self._to)
