"""Many messages of a socket in one system call: recvmmsg(2), which Python's socket module does not have.

The call is made with the interpreter's lock held. It does not wait, takes about a microsecond a message, and
letting go of the lock for each of 8,000 messages a second would cost every other thread more than that.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray


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
    """struct mmsghdr."""

    _fields_ = (("head", _Head), ("length", ctypes.c_uint))


_libc: Final = ctypes.PyDLL(None, use_errno=True)


class MessageBatch:
    """Room for ``count`` messages of up to ``size`` bytes with ``control`` bytes of ancillary data each."""

    def __init__(self, count: int, size: int, control: int) -> None:
        self.size, self.control = size, control
        self._payload, self._ancillary = (
            memoryview(bytearray(count * size)),
            memoryview(bytearray(count * control)),
        )
        self._vectors = (_Iovec * count)()
        self._messages = (_Message * count)()
        payload, ancillary, vectors = map(_address, (self._payload, self._ancillary, self._vectors))
        for i, (vector, message) in enumerate(zip(self._vectors, self._messages, strict=True)):
            vector.base, vector.length = payload + i * size, size
            message.head.vector, message.head.vector_length = vectors + i * ctypes.sizeof(_Iovec), 1
            message.head.control, message.head.control_length = ancillary + i * control, control
        self._fresh = bytes(self._messages)
        self._count = count
        self._memory = memoryview(self._messages).cast("B")
        self._lengths = self._every(_Message.length.offset, np.uintc)
        self._control_lengths = self._every(_Head.control_length.offset, np.uintp)

    def receive(self, sock: socket.socket, most: int) -> tuple[list[int], list[int]]:
        """Lengths of the messages that wait, at most ``most`` and ``count``, and of their ancillary data. It
        does not wait. Raises OSError; where messages came before the error, it is raised by the next call."""
        count = min(most, self._count)
        got = _libc.recvmmsg(sock.fileno(), self._messages, count, socket.MSG_DONTWAIT, None)
        if got < 0:
            error = ctypes.get_errno()
            if error in (errno.EAGAIN, errno.EWOULDBLOCK):
                return [], []
            raise OSError(error, os.strerror(error))
        lengths, control = self._lengths[:got].tolist(), self._control_lengths[:got].tolist()
        used = got * ctypes.sizeof(_Message)
        self._memory[:used] = self._fresh[:used]  # the kernel wrote there what it used of the room
        return lengths, control

    def taken(self, count: int) -> tuple[bytes, bytes]:
        """A copy of the first ``count`` messages, and of their ancillary data."""
        return bytes(self._payload[: count * self.size]), bytes(self._ancillary[: count * self.control])

    def _every(self, offset: int, kind: type[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
        """The number at ``offset`` of every message, as it is at any time."""
        numbers = np.frombuffer(self._memory, dtype=kind)
        return numbers[offset // numbers.itemsize :: ctypes.sizeof(_Message) // numbers.itemsize]


def _address(memory: Any) -> int:
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))
