"""The object dictionary of a running node: the declarations of the profile, and the values.

Declarations come from :mod:`skinnode.protocol.profile`, which also generates the EDS files. Values
are the bytes that travel (little-endian), so that an SDO answer and a PDO are slices and a joined list. An
object may be computed when it is read (:meth:`ObjectStore.bind`), may refuse a value
(:meth:`ObjectStore.guard`) and may act on one that was accepted (:meth:`ObjectStore.watch`); a DOMAIN may be
kept by somebody else (:meth:`ObjectStore.bind_domain`). A refused write changes nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.dictionary import DataType, Entry, Object, Value

MAX_BYTES: Final = 1 << 16
"""Memory there is for a value whose length nothing limits."""

Reader = Callable[[int], bytes]
"""Sub-index to value; may refuse."""
Guard = Callable[[int, int], None]
"""Sub-index and proposed value (the bit pattern of a REAL32); raises Refused."""
Watcher = Callable[[int], None]
"""Called with the sub-index that has just been written."""
ChangeWatcher = Callable[[int, int], None]
"""Called with index and sub-index of a parameter that has another value now."""
DomainWriter = Callable[[bytes], None]
"""Takes a whole value, or refuses it and changes nothing."""


class Lengths(NamedTuple):
    """Bytes that a client may write to an object."""

    least: int
    most: int

    def check(self, length: int) -> None:
        """Refuse a value of another length."""
        self.check_not_above(length)
        if length < self.least:
            raise Refused(AbortCode.TOO_SHORT)

    def check_not_above(self, length: int) -> None:
        """Refuse what is too long already."""
        if length > self.most:
            raise Refused(AbortCode.TOO_LONG if self.most == self.least else AbortCode.OUT_OF_MEMORY)


def to_bytes(entry: Entry, value: Value | bytes) -> bytes:
    """A value as it travels. Raises OverflowError or struct.error for one that the type cannot hold."""
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return value.encode("ascii")
    if entry.data_type is DataType.REAL32:
        return struct.pack("<f", value)
    return int(value).to_bytes(entry.data_type.bits // 8, "little")


class ObjectStore:
    """Values of all objects of one node.

    ``read`` and ``write`` are a client's accesses and refuse with :class:`~skinnode.canopen.abort.Refused`;
    ``raw``,
    ``integer`` and ``put`` are the node's own, on objects it knows to exist.
    """

    def __init__(self, objects: Iterable[Object], node_id: int) -> None:
        self._entries = {(e.index, e.subindex): e for item in objects for e in item.entries}
        self._indices = {index for index, _ in self._entries}
        self.node_id = node_id
        """What COB-IDs follow by default; see :meth:`renumber`."""
        self._values = {key: self._at_start(entry) for key, entry in self._entries.items()}
        self._readers: dict[tuple[int, int], Reader] = {}
        self._guards: dict[int, Guard] = {}
        self._watchers: dict[int, Watcher] = {}
        self._change_watcher: ChangeWatcher = lambda *_: None
        self._domains: dict[int, tuple[Lengths, DomainWriter]] = {}

    def _at_start(self, entry: Entry) -> bytes:
        value = entry.value_at_start(self.node_id)
        return bytes(entry.data_type.bits // 8) if value is None else to_bytes(entry, value)

    def bind(self, index: int, reader: Reader, *, count: bool = False) -> None:
        """Compute the sub-objects of ``index`` when they are read; sub-index 0 of an array or record, its
        count, only if ``count`` is set."""
        whole = count or (index, 1) not in self._entries
        for key in self._entries:
            if key[0] == index and (key[1] or whole):
                self._readers[key] = reader

    def bind_domain(self, index: int, length: int, reader: Reader, writer: DomainWriter) -> None:
        """Let ``reader`` and ``writer`` keep the value of a writable DOMAIN, which always has ``length``
        bytes."""
        self._readers[index, 0] = reader
        self._domains[index] = Lengths(length, length), writer

    def guard(self, index: int, guard: Guard) -> None:
        """Let ``guard`` refuse values written to ``index``."""
        self._guards[index] = guard

    def watch(self, index: int, watcher: Watcher) -> None:
        """Call ``watcher`` after ``index`` was written."""
        self._watchers[index] = watcher

    def watch_changes(self, watcher: ChangeWatcher) -> None:
        """Call ``watcher`` after a client gave a parameter, a writable object that is not computed, another
        value."""
        self._change_watcher = watcher

    def find(self, index: int, subindex: int) -> Entry:
        """The declaration. Refuses an object or a sub-object that does not exist."""
        entry = self._entries.get((index, subindex))
        if entry is None:
            raise Refused(AbortCode.NO_SUBINDEX if index in self._indices else AbortCode.NO_OBJECT)
        return entry

    def has(self, index: int, subindex: int) -> bool:
        """Whether there is such an object."""
        return (index, subindex) in self._entries

    def lengths(self, index: int, subindex: int) -> Lengths:
        """Bytes that may be written to an object; refuses one that may not be written."""
        entry = self.find(index, subindex)
        if entry.access in ("ro", "const"):
            raise Refused(AbortCode.READ_ONLY)
        if index in self._domains:
            return self._domains[index][0]
        size = entry.data_type.bits // 8
        return Lengths(size, size) if size else Lengths(0, MAX_BYTES)

    def read(self, index: int, subindex: int) -> bytes:
        """A client's upload."""
        if self.find(index, subindex).access == "wo":
            raise Refused(AbortCode.WRITE_ONLY)
        return self.raw(index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """A client's download: checked against declaration and guard, stored, then announced."""
        self.lengths(index, subindex).check(len(data))
        if index in self._domains:
            self._domains[index][1](data)
        else:
            self._check(index, subindex, data)
            before, self._values[index, subindex] = self._values[index, subindex], data
            if data != before and (index, subindex) not in self._readers:
                self._change_watcher(index, subindex)
        watcher = self._watchers.get(index)
        if watcher is not None:
            watcher(subindex)

    def _check(self, index: int, subindex: int, data: bytes) -> None:
        entry = self._entries[index, subindex]
        value = int.from_bytes(data, "little") if entry.data_type.bits else 0
        if entry.high is not None and value > entry.high:
            raise Refused(AbortCode.VALUE_TOO_HIGH)
        if entry.low is not None and value < entry.low:
            raise Refused(AbortCode.VALUE_TOO_LOW)
        guard = self._guards.get(index)
        if guard is not None:
            guard(subindex, value)

    def raw(self, index: int, subindex: int) -> bytes:
        """The bytes of an object, computed if it is bound."""
        reader = self._readers.get((index, subindex))
        return self._values[index, subindex] if reader is None else reader(subindex)

    def written(self, index: int, subindex: int) -> bytes:
        """The bytes a client has written, also where reading computes something else."""
        return self._values[index, subindex]

    def integer(self, index: int, subindex: int = 0) -> int:
        """The value of an unsigned object that is not bound."""
        return int.from_bytes(self._values[index, subindex], "little")

    def put(self, index: int, subindex: int, value: Value | bytes) -> None:
        """Set an object from within the node; nobody is asked or told."""
        self._values[index, subindex] = to_bytes(self._entries[index, subindex], value)

    def restore(self, first: int, last: int) -> None:
        """Writable objects from ``first`` to ``last`` as they were at start."""
        for key in self._writable(first, last):
            self._values[key] = self._at_start(self._entries[key])

    def not_at_default(self, first: int, last: int) -> dict[tuple[int, int], bytes]:
        """Parameters from ``first`` to ``last`` that have another value than after :meth:`restore`; what is
        computed is no parameter."""
        return {
            key: self._values[key]
            for key in self._writable(first, last)
            if key not in self._readers and self._values[key] != self._at_start(self._entries[key])
        }

    def _writable(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        for key, entry in self._entries.items():
            if first <= key[0] <= last and entry.access not in ("ro", "const"):
                yield key

    def renumber(self, node_id: int) -> None:
        """The node has another node-ID from now on. COB-IDs that may be written follow with the next
        :meth:`restore`, the others at once."""
        self.node_id = node_id
        for key, entry in self._entries.items():
            if entry.plus_node_id and entry.access in ("ro", "const"):
                self._values[key] = self._at_start(entry)
