"""Communication and mapping parameters of PDOs (CiA 301 v4.2, 7.5.2.33 to 7.5.2.38).

Where the standard does not specify an abort code, the code used by the CANopenNode stack is returned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

INVALID_BIT: Final = od.PDO_INVALID
NO_RTR_BIT: Final = 1 << 30
"""Bit in a TPDO's COB-ID: remote frames are not allowed for this PDO."""
EXTENDED_BIT: Final = 1 << 29
"""Bit in a COB-ID: the CAN-ID has 29 bits."""
COB_ID_MASK: Final = 0x7FF
"""Mask of the 11-bit CAN-ID in a COB-ID."""
SYNC_CYCLIC_MAX: Final = 240
"""Highest cyclic synchronous transmission type."""
SYNC_REMOTE, REMOTE = 252, 253
"""Transmission types of PDOs that are sent only on request by a remote frame. Their values are sampled at the
last SYNC (252) or on request (253)."""
EVENT_TYPES: Final = (254, 255)
"""Event-driven transmission types."""

_MOST_MAPPED: Final = 64  # maximum number of mapped objects (CiA 301)

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
"""CAN-IDs that configurable services must not use (CiA 301 v4.2, table 40)."""


def check_cob_id(value: int, current: int) -> None:
    """Check a COB-ID written by a client.

    Args:
        value: New COB-ID, with its flag bits.
        current: Current COB-ID, with its flag bits.

    Raises:
        Refused: If the new COB-ID is malformed, if its CAN-ID is restricted, or if it would change the CAN-ID
            of an enabled service.
    """
    if value & EXTENDED_BIT or value & ~(INVALID_BIT | NO_RTR_BIT) > COB_ID_MASK:
        raise Refused(AbortCode.INVALID_VALUE)
    if not value & INVALID_BIT and any(value & COB_ID_MASK in block for block in _RESTRICTED):
        raise Refused(AbortCode.INVALID_VALUE)
    in_use = not (value | current) & INVALID_BIT
    if in_use and (value ^ current) & COB_ID_MASK:
        raise Refused(AbortCode.INVALID_VALUE)


@dataclass(frozen=True, slots=True)
class Mapped:
    """Object mapped into a PDO. If ``index`` refers to a data type, the object is a dummy without a value."""

    index: int
    subindex: int
    size: int
    """Length of the object in bytes."""


@dataclass(frozen=True, slots=True)
class PdoParameters:
    """Communication and mapping parameters of a PDO. A time of 0 ns disables the corresponding timer."""

    enabled: bool
    """Whether the PDO is enabled and has at least one mapped object."""
    cob_id: int
    """CAN-ID of the PDO, 11 bits."""
    answers_rtr: bool
    """Whether remote frames can request the PDO; false for an RPDO."""
    kind: int
    """Transmission type."""
    inhibit_ns: int
    event_timer_ns: int
    sync_start: int
    mapping: tuple[Mapped, ...]
    """Mapped objects, in payload order."""
    size: int
    """Length of the payload in bytes."""

    @property
    def event_driven(self) -> bool:
        """Whether the transmission type is event-driven."""
        return self.kind in EVENT_TYPES

    @property
    def synchronous(self) -> bool:
        """Whether a SYNC triggers the PDO. This is false for type 252, which is only sampled at a SYNC."""
        return self.kind <= SYNC_CYCLIC_MAX


class PdoRecords:
    """Communication record and mapping record of a PDO. Writes by clients are checked.

    Args:
        store: Object dictionary.
        parameter: Index of the communication record.
        mapping: Index of the mapping record.
        transmits: Whether the PDO is a TPDO.
        taken: Function that returns whether a PDO uses a CAN-ID; None if PDOs are allowed to share CAN-IDs.
    """

    def __init__(
        self,
        store: ObjectStore,
        parameter: int,
        mapping: int,
        *,
        transmits: bool,
        taken: Callable[[int], bool] | None = None,
    ) -> None:
        self._store = store
        self._parameter, self._mapping, self._transmits = parameter, mapping, transmits
        self._taken = taken
        # The smallest object has one byte, so this is also the maximum PDO length in bytes.
        self._longest = sum([store.has(mapping, sub) for sub in range(1, _MOST_MAPPED + 1)])
        store.guard(parameter, self._guard_parameter)
        store.guard(mapping, self._guard_mapping)

    def _word(self, subindex: int) -> int:
        """Return a communication parameter; 0 if the record does not have this sub-index."""
        has = self._store.has(self._parameter, subindex)
        return self._store.integer(self._parameter, subindex) if has else 0

    @property
    def _enabled(self) -> bool:
        return not self._word(od.PDO_COB_ID) & INVALID_BIT

    def read(self) -> PdoParameters:
        """Return the parameters in the object dictionary."""
        store = self._store
        count = store.integer(self._mapping, 0)
        words = [store.integer(self._mapping, sub) for sub in range(1, count + 1)]
        mapping = tuple(Mapped(word >> 16, word >> 8 & 0xFF, (word & 0xFF) // 8) for word in words)
        cob_id = self._word(od.PDO_COB_ID)
        return PdoParameters(
            enabled=self._enabled and bool(mapping),
            cob_id=cob_id & COB_ID_MASK,
            answers_rtr=self._transmits and not cob_id & NO_RTR_BIT,
            kind=self._word(od.PDO_TYPE),
            inhibit_ns=self._word(od.PDO_INHIBIT_TIME) * 100_000,
            event_timer_ns=self._word(od.PDO_EVENT_TIMER) * 1_000_000,
            sync_start=self._word(od.PDO_SYNC_START),
            mapping=mapping,
            size=sum(each.size for each in mapping),
        )

    def _guard_parameter(self, subindex: int, value: int) -> None:
        match subindex:
            case od.PDO_COB_ID:
                self._guard_cob_id(value)
            case od.PDO_TYPE:
                remote = self._transmits and value in (SYNC_REMOTE, REMOTE)
                if not remote and SYNC_CYCLIC_MAX < value < EVENT_TYPES[0]:  # reserved
                    raise Refused(AbortCode.INVALID_VALUE)
            case od.PDO_INHIBIT_TIME | od.PDO_SYNC_START:
                if self._enabled:
                    raise Refused(AbortCode.INVALID_VALUE)

    def _guard_cob_id(self, value: int) -> None:
        check_cob_id(value, self._word(od.PDO_COB_ID))
        if value & INVALID_BIT:
            return
        if not self._store.integer(self._mapping, 0):  # nothing is mapped
            raise Refused(AbortCode.INVALID_VALUE)
        if not self._enabled and self._taken is not None and self._taken(value & COB_ID_MASK):
            raise Refused(AbortCode.INCOMPATIBLE)

    def _guard_mapping(self, subindex: int, value: int) -> None:
        if self._enabled or (subindex and self._store.integer(self._mapping, 0)):
            raise Refused(AbortCode.UNSUPPORTED_ACCESS)
        if not subindex:
            self._check_mapping(value)
        elif value:  # 0 marks an unused entry
            self._mapped_bytes(value)

    def _check_mapping(self, count: int) -> None:
        if count > self._longest:
            raise Refused(AbortCode.PDO_TOO_LONG)
        words = [self._store.integer(self._mapping, sub) for sub in range(1, count + 1)]
        if sum([self._mapped_bytes(word) for word in words]) > self._longest:
            raise Refused(AbortCode.PDO_TOO_LONG)

    def _mapped_bytes(self, word: int) -> int:
        """Return the length, in bytes, of the object in a mapping entry."""
        index, subindex, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
        if not self._transmits and not subindex and index in od.DUMMY_BITS:
            allowed, size = True, od.DUMMY_BITS[index]
        else:
            entry = self._store.find(index, subindex)
            allowed = entry.mappable and entry.access in (_TRANSMITTED if self._transmits else _RECEIVED)
            size = entry.data_type.bits
        if not (allowed and bits == size):
            raise Refused(AbortCode.NOT_MAPPABLE)
        return size // 8
