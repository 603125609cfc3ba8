"""What all SDO transfers have in common: a channel, a deadline, and a value that is collected whole."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

MULTIPLEXER: Final = struct.Struct("<BHB")
"""Command, index, sub-index: how requests that start something begin, and their answers."""
MULTIPLEXER_U32: Final = struct.Struct("<BHBI")
"""The same with the other four bytes: a size, or an abort code."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One SDO server channel. ``send`` takes the eight bytes of an answer."""

    store: ObjectStore
    send: Callable[[bytes], None]
    timeout_ns: int


class Transfer(ABC):
    """A transfer of more than one request. Raises Refused to abort."""

    def __init__(self, channel: Channel, index: int, subindex: int, t_ns: int) -> None:
        self._channel = channel
        self.index, self.subindex = index, subindex
        self.deadline_ns = t_ns + channel.timeout_ns
        """When :meth:`on_timer` has something to do."""

    @abstractmethod
    def wants(self, request: bytes) -> bool:
        """Whether a frame of the client belongs to this transfer."""

    @abstractmethod
    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Take a frame that belongs to the transfer; True when the transfer is over."""

    def on_timer(self, t_ns: int) -> None:
        """The deadline has come: the client went silent."""
        raise Refused(AbortCode.TIMED_OUT)

    def _await_client(self, t_ns: int) -> None:
        self.deadline_ns = t_ns + self._channel.timeout_ns


class Incoming:
    """A value that is being downloaded. It is kept here until it is whole, and stored once.

    ``announced`` is the size the client gave, if it did. Refuses an object that may not be written and a
    size that cannot be right as soon as either is known.
    """

    def __init__(self, store: ObjectStore, index: int, subindex: int, announced: int | None) -> None:
        self._store, self._index, self._subindex = store, index, subindex
        self._lengths = store.lengths(index, subindex)
        self._announced = announced
        if announced is not None:
            self._lengths.check(announced)
        self.data = bytearray()

    def extend(self, part: bytes) -> None:
        """Add what came."""
        self.data += part
        self._lengths.check_not_above(len(self.data))
        if self._announced is not None and len(self.data) > self._announced:
            raise Refused(AbortCode.TOO_LONG)

    def store(self) -> None:
        """Write the value, now that it is whole."""
        if self._announced is not None and len(self.data) < self._announced:
            raise Refused(AbortCode.TOO_SHORT)
        self._store.write(self._index, self._subindex, bytes(self.data))
