"""Counters of rejected frames (0x2040). The standards define no response to these frames."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.canopen import indices as od
from skinnode.node.object_dictionary import ObjectStore

_MOST: Final = 0xFFFF_FFFF


class Rejected(IntEnum):
    """Type of rejected frame. Each value is the sub-index of the corresponding counter in 0x2040."""

    NMT = 1
    """NMT frame that is not two bytes long or contains an unknown command for this node."""
    SYNC = 2
    """SYNC whose length does not match 0x1019."""
    TIME = 3
    """TIME message that is not six bytes long or contains an invalid time of day."""
    HEARTBEAT = 4
    """Heartbeat that comes from a monitored node and is not one byte long."""
    SDO = 5
    """SDO request that is not eight bytes long."""
    RPDO = 6
    """RPDO that is shorter than its mapped objects."""
    OWN_ERROR_CONTROL = 7
    """Boot-up message or heartbeat from another node with the same node-ID."""


class RejectedFrames:
    """Counters of rejected frames (0x2040). They stop at their maximum; *reset node* clears them.

    Args:
        store: Object dictionary.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._counts = dict.fromkeys(Rejected, 0)
        store.bind(od.REJECTED_FRAMES, lambda sub: self._counts[Rejected(sub)].to_bytes(4, "little"))

    def count(self, kind: Rejected) -> None:
        """Count a rejected frame."""
        self._counts[kind] = min(self._counts[kind] + 1, _MOST)

    def counted(self, kind: Rejected) -> int:
        """Return the number of rejected frames of one type."""
        return self._counts[kind]

    def reset(self) -> None:
        """Set all counters to 0, as after power-on."""
        self._counts = dict.fromkeys(Rejected, 0)
