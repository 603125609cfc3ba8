"""Declarations of the objects in an object dictionary, without their current values.

Object codes and data types follow CiA 301; access types follow CiA 306.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

Value = int | float | str


class ObjectType(enum.IntEnum):
    """Object codes of CiA 301."""

    DOMAIN = 0x02
    VAR = 0x07
    ARRAY = 0x08
    RECORD = 0x09


class DataType(enum.IntEnum):
    """Data types of CiA 301 that a patch uses, with their indices."""

    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    DOMAIN = 0x0F
    UNSIGNED24 = 0x16

    @property
    def bits(self) -> int:
        """Length of the data type in bits; 0 if it varies."""
        return _BITS[self]


_BITS = {
    DataType.UNSIGNED8: 8,
    DataType.UNSIGNED16: 16,
    DataType.UNSIGNED32: 32,
    DataType.REAL32: 32,
    DataType.VISIBLE_STRING: 0,
    DataType.DOMAIN: 0,
    DataType.UNSIGNED24: 24,
}


@dataclass(frozen=True, slots=True)
class Entry:
    """Declaration of a value in an object dictionary, at one index and sub-index."""

    index: int
    subindex: int
    name: str
    """Parameter name in the EDS."""
    data_type: DataType
    access: str
    """Access type: ro, rw, wo, const, or rww (rw and mappable into an RPDO)."""
    default: Value | None = None
    """Default value; None if it differs between devices, as the serial number does. The initial value is then
    0."""
    plus_node_id: bool = False
    """Whether the node-ID is added to the default value, as in a COB-ID."""
    mappable: bool = False
    """Whether the entry can be mapped into a PDO."""
    low: int | None = None
    """Lower limit of the value, or None."""
    high: int | None = None
    """Upper limit of the value, or None."""

    @property
    def mapping(self) -> int:
        """Mapping entry for a PDO: index (16 bits), sub-index (8 bits) and length in bits (8 bits)."""
        return self.index << 16 | self.subindex << 8 | self.data_type.bits

    def value_at_start(self, node_id: int) -> Value | None:
        """Return the default value, plus the node-ID if ``plus_node_id`` is true.

        Args:
            node_id: node-ID of the node.
        """
        if self.plus_node_id and isinstance(self.default, int):
            return self.default + node_id
        return self.default


@dataclass(frozen=True, slots=True)
class Object:
    """Object in an object dictionary. A VAR or DOMAIN has only one entry, at sub-index 0."""

    index: int
    name: str
    type: ObjectType
    entries: tuple[Entry, ...]

    def __getitem__(self, subindex: int) -> Entry:
        for entry in self.entries:
            if entry.subindex == subindex:
                return entry
        raise KeyError(f"0x{self.index:04X} has no sub-index {subindex}")


def var(  # noqa: PLR0913 - one argument for each column of the standard's tables
    index: int,
    name: str,
    data_type: DataType,
    access: str,
    default: Value | None = None,
    *,
    plus_node_id: bool = False,
    mappable: bool = False,
    high: int | None = None,
) -> Object:
    """Declare a VAR or DOMAIN. The arguments are the same as for :class:`Entry`."""
    entry = Entry(index, 0, name, data_type, access, default, plus_node_id, mappable, None, high)
    kind = ObjectType.DOMAIN if data_type is DataType.DOMAIN else ObjectType.VAR
    return Object(index, name, kind, (entry,))


def highest(index: int, highest: int) -> Entry:
    """Declare sub-index 0 of an array or a record.

    Args:
        index: index of the object.
        highest: highest sub-index of the object.
    """
    return Entry(index, 0, "Highest sub-index supported", DataType.UNSIGNED8, "const", highest)


def record(index: int, name: str, entries: Sequence[Entry], first: Entry | None = None) -> Object:
    """Declare a record.

    Args:
        index: index of the record.
        name: name of the record.
        entries: entries from sub-index 1 upwards, in ascending order.
        first: entry at sub-index 0; by default, a constant with the highest sub-index.
    """
    first = first or highest(index, entries[-1].subindex)
    return Object(index, name, ObjectType.RECORD, (first, *entries))


def array(  # noqa: PLR0913 - one argument for each column of the standard's tables
    index: int,
    name: str,
    labels: Sequence[str],
    data_type: DataType,
    access: str,
    default: Value | None = None,
    *,
    first: Entry | None = None,
    mappable: bool = False,
    high: int | None = None,
) -> Object:
    """Declare an array.

    ``labels`` contains the names of the entries from sub-index 1 upwards. ``first`` is described in
    :func:`record`. The other arguments are the same as for :class:`Entry`.
    """
    entries = tuple(
        Entry(index, sub, label, data_type, access, default, mappable=mappable, high=high)
        for sub, label in enumerate(labels, 1)
    )
    return Object(index, name, ObjectType.ARRAY, (first or highest(index, len(entries)), *entries))
