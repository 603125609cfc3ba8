"""Reads the PDO parameters of a node (0x1400 to 0x1BFF) and describes them in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from skinnode.canopen import indices as od
from skinnode.errors import SdoAbort
from skinnode.host.sdo_client import RemoteOd
from skinnode.text.words import counted

Direction = Literal["TPDO", "RPDO"]

_CAN_ID: Final = 0x1FFF_FFFF
_KINDS: Final = {
    0: "at SYNC, if an event occurred",
    252: "sampled at SYNC, sent on request",
    253: "on request",
    254: "on event",
    255: "on event",
}


@dataclass(frozen=True, slots=True)
class Pdo:
    """Communication and mapping parameters of a PDO.

    Times are in the units of CiA 301. None stands for a sub-index that the node does not have.
    """

    direction: Direction
    number: int
    """PDO number, counted from 1."""
    cob_id: int
    enabled: bool
    kind: int
    """Transmission type."""
    inhibit_100us: int | None
    event_timer_ms: int | None
    sync_start: int | None
    mapped: tuple[int, ...]
    """Mapping entries: index (16 bits), sub-index (8 bits) and length in bits (8 bits)."""

    @property
    def bits(self) -> int:
        """Length of the mapped data in bits."""
        return sum(entry & 0xFF for entry in self.mapped)


def read_pdos(remote: RemoteOd) -> tuple[Pdo, ...]:
    """Read all PDOs, TPDOs first. Raises NodeError if the node does not answer."""
    return (*_read(remote, "TPDO", od.TPDO1_PARAMETER), *_read(remote, "RPDO", od.RPDO1_PARAMETER))


def read_pdo(remote: RemoteOd, direction: Direction, number: int) -> Pdo | None:
    """Read the parameters of one PDO; None if the node does not have it."""
    first = od.TPDO1_PARAMETER if direction == "TPDO" else od.RPDO1_PARAMETER
    index = first + number - 1
    cob_id = _optional(remote, index, od.PDO_COB_ID, "u32")
    if cob_id is None:
        return None
    mapping = index + od.PDO_MAPPING_OFFSET
    count = _optional(remote, mapping, 0, "u8") or 0
    mapped = tuple(int(remote.read(mapping, sub, "u32")) for sub in range(1, min(count, 64) + 1))
    return Pdo(
        direction,
        number,
        cob_id & _CAN_ID,
        not cob_id & od.PDO_INVALID,
        _optional(remote, index, od.PDO_TYPE, "u8") or 0,
        _optional(remote, index, od.PDO_INHIBIT_TIME, "u16") if direction == "TPDO" else None,
        _optional(remote, index, od.PDO_EVENT_TIMER, "u16"),
        _optional(remote, index, od.PDO_SYNC_START, "u8") if direction == "TPDO" else None,
        mapped,
    )


def _read(remote: RemoteOd, direction: Direction, first: int) -> list[Pdo]:
    pdos: list[Pdo] = []
    for number in range(1, od.MAX_PDOS + 1):
        pdo = read_pdo(remote, direction, number)
        if pdo is None:
            break
        pdos.append(pdo)
    return pdos


def _optional(remote: RemoteOd, index: int, subindex: int, kind: str) -> int | None:
    try:
        return int(remote.read(index, subindex, kind))
    except SdoAbort:
        return None


def kind_text(pdo: Pdo) -> str:
    """Describe in words when a TPDO is sent, or when the data of an RPDO take effect."""
    if 1 <= pdo.kind <= 240:
        every = "every SYNC" if pdo.kind == 1 else f"every {pdo.kind} SYNCs"
        return every if pdo.direction == "TPDO" or pdo.kind == 1 else "at the next SYNC"
    if pdo.direction == "RPDO" and pdo.kind >= 254:
        return "at once"
    return _KINDS.get(pdo.kind, f"type {pdo.kind} (reserved)")


def pdo_text(pdo: Pdo, name_of: Callable[[int, int], str]) -> str:
    """Describe a PDO in one line; ``name_of`` returns the name of an object by index and sub-index."""
    name = f"{pdo.direction}{pdo.number}"
    if not pdo.enabled:
        return f"{name} off"
    parts = [f"{name} 0x{pdo.cob_id:03X}", kind_text(pdo)]
    if pdo.inhibit_100us:
        parts.append(f"at least {pdo.inhibit_100us / 10:g} ms apart")
    if pdo.event_timer_ms:
        limit = "sent" if pdo.direction == "TPDO" else "expected"
        parts.append(f"{limit} at least every {pdo.event_timer_ms} ms")
    if pdo.sync_start:
        parts.append(f"from SYNC {pdo.sync_start} on")
    names = [name_of(entry >> 16, entry >> 8 & 0xFF) for entry in pdo.mapped]
    parts.append(f"{counted(pdo.bits // 8, 'byte')}: {_shortened(names)}" if names else "nothing mapped")
    return ", ".join(parts)


def _shortened(names: list[str]) -> str:
    """Join names, merging consecutive names that differ only in their number."""
    shown: list[str] = []
    for name in names:
        stem, _, number = name.rpartition(" ")
        if number.isdecimal() and shown and shown[-1].split(" to ")[0].rpartition(" ")[0] == stem:
            shown[-1] = f"{shown[-1].split(' to ')[0]} to {number}"
        else:
            shown.append(name)
    return "; ".join(shown)
