"""Counters of rejected frames (0x2040), for which the standard defines no response."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.canopen import indices as od
from skinnode.node.object_dictionary import ObjectStore

_MOST: Final = 0xFFFF_FFFF


class Rejected(IntEnum):
    """Reason for rejecting a frame; the value is the sub-index of object 0x2040."""

    NMT = 1
    """NMT frame whose length is not two bytes, or which addresses this node with an unknown command."""
    SYNC = 2
    """SYNC message with a length other than that required by 0x1019."""
    TIME = 3
    """TIME message whose length is not six bytes, or whose time of day is invalid."""
    HEARTBEAT = 4
    """Heartbeat from a monitored node with a length other than one byte."""
    SDO = 5
    """SDO request with a length other than eight bytes."""
    RPDO = 6
    """RPDO that is shorter than the total length of its mapped objects."""
    OWN_ERROR_CONTROL = 7
    """Boot-up message or heartbeat that another node sends with this node's node-ID."""


class RejectedFrames:
    """Counters of rejected frames (0x2040), which saturate at their maximum and are cleared by *reset node*.

    Args:
        store: object dictionary.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._counts = dict.fromkeys(Rejected, 0)
        store.bind(od.REJECTED_FRAMES, lambda sub: self._counts[Rejected(sub)].to_bytes(4, "little"))

    def count(self, kind: Rejected) -> None:
        """Count one rejected frame."""
        self._counts[kind] = min(self._counts[kind] + 1, _MOST)

    def counted(self, kind: Rejected) -> int:
        """Return the number of frames rejected for a given reason."""
        return self._counts[kind]

    def reset(self) -> None:
        """Set all counters to 0, as after power-on."""
        self._counts = dict.fromkeys(Rejected, 0)
