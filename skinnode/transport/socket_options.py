"""Socket options that python-can does not set."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from typing import Final

RECEIVE_BUFFER_BYTES: Final = 1 << 22
"""Receive buffer size requested for a socket, bytes. A frame occupies about 800 bytes of it."""

SO_RXQ_OVFL: Final = 40
"""Option from <asm-generic/socket.h> that adds the kernel's drop counter to the ancillary data of a message.
Python does not define it."""

_SO_RCVBUFFORCE: Final = 33  # from <asm-generic/socket.h>


def enlarge_receive_buffer(sock: socket.socket) -> None:
    """Set the size of a socket's receive buffer to :data:`RECEIVE_BUFFER_BYTES`, or as large as permitted."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except OSError:  # only root may exceed net.core.rmem_max
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


@contextlib.contextmanager
def socket_of(fileno: int) -> Iterator[socket.socket]:
    """Give access to the socket of a file descriptor, which stays open after the ``with`` block."""
    duplicate = socket.socket(fileno=os.dup(fileno))
    try:
        yield duplicate
    finally:
        duplicate.close()
