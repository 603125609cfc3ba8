"""What all SDO transfers share: a channel, a time-out, and the value that a download collects."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

MULTIPLEXER: Final = struct.Struct("<BHB")
"""Command, index, sub-index: the head of an initiate request and of its answer."""
MULTIPLEXER_U32: Final = struct.Struct("<BHBI")
"""The same head with four more bytes: a size, or an abort code."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One SDO server channel."""

    store: ObjectStore
    """Object dictionary."""
    send: Callable[[bytes], None]
    """Takes the eight bytes of an answer."""
    timeout_ns: int
    """Longest pause of the client, ns."""


@dataclass(frozen=True, slots=True)
class Target:
    """The object of a transfer."""

    index: int
    """Its index."""
    subindex: int
    """Its sub-index."""


class Transfer(ABC):
    """A transfer of more than one request. Raises Refused to abort.

    Args:
        channel: the server channel.
        target: the object.
        t_ns: when the initiate request was received, ns.
    """

    def __init__(self, channel: Channel, target: Target, t_ns: int) -> None:
        self._channel = channel
        self.target = target
        """The object."""
        self.deadline_ns = t_ns + channel.timeout_ns
        """Time at which :meth:`on_timer` has something to do, ns."""

    @abstractmethod
    def wants(self, request: bytes) -> bool:
        """Return whether a frame of the client belongs to this transfer."""

    @abstractmethod
    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a frame that belongs to the transfer; return whether the transfer is over."""

    def on_timer(self, t_ns: int) -> None:
        """Abort, because the client has paused for too long.

        Raises:
            Refused: always; a transfer with something to send overrides this.
        """
        raise Refused(AbortCode.TIMED_OUT)

    def _await_client(self, t_ns: int) -> None:
        self.deadline_ns = t_ns + self._channel.timeout_ns


class Incoming:
    """A value during its download: collected until it is whole, then stored once.

    Args:
        store: object dictionary.
        target: the object.
        announced: size that the client announced, bytes; None if it did not.

    Raises:
        Refused: if the object cannot be written, or cannot have that size.
    """

    def __init__(self, store: ObjectStore, target: Target, announced: int | None) -> None:
        self._store, self._target = store, target
        self._lengths = store.lengths(target.index, target.subindex)
        self._announced = announced
        if announced is not None:
            self._lengths.check(announced)
        self.data = bytearray()
        """Bytes collected so far."""

    def extend(self, part: bytes) -> None:
        """Add a part.

        Raises:
            Refused: if the value is too long.
        """
        self.data += part
        self._lengths.check_not_above(len(self.data))
        if self._announced is not None and len(self.data) > self._announced:
            raise Refused(AbortCode.TOO_LONG)

    def store(self) -> None:
        """Write the whole value.

        Raises:
            Refused: if it is too short or not allowed.
        """
        if self._announced is not None and len(self.data) < self._announced:
            raise Refused(AbortCode.TOO_SHORT)
        self._store.write(self._target.index, self._target.subindex, bytes(self.data))
