"""Received CAN frame, in the same form for every type of interface."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """A received CAN frame.

    ``t_ns`` is the arrival time on the monotonic clock. ``data`` is empty in a remote frame.
    """

    can_id: int
    data: bytes
    t_ns: int
    remote: bool = False
    error: bool = False
    extended: bool = False
    fd: bool = False
