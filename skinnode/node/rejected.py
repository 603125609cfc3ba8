"""Counters of frames that no standard answers: ignored, and yet somebody on the bus sends them."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skinnode.canopen import indices as od
from skinnode.node.object_dictionary import ObjectStore

_MOST: Final = 0xFFFF_FFFF


class Rejected(IntEnum):
    """What was wrong; the value is the sub-index of object 0x2040."""

    NMT = 1
    """Not two bytes, or an unknown command for this node."""
    SYNC = 2
    """Longer or shorter than 0x1019 says."""
    TIME = 3
    """Not six bytes, or no time of a day."""
    HEARTBEAT = 4
    """Of a monitored node, not one byte."""
    SDO = 5
    """A request that is not eight bytes."""
    RPDO = 6
    """Shorter than what is mapped."""
    OWN_ERROR_CONTROL = 7
    """A boot-up or heartbeat with this node's own node-ID: there is another one."""


class RejectedFrames:
    """Object 0x2040. Counts from power-on or reset node on, and stays at its maximum."""

    def __init__(self, store: ObjectStore) -> None:
        self._counts = dict.fromkeys(Rejected, 0)
        store.bind(od.REJECTED_FRAMES, lambda sub: self._counts[Rejected(sub)].to_bytes(4, "little"))

    def count(self, kind: Rejected) -> None:
        """One more."""
        self._counts[kind] = min(self._counts[kind] + 1, _MOST)

    def counted(self, kind: Rejected) -> int:
        """How many so far."""
        return self._counts[kind]

    def reset(self) -> None:
        """As after power-on."""
        self._counts = dict.fromkeys(Rejected, 0)
