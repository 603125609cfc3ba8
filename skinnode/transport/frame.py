"""Received CAN frame, in the same format for all types of interfaces."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """Received CAN frame.

    ``t_ns`` is the arrival time on the monotonic clock, in ns. ``data`` is empty for a remote frame.
    """

    can_id: int
    data: bytes
    t_ns: int
    remote: bool = False
    error: bool = False
    extended: bool = False
    fd: bool = False
