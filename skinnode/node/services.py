"""Resources shared by the communication services of a node."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import Clock
from skinnode.node.rejected import RejectedFrames

Send = Callable[[int, bytes], None]
"""Callback that sends a frame, given its COB-ID and payload."""

SendAll = Callable[[int, Iterator[bytes]], None]
"""Callback that sends several frames, given their COB-ID and payloads.

It takes the next payload only after the bus has accepted the previous one.
"""


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
    send_all: SendAll
    """Function that sends several frames with the same COB-ID."""
    now: Clock
    """Function that returns the time (ns) of the event being handled."""
