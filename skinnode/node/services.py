"""Resources shared by the communication services of a node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import Clock
from skinnode.node.rejected import RejectedFrames

Send = Callable[[int, bytes], None]
"""Callback that sends a frame, given its COB-ID and payload."""


@dataclass(frozen=True, slots=True)
class NodeServices:
    """Resources shared by all communication services of a node."""

    store: ObjectStore
    """Object dictionary."""
    emcy: EmcyProducer
    """EMCY producer."""
    rejected: RejectedFrames
    """Counters of rejected frames (0x2040)."""
    send: Send
    """Function that sends a frame."""
    now: Clock
    """Function that returns the time (ns) of the event being handled."""
