"""Values that a node keeps across a power cycle.

A memory stores one :class:`Kept` as a unit. Reading returns the content of either the last save or the one
before it, never a mixture. :mod:`skinnode.node.memory_file` stores the content in a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from skinnode.errors import SkinError


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of a group (CiA 301 v4.2, 7.5.2.13) that differ from their defaults."""

    node_id: int = 0
    """Node-ID at the time of saving; saved COB-IDs that include the node-ID are relative to it."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Bytes of each value, by index and sub-index."""


@dataclass(frozen=True, slots=True)
class Kept:
    """All values that survive a power cycle."""

    patch: str = ""
    """Sizes and layout of the patch that saved the values. A different patch cannot use the values."""
    node_id: int | None = None
    """Node-ID stored by LSS, 1 to 127, or 255 for no node-ID; None if LSS has not stored anything."""
    bit_rate_bps: int | None = None
    """Bit rate stored by LSS, bit/s; None if LSS has not stored one."""
    communication: Parameters = Parameters()
    """Parameters from 0x1000 to 0x1FFF."""
    application: Parameters = Parameters()
    """Parameters from 0x2000 to 0x9FFF."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) REAL32, ohm: R0 from the last tare; empty before the first tare."""


class Fault(IntEnum):
    """Reason why a memory is wholly or partly unusable; its value is sent in the emergency message."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """The content belongs to another patch or has an unknown format."""
    REFUSED = 4
    """The object dictionary no longer allows a parameter."""
    NOT_SAVED = 5
    """A value that is saved automatically, without a command, could not be saved."""


class MemoryFault(SkinError):
    """Error raised if the content of a memory is not usable."""

    def __init__(self, fault: Fault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


class Memory(Protocol):
    """Interface of a memory."""

    def load(self) -> Kept | None:
        """Return the last saved content; None if nothing has ever been saved.

        Raises:
            MemoryFault: if the memory has no usable content.
        """

    def save(self, kept: Kept) -> None:
        """Replace the content; return once it is safely stored.

        Raises:
            OSError: if saving fails; the memory then still has its old content.
        """


class VolatileMemory:
    """Memory whose content lasts as long as this object: the non-volatile memory of a simulated board."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """Return the last saved content; None if nothing was saved."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """Replace the content."""
        self._kept = kept
