"""Receives many socket messages with one call to recvmmsg(2), which Python's socket module lacks.

The call does not block and takes about 1 µs per message, so it keeps the global interpreter lock (GIL).
Releasing the GIL for each message would delay other threads for longer.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from collections.abc import Iterator
from typing import Any, Final


class _Iovec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Head(ctypes.Structure):
    """struct msghdr of <sys/socket.h>."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint),
        ("vector", ctypes.c_void_p),
        ("vector_length", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """struct mmsghdr of <sys/socket.h>."""

    _fields_ = (("head", _Head), ("length", ctypes.c_uint))


_USED: Final = struct.Struct(
    f"@{_Head.control_length.offset}xN"
    f"{_Message.length.offset - _Head.control_length.offset - _Head.control_length.size}xI"
    f"{ctypes.sizeof(_Message) - _Message.length.offset - _Message.length.size}x"
)
_libc: Final = ctypes.PyDLL(None, use_errno=True)


class MessageBatch:
    """Buffers for received messages. Only one thread may use them.

    Args:
        count: Maximum number of messages.
        size: Maximum length of a message, in bytes.
        control: Maximum length of the ancillary data of a message, in bytes.
    """

    def __init__(self, count: int, size: int, control: int) -> None:
        self._count, self._size, self._record = count, size, size + control
        self._room = memoryview(bytearray(count * self._record))
        self._vectors = (_Iovec * count)()
        self._messages = (_Message * count)()
        room, vectors = _address(self._room), ctypes.addressof(self._vectors)
        for i, (vector, message) in enumerate(zip(self._vectors, self._messages, strict=True)):
            vector.base, vector.length = room + i * self._record, size
            message.head.vector, message.head.vector_length = vectors + i * ctypes.sizeof(_Iovec), 1
            message.head.control, message.head.control_length = room + i * self._record + size, control
        self._fresh = bytes(self._messages)
        self._memory = memoryview(self._messages).cast("B")
        self._got = 0

    def receive(self, sock: socket.socket, most: int) -> int:
        """Replace the messages in the buffers with up to ``most`` new messages, without waiting.

        Returns:
            Number of messages received.

        Raises:
            OSError: if receiving fails. If some messages were received before the error, it is not raised
                until the next call.
        """
        used = self._got * _USED.size
        # Restore the buffer lengths, which the kernel has overwritten with the lengths of the messages.
        self._memory[:used] = self._fresh[:used]
        self._got = 0
        got = _libc.recvmmsg(sock.fileno(), self._messages, min(most, self._count), socket.MSG_DONTWAIT, None)
        if got < 0:
            error = ctypes.get_errno()
            if error in (errno.EAGAIN, errno.EWOULDBLOCK):
                return 0
            raise OSError(error, os.strerror(error))
        self._got = got
        return self._got

    def used(self) -> Iterator[tuple[int, int]]:
        """Yield the length of each message's ancillary data and the length of its data, in bytes."""
        return _USED.iter_unpack(self._memory[: self._got * _USED.size])

    def taken(self) -> memoryview:
        """Return a view of the memory that contains the received messages.

        Each message occupies a record of fixed length: its data, padded to ``size`` bytes, and its ancillary
        data, padded to ``control`` bytes.
        """
        return self._room[: self._got * self._record]

    def payload(self, number: int, length: int) -> bytes:
        """Return a copy of the first ``length`` bytes of a message."""
        at = number * self._record
        return bytes(self._room[at : at + length])

    def control(self, number: int, length: int) -> bytes:
        """Return a copy of the first ``length`` bytes of a message's ancillary data."""
        at = number * self._record + self._size
        return bytes(self._room[at : at + length])


def _address(memory: Any) -> int:
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))
