"""What a node keeps over a power cycle.

A memory keeps one :class:`Kept` as a whole: reading gives the last content that was saved, or the one before
it, never a mixture. :mod:`skinnode.node.memory_file` keeps it in a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from skinnode.errors import SkinError


@dataclass(frozen=True, slots=True)
class Parameters:
    """The parameters of a group (CiA 301 v4.2, 7.5.2.13) that differ from their defaults."""

    node_id: int = 0
    """Node-ID when they were saved; COB-IDs that depend on it are relative to it."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Index and sub-index to the bytes of the value."""


@dataclass(frozen=True, slots=True)
class Kept:
    """All values that survive a power cycle."""

    patch: str = ""
    """Sizes and layout of the patch that saved the values. Another patch cannot use them."""
    node_id: int | None = None
    """Node-ID stored by LSS, 1 to 127, or 255 for no node-ID; None if LSS has stored nothing."""
    bit_rate_bps: int | None = None
    """Bit rate stored by LSS, bit/s."""
    communication: Parameters = Parameters()
    """Parameters from 0x1000 to 0x1FFF."""
    application: Parameters = Parameters()
    """Parameters from 0x2000 to 0x9FFF."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) REAL32, ohm: R0 of the last tare; empty before the first."""


class Fault(IntEnum):
    """Reason why a memory, or a part of it, cannot be used. The emergency message carries the value."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """The content belongs to another patch, or has another format."""
    REFUSED = 4
    """The object dictionary no longer allows a parameter."""
    NOT_SAVED = 5
    """A value that is kept without a command could not be saved."""


class MemoryFault(SkinError):
    """A memory without usable content."""

    def __init__(self, fault: Fault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


class Memory(Protocol):
    """The interface of a memory."""

    def load(self) -> Kept | None:
        """Return the content saved last; None if the memory was never used.

        Raises:
            MemoryFault: if the memory has no usable content.
        """

    def save(self, kept: Kept) -> None:
        """Replace the content; on return it is safe.

        Raises:
            OSError: if that fails; the memory then has its old content.
        """


class VolatileMemory:
    """A memory that lasts as long as the object: the non-volatile memory of a simulated board."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """Return the content saved last; None before the first."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """Replace the content."""
        self._kept = kept
