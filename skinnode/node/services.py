"""Resources shared by all CiA services of a node: object dictionary, EMCY, counters, sender and clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skinnode.node.clock import Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.rejected import RejectedFrames

Send = Callable[[int, bytes], None]
"""Callback that sends a frame, given its COB-ID and payload."""


@dataclass(frozen=True, slots=True)
class NodeServices:
    """Resources of a node that its services share."""

    store: ObjectStore
    """Object dictionary."""
    emcy: EmcyProducer
    """Emergency producer."""
    rejected: RejectedFrames
    """Counters of rejected frames (0x2040)."""
    send: Send
    """Sends a frame."""
    now: Clock
    """Time of the event being handled, ns."""
