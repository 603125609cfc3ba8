"""Received frame, in the same form for every interface."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """A received frame. ``t_ns`` is monotonic; ``data`` is empty for a remote frame."""

    can_id: int
    data: bytes
    t_ns: int
    remote: bool = False
    error: bool = False
    extended: bool = False
    fd: bool = False
