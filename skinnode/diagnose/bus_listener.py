"""Records the traffic received on a bus: heartbeats, emergency messages, SDO responses and frame counts.

The receiving thread writes the record without a lock. Other threads must copy a container before they
iterate over it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import STATE_MASK, NmtState
from skinnode.transport import Frame

_KEPT: Final = 256
"""Maximum number of messages kept per kind and node; enough for one minute of heartbeats at 4 Hz."""


class Beat(NamedTuple):
    """A boot-up message, a heartbeat or a node-guarding response (CiA 301, 7.2.8.3)."""

    t_ns: int
    state: int
    """NMT state without the node-guarding toggle bit; 0 for a boot-up message."""


class Emergency(NamedTuple):
    """An EMCY message (CiA 301, 7.2.7)."""

    t_ns: int
    code: int
    register: int
    detail: bytes


@dataclass(slots=True)
class NodeTraffic:
    """Messages received from one node-ID."""

    beats: deque[Beat] = field(default_factory=lambda: deque(maxlen=_KEPT))
    boot_ups: int = 0
    emergencies: deque[Emergency] = field(default_factory=lambda: deque(maxlen=_KEPT))
    sdo_answers: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """Reception time (ns) and eight data bytes of each SDO response."""
    newest_sdo: tuple[int, bytes] | None = None
    """Reception time (ns) and data of the newest frame, of any length, with the SDO response COB-ID."""


class BusListener:
    """Record of the messages received since construction; the bus link calls :meth:`on_frames`."""

    def __init__(self) -> None:
        self._nodes: dict[int, NodeTraffic] = {}
        self.cob_ids: Counter[int] = Counter()
        """Number of data frames by 11-bit COB-ID."""
        self.nmt: Counter[bytes] = Counter()
        """Number of NMT commands by their two data bytes: command specifier and node-ID. The key ``b""``
        counts commands of any other length."""
        self.extended = self.remote = self.errors = 0
        """Numbers of extended frames (29-bit identifiers), remote frames and error frames."""

    @property
    def nodes(self) -> dict[int, NodeTraffic]:
        """Copy of the messages received, by node-ID."""
        return dict(self._nodes)

    def node(self, node_id: int) -> NodeTraffic:
        """Return the messages received from one node-ID; the record is empty if there were none."""
        return self._nodes.get(node_id) or NodeTraffic()

    def newest_beat(self, node_id: int, since_ns: int = 0) -> Beat | None:
        """Return the newest heartbeat, boot-up or guarding message received after ``since_ns``, if any."""
        beats = self.node(node_id).beats
        newest = beats[-1] if beats else None
        return newest if newest is not None and newest.t_ns > since_ns else None

    def on_frames(self, frames: Sequence[Frame]) -> None:
        """Record a batch of received frames."""
        for frame in frames:
            if frame.error:
                self.errors += 1
            elif frame.remote:
                self.remote += 1
            elif frame.extended:
                self.extended += 1
            else:
                self.cob_ids[frame.can_id] += 1
                self._note(frame)

    def _note(self, frame: Frame) -> None:
        kind, node_id = frame.can_id & od.FUNCTION_MASK, frame.can_id & od.NODE_ID_MASK
        if frame.can_id == od.NMT_COB_ID:
            self.nmt[frame.data if len(frame.data) == 2 else b""] += 1
        if node_id == 0:
            return
        data, t_ns = frame.data, frame.t_ns
        if kind == od.heartbeat_cob_id(0) and len(data) == 1:
            node = self._nodes.setdefault(node_id, NodeTraffic())
            node.boot_ups += data[0] == NmtState.INITIALISING
            node.beats.append(Beat(t_ns, data[0] & STATE_MASK))
        elif kind == od.emcy_cob_id(0) and len(data) == 8:
            code = int.from_bytes(data[:2], "little")
            node = self._nodes.setdefault(node_id, NodeTraffic())
            node.emergencies.append(Emergency(t_ns, code, data[2], data[3:]))
        elif kind == od.sdo_response_cob_id(0):
            node = self._nodes.setdefault(node_id, NodeTraffic())
            node.newest_sdo = t_ns, data
            if len(data) == 8:
                node.sdo_answers.append((t_ns, data))
