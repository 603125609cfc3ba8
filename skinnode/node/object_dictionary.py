"""Object dictionary of a running node: declarations and current values of the objects.

The objects of a patch are declared in :mod:`skinnode.protocol.objects`, from which the EDS files are also
generated. Values are stored as little-endian bytes, as they are sent in SDOs and PDOs.

The services of a node register callbacks for their objects:

- :meth:`ObjectStore.bind`: computes the value when it is read
- :meth:`ObjectStore.guard`: checks a value before it is written
- :meth:`ObjectStore.watch`: reacts to a write
- :meth:`ObjectStore.bind_domain`: reads and writes a DOMAIN that is stored elsewhere
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.dictionary import DataType, Entry, Object, Value

MAX_BYTES: Final = 1 << 16
"""Maximum length in bytes of a value with a variable-length data type."""

Reader = Callable[[int], bytes]
"""Callback that returns the bytes of a sub-index or raises Refused."""
Guard = Callable[[int, int], None]
"""Callback that checks a new value and raises Refused to reject it. Its arguments are the sub-index and the
value as an unsigned integer; a REAL32 is passed as its bit pattern."""
Watcher = Callable[[int], None]
"""Callback for a write by a client. Its argument is the sub-index."""
ChangeWatcher = Callable[[int, int], None]
"""Callback for a parameter that a client has changed. Its arguments are the index and sub-index."""
DomainWriter = Callable[[bytes], None]
"""Callback that stores a complete value, or raises Refused without storing anything."""


class Lengths(NamedTuple):
    """Permitted lengths of the values that a client writes to an object."""

    least: int
    """Minimum length in bytes."""
    most: int
    """Maximum length in bytes."""

    def check(self, length: int) -> None:
        """Check the length of a complete value.

        Raises:
            Refused: If the length is out of range.
        """
        self.check_not_above(length)
        if length < self.least:
            raise Refused(AbortCode.TOO_SHORT)

    def check_not_above(self, length: int) -> None:
        """Check the number of bytes received so far for a value that may be incomplete.

        Raises:
            Refused: If the length exceeds the maximum.
        """
        if length > self.most:
            raise Refused(AbortCode.TOO_LONG if self.most == self.least else AbortCode.OUT_OF_MEMORY)


def to_bytes(entry: Entry, value: Value | bytes) -> bytes:
    """Convert a value to the bytes that are sent on the bus.

    Args:
        entry: Declaration of the object.
        value: Value; bytes are returned unchanged.

    Raises:
        OverflowError: If the value does not fit in the integer type.
        struct.error: If the value is not a number but the data type is REAL32.
    """
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return value.encode("ascii")
    if entry.data_type is DataType.REAL32:
        return struct.pack("<f", value)
    return int(value).to_bytes(entry.data_type.bits // 8, "little")


class ObjectStore:
    """Object dictionary of one node.

    Clients use :meth:`read` and :meth:`write`, which may raise :class:`~skinnode.canopen.abort.Refused`. The
    node itself uses :meth:`raw`, :meth:`integer` and :meth:`put`, which require that the object exists.

    Args:
        objects: Declarations of all objects.
        node_id: Node-ID added to the default COB-IDs.
    """

    def __init__(self, objects: Iterable[Object], node_id: int) -> None:
        self._entries = {(e.index, e.subindex): e for item in objects for e in item.entries}
        self._indices = {index for index, _ in self._entries}
        self.node_id = node_id
        """Node-ID added to the default COB-IDs; see :meth:`renumber`."""
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
        """Register ``reader`` to compute the values of an object.

        Args:
            index: Index of the object.
            reader: Returns the bytes of a sub-index.
            count: Whether ``reader`` also computes sub-index 0 of an array or record.
        """
        whole = count or (index, 1) not in self._entries
        for key in self._entries:
            if key[0] == index and (key[1] or whole):
                self._readers[key] = reader

    def bind_domain(self, index: int, length: int, reader: Reader, writer: DomainWriter) -> None:
        """Register functions that read and write a DOMAIN.

        Args:
            index: Index of the object.
            length: Length of the value, in bytes.
            reader: Returns the value.
            writer: Stores the value.
        """
        self._readers[index, 0] = reader
        self._domains[index] = Lengths(length, length), writer

    def guard(self, index: int, guard: Guard) -> None:
        """Register ``guard`` to check each value that a client writes to ``index`` before it is stored."""
        self._guards[index] = guard

    def watch(self, index: int, watcher: Watcher) -> None:
        """Register ``watcher`` to be called after each write to ``index`` by a client."""
        self._watchers[index] = watcher

    def watch_changes(self, watcher: ChangeWatcher) -> None:
        """Register ``watcher`` to be called after a client changes an object that is not computed."""
        self._change_watcher = watcher

    def find(self, index: int, subindex: int) -> Entry:
        """Return the declaration of an object.

        Raises:
            Refused: If the index or sub-index does not exist.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            raise Refused(AbortCode.NO_SUBINDEX if index in self._indices else AbortCode.NO_OBJECT)
        return entry

    def has(self, index: int, subindex: int) -> bool:
        """Return whether the object exists."""
        return (index, subindex) in self._entries

    def lengths(self, index: int, subindex: int) -> Lengths:
        """Return the permitted lengths of the values that a client writes to an object.

        Raises:
            Refused: If the object does not exist or is read-only.
        """
        entry = self.find(index, subindex)
        if entry.access in ("ro", "const"):
            raise Refused(AbortCode.READ_ONLY)
        if index in self._domains:
            return self._domains[index][0]
        size = entry.data_type.bits // 8
        return Lengths(size, size) if size else Lengths(0, MAX_BYTES)

    def read(self, index: int, subindex: int) -> bytes:
        """Read an object for a client.

        Raises:
            Refused: If the object does not exist or is write-only.
        """
        if self.find(index, subindex).access == "wo":
            raise Refused(AbortCode.WRITE_ONLY)
        return self.raw(index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object for a client: check and store the value, then call the watcher.

        Raises:
            Refused: If the object cannot be written or rejects the value.
        """
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
        """Return the current bytes of an object, stored or computed."""
        reader = self._readers.get((index, subindex))
        return self._values[index, subindex] if reader is None else reader(subindex)

    def written(self, index: int, subindex: int) -> bytes:
        """Return the stored bytes of an object, even if reading it returns a computed value."""
        return self._values[index, subindex]

    def integer(self, index: int, subindex: int = 0) -> int:
        """Return the stored value of an unsigned integer object."""
        return int.from_bytes(self._values[index, subindex], "little")

    def put(self, index: int, subindex: int, value: Value | bytes) -> None:
        """Set an object without calling its guard or watcher."""
        self._values[index, subindex] = to_bytes(self._entries[index, subindex], value)

    def restore(self, first: int, last: int) -> None:
        """Reset the writable objects with indices ``first`` to ``last`` to their defaults."""
        for key in self._writable(first, last):
            self._values[key] = self._at_start(self._entries[key])

    def not_at_default(self, first: int, last: int) -> dict[tuple[int, int], bytes]:
        """Return the values with indices ``first`` to ``last`` that differ from their defaults.

        Only writable objects that are not computed are included.
        """
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
        """Change the node-ID.

        Read-only COB-IDs change immediately. Writable COB-IDs change at the next :meth:`restore`.
        """
        self.node_id = node_id
        for key, entry in self._entries.items():
            if entry.plus_node_id and entry.access in ("ro", "const"):
                self._values[key] = self._at_start(entry)
