"""Classes shared by all SDO transfers: channel, base class with a time-out, and value being downloaded."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

MULTIPLEXER: Final = struct.Struct("<BHB")
"""Format of the first four bytes of an initiate request and its response: command, index and sub-index."""
MULTIPLEXER_U32: Final = struct.Struct("<BHBI")
"""Format of a message with command, index, sub-index, and a 32-bit size or abort code."""


@dataclass(frozen=True, slots=True)
class Channel:
    """SDO server channel of a node."""

    store: ObjectStore
    """Object dictionary."""
    send: Callable[[bytes], None]
    """Function that sends a response of eight bytes."""
    timeout_ns: int
    """Maximum interval (ns) between two requests from a client."""


@dataclass(frozen=True, slots=True)
class Target:
    """Index and sub-index of the object that a transfer reads or writes."""

    index: int
    """Index of the object."""
    subindex: int
    """Sub-index of the object."""


class Transfer(ABC):
    """Base class for transfers that consist of several requests. A transfer aborts itself by raising Refused.

    Args:
        channel: SDO server channel.
        target: object to read or write.
        t_ns: time at which the initiate request was received, ns.
    """

    def __init__(self, channel: Channel, target: Target, t_ns: int) -> None:
        self._channel = channel
        self.target = target
        """The object."""
        self.deadline_ns = t_ns + channel.timeout_ns
        """Time (ns) at which :meth:`on_timer` must be called next."""

    @abstractmethod
    def wants(self, request: bytes) -> bool:
        """Return whether a request from the client belongs to this transfer."""

    @abstractmethod
    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Process a request that belongs to this transfer; return whether the transfer has ended."""

    def on_timer(self, t_ns: int) -> None:
        """Abort the transfer, because the client has sent no request before the time-out.

        Raises:
            Refused: always. Transfers that also send frames at timer events override this method.
        """
        raise Refused(AbortCode.TIMED_OUT)

    def _await_client(self, t_ns: int) -> None:
        self.deadline_ns = t_ns + self._channel.timeout_ns


class Incoming:
    """Value of a download, which is received in parts and then written to the object as a whole.

    Args:
        store: object dictionary.
        target: object to read or write.
        announced: size announced by the client, bytes; None if the client announced no size.

    Raises:
        Refused: if the object is not writable or does not accept a value of the announced size.
    """

    def __init__(self, store: ObjectStore, target: Target, announced: int | None) -> None:
        self._store, self._target = store, target
        self._lengths = store.lengths(target.index, target.subindex)
        self._announced = announced
        if announced is not None:
            self._lengths.check(announced)
        self.data = bytearray()
        """Bytes received so far."""

    def extend(self, part: bytes) -> None:
        """Append a part of the value.

        Raises:
            Refused: if the value is too long.
        """
        self.data += part
        self._lengths.check_not_above(len(self.data))
        if self._announced is not None and len(self.data) > self._announced:
            raise Refused(AbortCode.TOO_LONG)

    def store(self) -> None:
        """Write the complete value to the object.

        Raises:
            Refused: if the value is too short or not allowed.
        """
        if self._announced is not None and len(self.data) < self._announced:
            raise Refused(AbortCode.TOO_SHORT)
        self._store.write(self._target.index, self._target.subindex, bytes(self.data))
