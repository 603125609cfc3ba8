"""PDO parameters: what may be written to them, and what they say (CiA 301 v4.2, 7.5.2.33 to 7.5.2.38).

Where the standard leaves the abort code open, the ones of CANopenNode, the open reference, are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skinnode.node.abort import AbortCode, Refused
from skinnode.node.od import ObjectStore
from skinnode.wire import indices as od

INVALID_BIT: Final = 1 << 31
EXTENDED_BIT: Final = 1 << 29
COB_ID_MASK: Final = 0x7FF
SYNC_CYCLIC_MAX: Final = 240
EVENT_TYPES: Final = (254, 255)

_TRANSMITTED: Final = ("const", "ro", "rw", "rwr")
_RECEIVED: Final = ("wo", "rw", "rww")

_RESTRICTED: Final = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)


def check_cob_id(value: int, current: int) -> None:
    """Refuse a COB-ID that no configurable service may use, or that changes while it is in use."""
    if value & EXTENDED_BIT or value & ~(INVALID_BIT | 1 << 30) > COB_ID_MASK:
        raise Refused(AbortCode.INVALID_VALUE)
    if not value & INVALID_BIT and any(value & COB_ID_MASK in block for block in _RESTRICTED):
        raise Refused(AbortCode.INVALID_VALUE)
    in_use = not (value | current) & INVALID_BIT
    if in_use and (value ^ current) & COB_ID_MASK:
        raise Refused(AbortCode.INVALID_VALUE)


@dataclass(frozen=True, slots=True)
class PdoParameters:
    """A PDO as its two records describe it. Times in ns, 0 where not used."""

    enabled: bool
    cob_id: int
    kind: int
    """Transmission type."""
    inhibit_ns: int
    event_timer_ns: int
    sync_start: int
    mapping: tuple[tuple[int, int], ...]
    """Index and sub-index of each mapped object."""
    size: int
    """Bytes of the payload."""

    @property
    def event_driven(self) -> bool:
        return self.kind in EVENT_TYPES


class PdoRecords:
    """The communication and the mapping record of one PDO in an object dictionary: guards them, reads
    them."""

    def __init__(self, store: ObjectStore, parameter: int, mapping: int, *, transmits: bool) -> None:
        self._store = store
        self._parameter, self._mapping, self._transmits = parameter, mapping, transmits
        self._most_bytes = store.find(mapping, 0).high or 0  # as many as entries: the smallest is a byte
        store.guard(parameter, self._guard_parameter)
        store.guard(mapping, self._guard_mapping)

    @property
    def _enabled(self) -> bool:
        return not self._store.integer(self._parameter, od.PDO_COB_ID) & INVALID_BIT

    def read(self) -> PdoParameters:
        """The parameters as they are now."""
        store, parameter = self._store, self._parameter
        count = store.integer(self._mapping, 0)
        words = [store.integer(self._mapping, sub) for sub in range(1, count + 1)]
        cob_id = store.integer(parameter, od.PDO_COB_ID)
        timed = self._transmits
        return PdoParameters(
            enabled=self._enabled and bool(words),
            cob_id=cob_id & COB_ID_MASK,
            kind=store.integer(parameter, od.PDO_TYPE),
            inhibit_ns=store.integer(parameter, od.PDO_INHIBIT_TIME) * 100_000 if timed else 0,
            event_timer_ns=store.integer(parameter, od.PDO_EVENT_TIMER) * 1_000_000 if timed else 0,
            sync_start=store.integer(parameter, od.PDO_SYNC_START) if timed else 0,
            mapping=tuple((word >> 16, word >> 8 & 0xFF) for word in words),
            size=sum((word & 0xFF) // 8 for word in words),
        )

    def _guard_parameter(self, subindex: int, value: int) -> None:
        match subindex:
            case od.PDO_COB_ID:
                check_cob_id(value, self._store.integer(self._parameter, od.PDO_COB_ID))
            case od.PDO_TYPE:
                if SYNC_CYCLIC_MAX < value < EVENT_TYPES[0]:  # reserved, and on remote request
                    raise Refused(AbortCode.INVALID_VALUE)
            case od.PDO_INHIBIT_TIME | od.PDO_SYNC_START:
                if self._enabled:
                    raise Refused(AbortCode.INVALID_VALUE)

    def _guard_mapping(self, subindex: int, value: int) -> None:
        if self._enabled or (subindex and self._store.integer(self._mapping, 0)):
            raise Refused(AbortCode.UNSUPPORTED_ACCESS)
        if subindex:
            self._mapped_bytes(value)
        else:
            self._check_mapping(value)

    def _check_mapping(self, count: int) -> None:
        words = (self._store.integer(self._mapping, sub) for sub in range(1, count + 1))
        if sum(self._mapped_bytes(word) for word in words) > self._most_bytes:
            raise Refused(AbortCode.PDO_TOO_LONG)

    def _mapped_bytes(self, word: int) -> int:
        """Bytes of the object a mapping entry names; 0 for an empty entry."""
        if word == 0:
            return 0
        entry = self._store.find(word >> 16, word >> 8 & 0xFF)
        allowed = entry.mappable and entry.access in (_TRANSMITTED if self._transmits else _RECEIVED)
        if not (allowed and word & 0xFF == entry.data_type.bits):
            raise Refused(AbortCode.NOT_MAPPABLE)
        return entry.data_type.bits // 8
