"""Definitions of service data objects (SDO, CiA 301 v4.2, 7.2.4.3), shared by SDO clients and servers."""

from __future__ import annotations

import struct
from typing import Final

SEGMENT_BYTES: Final = 7
"""Maximum number of data bytes in a segment."""

MAX_BLOCK_SEGMENTS: Final = 127
"""Maximum number of segments in a block."""

ABORT: Final = 0x80
"""First byte of an abort, from a client or a server."""

UPLOAD: Final = 0x40
"""First byte of a request to read an object."""

_MULTIPLEXER: Final = struct.Struct("<BHB")


def upload_request(index: int, subindex: int) -> bytes:
    """Return the eight bytes of a request to read an object."""
    return _MULTIPLEXER.pack(UPLOAD, index, subindex).ljust(8, b"\0")
