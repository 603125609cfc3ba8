"""Converts CAN frames to ``can_msgs/Frame`` or ``ros2_socketcan_msgs/FdFrame``, and back.

All messages of a bus have the same ``frame_id``, so they differ only in numbers at fixed positions. rosbags
encodes one message of each length; :class:`FrameEncoder` copies that message and replaces the numbers, which
is ten times faster.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from skinnode.messages.definitions import CAN_FRAME, FD_FRAME
from skinnode.messages.typestore import decode, encode, header, message_type, seconds_and_ns
from skinnode.transport.frame import Frame

_TIME = struct.Struct("<iI")
_CLASSIC = struct.Struct("<I???B")
_FD = struct.Struct("<I??B")
_AFTER_TIME = 12
"""Offset, in bytes, of ``frame_id`` in a message that begins with a header. It is preceded by four
encapsulation bytes and eight time bytes.
"""
_CLASSIC_BYTES = 8


def frame_message(frame: Frame, frame_id: str) -> tuple[str, Any]:
    """Return the name and the content of the message for a CAN frame.

    Args:
        frame: The frame; ``t_ns`` is a Unix time.
        frame_id: Value of ``frame_id`` in the header: the name of the bus.
    """
    data = np.frombuffer(frame.data, np.uint8)
    head = header(frame.t_ns, frame_id)
    if frame.fd:
        make = message_type(FD_FRAME)
        return FD_FRAME, make(head, frame.can_id, frame.extended, frame.error, len(data), data)
    padded = np.zeros(_CLASSIC_BYTES, np.uint8)
    padded[: len(data)] = data
    flags = (frame.remote, frame.extended, frame.error)
    return CAN_FRAME, message_type(CAN_FRAME)(head, frame.can_id, *flags, len(data), padded)


class FrameEncoder:
    """Encodes the frames of one bus as CDR; the bytes are identical to those from rosbags.

    Args:
        frame_id: Value of ``frame_id`` in the header: the name of the bus.
    """

    def __init__(self, frame_id: str) -> None:
        self._frame_id = frame_id
        self._templates: dict[tuple[bool, int], bytes] = {}
        self._numbers = -(-(_AFTER_TIME + 4 + len(frame_id.encode()) + 1) // 4) * 4
        """Offset of the CAN identifier, in bytes. ``frame_id``, with its length and final NUL, precedes it;
        the offset is a multiple of 4.
        """

    def encode(self, frame: Frame) -> bytes:
        """Return the encoded frame; the frame's ``t_ns`` is a Unix time."""
        data = frame.data
        template = self._templates.get((frame.fd, len(data)))
        if template is None:
            name, message = frame_message(frame, self._frame_id)
            template = self._templates[frame.fd, len(data)] = encode(message, name)
        encoded, at = bytearray(template), self._numbers
        _TIME.pack_into(encoded, 4, *seconds_and_ns(frame.t_ns))
        if frame.fd:
            _FD.pack_into(encoded, at, frame.can_id, frame.extended, frame.error, len(data))
            encoded[len(encoded) - len(data) :] = data
        else:
            flags = (frame.remote, frame.extended, frame.error)
            _CLASSIC.pack_into(encoded, at, frame.can_id, *flags, len(data))
            encoded[at + _CLASSIC.size : at + _CLASSIC.size + len(data)] = data
        return bytes(encoded)


def frame_of(data: bytes, name: str) -> Frame:
    """Return the CAN frame from an encoded message; the frame's ``t_ns`` is a Unix time.

    Args:
        data: CDR-encoded message.
        name: Name of the message.

    Raises:
        ValueError: The data do not contain a CAN frame.
    """
    message = decode(data, name)
    stamp, payload = message.header.stamp, message.data.tobytes()
    t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
    error, extended = bool(message.is_error), bool(message.is_extended)
    if name == FD_FRAME:
        return Frame(message.id, payload, t_ns, False, error, extended, True)
    if message.dlc > _CLASSIC_BYTES:
        raise ValueError(f"{name}: dlc: got {message.dlc}, must be at most {_CLASSIC_BYTES}")
    return Frame(message.id, payload[: message.dlc], t_ns, bool(message.is_rtr), error, extended, False)
