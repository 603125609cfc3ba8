"""Frame counts by kind, for checking a host's counts against the simulated nodes' counts."""

from __future__ import annotations

import enum
from collections import Counter
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState

_BOOT_UP_DATA: Final = bytes((NmtState.INITIALISING,))


class Kind(enum.StrEnum):
    """Kind of frame, derived from its COB-ID in the predefined connection set (CiA 301, 7.3.3)."""

    NMT = "NMT"
    SYNC = "SYNC"
    EMCY = "EMCY"
    CHUNK = "chunk"
    SUMMARY = "summary"
    COMMAND = "command"
    SDO_REQUEST = "SDO request"
    SDO_RESPONSE = "SDO response"
    HEARTBEAT = "heartbeat"
    BOOT_UP = "boot-up"
    LSS_REQUEST = "LSS request"
    LSS_RESPONSE = "LSS response"
    REMOTE = "remote"
    OTHER = "foreign"


_SINGLE: Final = {
    od.NMT_COB_ID: Kind.NMT,
    od.SYNC_COB_ID: Kind.SYNC,
    od.LSS_REQUEST_COB_ID: Kind.LSS_REQUEST,
    od.LSS_RESPONSE_COB_ID: Kind.LSS_RESPONSE,
}
_BY_FUNCTION: Final = {
    od.emcy_cob_id(0): Kind.EMCY,
    od.chunk_cob_id(0): Kind.CHUNK,
    od.summary_cob_id(0): Kind.SUMMARY,
    od.command_cob_id(0): Kind.COMMAND,
    od.sdo_request_cob_id(0): Kind.SDO_REQUEST,
    od.sdo_response_cob_id(0): Kind.SDO_RESPONSE,
    od.heartbeat_cob_id(0): Kind.HEARTBEAT,
}
_FUNCTION_CODE: Final = 0x780
_KIND_OF_ID: Final = [
    _SINGLE.get(can_id) or _BY_FUNCTION.get(can_id & _FUNCTION_CODE, Kind.OTHER) for can_id in range(0x800)
]


def kind_of(can_id: int, data: bytes, remote: bool = False) -> Kind:
    """Return the kind of a frame with an 11-bit identifier.

    All remote frames are of the kind ``REMOTE``. The kind does not depend on the frame length.
    """
    if remote:
        return Kind.REMOTE
    kind = _KIND_OF_ID[can_id]
    return Kind.BOOT_UP if kind is Kind.HEARTBEAT and data.startswith(_BOOT_UP_DATA) else kind


class Tally:
    """Counts of one node's frames, by kind.

    For sent frames, ``handed = emitted + lost + silenced + refused + waiting``. For received frames,
    ``heard = taken + lost_in + unheard``.
    """

    def __init__(self) -> None:
        self.handed: Counter[Kind] = Counter()
        """Frames submitted for sending, by the node itself or by a fault that adds frames."""
        self.emitted: Counter[Kind] = Counter()
        """Frames put on the bus."""
        self.lost: Counter[Kind] = Counter()
        """Frames dropped by a fault on the way to the bus."""
        self.silenced: Counter[Kind] = Counter()
        """Frames not sent because the node was silent, unplugged or being reset."""
        self.refused: Counter[Kind] = Counter()
        """Frames that the bus rejected."""
        self.waiting: Counter[Kind] = Counter()
        """Chunks held back by the ``late`` and ``reordered`` faults."""
        self.heard: Counter[Kind] = Counter()
        """Frames that reached the node's controller."""
        self.taken: Counter[Kind] = Counter()
        """Frames passed to the node."""
        self.lost_in: Counter[Kind] = Counter()
        """Frames dropped by a fault on the way to the node."""
        self.unheard: Counter[Kind] = Counter()
        """Frames not received because the node was deaf or unplugged."""

    def discrepancies(self) -> list[str]:
        """Return a description of each inconsistency in the counts, by kind of frame.

        Call this method only while the node is idle.
        """
        out = self.emitted + self.lost + self.silenced + self.refused + self.waiting
        into = self.taken + self.lost_in + self.unheard
        found = [
            f"{kind} frames: {self.handed[kind]} submitted for sending, but {out[kind]} accounted for"
            for kind in Kind
            if self.handed[kind] != out[kind]
        ]
        return found + [
            f"{kind} frames: {self.heard[kind]} received, but {into[kind]} accounted for"
            for kind in Kind
            if self.heard[kind] != into[kind]
        ]
