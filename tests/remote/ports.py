"""Finds free ports on this machine."""

from __future__ import annotations

import random
import socket


def free_ports(count: int) -> int:
    """Return the first of ``count`` consecutive ports, below those that the kernel gives to clients."""
    while True:
        first = random.randrange(18000, 32000 - count)
        if all(_is_free(port) for port in range(first, first + count)):
            return first


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
