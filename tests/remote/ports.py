"""Finds free ports on this machine that no other test uses, in whichever process."""

from __future__ import annotations

import random
import socket
from typing import Final

_FIRST: Final = 18000
"""Above the ports of daemons outside tests; the last is below those that the kernel gives to clients."""
_ROOM: Final = 16
"""Ports per reservation."""
_ROOMS: Final = 850

_reserved: Final[list[socket.socket]] = []
"""Abstract Unix sockets, each of which reserves one room until this process ends."""


def free_ports(count: int) -> int:
    """Return the first of ``count`` consecutive ports, at most 16."""
    assert count <= _ROOM
    rng = random.SystemRandom()  # hypothesis seeds the other one alike in all workers
    while True:
        room = rng.randrange(_ROOMS)
        first = _FIRST + room * _ROOM
        if _reserve(room) and all(_is_free(port) for port in range(first, first + count)):
            return first


def _reserve(room: int) -> bool:
    mark = socket.socket(socket.AF_UNIX)
    try:
        mark.bind(f"\0skinnode-tests-ports-{room}")
    except OSError:
        mark.close()
        return False
    _reserved.append(mark)
    return True


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
