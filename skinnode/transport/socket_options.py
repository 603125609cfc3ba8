"""Socket options that python-can does not set."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from typing import Final

RECEIVE_BUFFER_BYTES: Final = 1 << 22
"""Receive buffer size requested for a socket, in bytes. A frame occupies about 800 bytes of the buffer."""

SO_RXQ_OVFL: Final = 40
"""Option from <asm-generic/socket.h> that adds the kernel's drop counter to a message's ancillary data.
Python does not define this constant."""

_SO_RCVBUFFORCE: Final = 33  # from <asm-generic/socket.h>


def enlarge_receive_buffer(sock: socket.socket) -> None:
    """Set a socket's receive buffer size to :data:`RECEIVE_BUFFER_BYTES`, or to the maximum permitted."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except OSError:  # only root may exceed net.core.rmem_max
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


@contextlib.contextmanager
def socket_of(fileno: int) -> Iterator[socket.socket]:
    """Yield a socket for a file descriptor; the descriptor stays open after the ``with`` block."""
    duplicate = socket.socket(fileno=os.dup(fileno))
    try:
        yield duplicate
    finally:
        duplicate.close()
