"""Parts shared by all SDO transfers: channel, time-out, and the value collected by a download."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.abort import AbortCode, Refused
from skinnode.node.object_dictionary import ObjectStore

MULTIPLEXER: Final = struct.Struct("<BHB")
"""Command, index and sub-index, which begin an initiate request and its response."""
MULTIPLEXER_U32: Final = struct.Struct("<BHBI")
"""Command, index, sub-index, and four more bytes that hold a size or an abort code."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One SDO server channel."""

    store: ObjectStore
    """Object dictionary."""
    send: Callable[[bytes], None]
    """Function called with the eight bytes of each response."""
    timeout_ns: int
    """Maximum client pause, ns."""


@dataclass(frozen=True, slots=True)
class Target:
    """Object that a transfer reads or writes."""

    index: int
    """Index of the object."""
    subindex: int
    """Sub-index of the object."""


class Transfer(ABC):
    """Transfer that takes more than one request, and raises Refused to abort.

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
        """Time at which :meth:`on_timer` must be called next, ns."""

    @abstractmethod
    def wants(self, request: bytes) -> bool:
        """Return whether a frame from the client belongs to this transfer."""

    @abstractmethod
    def on_request(self, request: bytes, t_ns: int) -> bool:
        """Handle a frame that belongs to the transfer; return whether the transfer is over."""

    def on_timer(self, t_ns: int) -> None:
        """Abort the transfer, because the client has been silent for too long.

        Raises:
            Refused: always; a transfer that sends on a timer overrides this method.
        """
        raise Refused(AbortCode.TIMED_OUT)

    def _await_client(self, t_ns: int) -> None:
        self.deadline_ns = t_ns + self._channel.timeout_ns


class Incoming:
    """Value of a download, collected until it is complete and then stored as a whole.

    Args:
        store: object dictionary.
        target: the object.
        announced: size announced by the client, bytes; None if it announced no size.

    Raises:
        Refused: if the object is not writable or does not accept that size.
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
        """Write the complete value.

        Raises:
            Refused: if the value is too short or not allowed.
        """
        if self._announced is not None and len(self.data) < self._announced:
            raise Refused(AbortCode.TOO_SHORT)
        self._store.write(self._target.index, self._target.subindex, bytes(self.data))
