"""Classes shared by all SDO transfers."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

MULTIPLEXER: Final = struct.Struct("<BHB")
"""First four bytes of an initiate request or response: command, index and sub-index."""
MULTIPLEXER_U32: Final = struct.Struct("<BHBI")
"""Command, index and sub-index, followed by a 32-bit size or abort code."""


@dataclass(frozen=True, slots=True)
class Channel:
    """SDO server channel of a node."""

    store: ObjectStore
    """Object dictionary."""
    send: Callable[[bytes], None]
    """Function that sends a response of eight bytes."""
    timeout_ns: int
    """Maximum time (ns) to wait for a client's next request."""


@dataclass(frozen=True, slots=True)
class Target:
    """Object that a transfer reads or writes."""

    index: int
    """Index of the object."""
    subindex: int
    """Sub-index of the object."""


class Transfer(ABC):
    """Transfer that requires several requests. Its methods raise Refused to abort it.

    Args:
        channel: SDO server channel.
        target: Object to read or write.
        t_ns: Arrival time of the initiate request, in ns.
    """

    def __init__(self, channel: Channel, target: Target, t_ns: int) -> None:
        self._channel = channel
        self.target = target
        """Object to read or write."""
        self.deadline_ns = t_ns + channel.timeout_ns
        """Time (ns) at which :meth:`on_timer` must be called next."""

    @abstractmethod
    def wants(self, request: bytes) -> bool:
        """Return whether a request belongs to this transfer."""

    @abstractmethod
    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a request that belongs to this transfer. Return whether the transfer has ended."""

    def on_timer(self, t_ns: int) -> None:
        """Abort the transfer because it has timed out. Overridden if the transfer has other timer events.

        Raises:
            Refused: Always.
        """
        raise Refused(AbortCode.TIMED_OUT)

    def _await_client(self, t_ns: int) -> None:
        self.deadline_ns = t_ns + self._channel.timeout_ns


class Incoming:
    """Value of a download, received in parts and then written to the object as a whole.

    Args:
        store: Object dictionary.
        target: Object to read or write.
        announced: Size in bytes announced by the client, or None.

    Raises:
        Refused: If the object is not writable or rejects the announced size.
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
            Refused: If the value is too long.
        """
        self.data += part
        self._lengths.check_not_above(len(self.data))
        if self._announced is not None and len(self.data) > self._announced:
            raise Refused(AbortCode.TOO_LONG)

    def store(self) -> None:
        """Write the complete value to the object.

        Raises:
            Refused: If the value is too short or the object rejects it.
        """
        if self._announced is not None and len(self.data) < self._announced:
            raise Refused(AbortCode.TOO_SHORT)
        self._store.write(self._target.index, self._target.subindex, bytes(self.data))
