"""TIME consumer (CiA 301 v4.2, 7.2.6), including object 0x1012.

A node has no real-time clock. It stores the last time of day received and its arrival time on the node's own
clock, and computes the current time of day (0x2022) from both. A host can use 0x2022 to convert the device
times of scans to dates.
"""

from __future__ import annotations

import struct
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import Clock
from skinnode.node.pdo.parameters import COB_ID_MASK, INVALID_BIT, check_cob_id

_CONSUMES: Final = 1 << 31
_PRODUCES: Final = 1 << 30
_DAY_MS: Final = 86_400_000
_FORMAT: Final = struct.Struct("<IH")
"""Format of TIME_OF_DAY (CiA 301 v4.2, 7.1.6.5): u28 ms after midnight, 4 reserved bits, u16 days since
1984-01-01."""
_MS_MASK: Final = (1 << 28) - 1


class TimeConsumer:
    """TIME consumer of a node. The object 0x2022 contains the current time of day.

    Args:
        store: Object dictionary.
        now: Function that returns the time (ns) of the event being handled.
    """

    def __init__(self, store: ObjectStore, now: Clock) -> None:
        self._store, self._now = store, now
        # last time of day received, in ms since 1984-01-01, and its arrival time on the node's clock
        self._received_ms = 0
        self._received_ns = 0
        self._messages = 0
        store.guard(od.COB_ID_TIME, self._guard)
        store.bind(od.TIME_OF_DAY, self._read)

    @property
    def cob_id(self) -> int | None:
        """COB-ID of TIME, or None if the node does not consume TIME."""
        word = self._store.integer(od.COB_ID_TIME)
        return word & COB_ID_MASK if word & _CONSUMES else None

    def on_time(self, data: bytes, t_ns: int) -> bool:
        """Process a TIME message.

        Args:
            data: Payload of the frame.
            t_ns: Arrival time, in ns.

        Returns:
            Whether the payload is a valid time of day. An invalid payload is ignored.
        """
        if len(data) != _FORMAT.size:
            return False
        ms, days = _FORMAT.unpack(data)
        ms &= _MS_MASK
        if ms >= _DAY_MS:
            return False
        self._received_ms, self._received_ns = days * _DAY_MS + ms, t_ns
        self._messages = min(self._messages + 1, 0xFFFF_FFFF)
        return True

    def reset(self) -> None:
        """Discard the time of day after power-on and *reset node*."""
        self._received_ms = self._received_ns = self._messages = 0

    def _read(self, subindex: int) -> bytes:
        """Return the value of a sub-index of 0x2022; 0 before the first TIME message."""
        passed_ms = (self._now() - self._received_ns) // 1_000_000 if self._messages else 0
        days, ms = divmod(self._received_ms + passed_ms, _DAY_MS)
        match subindex:
            case od.TIME_DAYS:
                return (days & 0xFFFF).to_bytes(2, "little")
            case od.TIME_MS:
                return ms.to_bytes(4, "little")
            case od.TIME_MESSAGES:
                return self._messages.to_bytes(4, "little")
            case _:
                return (self._received_ns // 1000 & 0xFFFF_FFFF).to_bytes(4, "little")

    def _guard(self, _: int, value: int) -> None:
        """Refuse to produce TIME, or to change the CAN-ID while the node consumes TIME."""
        current = self._store.integer(od.COB_ID_TIME)
        if value & _PRODUCES:
            raise Refused(AbortCode.INVALID_VALUE)
        # Bit 31 means "in use" in 0x1012 but "invalid" in other COB-IDs. Restricted CAN-IDs are refused even
        # if TIME is not in use.
        check_cob_id(value ^ _CONSUMES, current ^ _CONSUMES)
        check_cob_id(value & ~_CONSUMES, INVALID_BIT)
