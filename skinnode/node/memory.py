"""Non-volatile values of a node, and the interface to the memory that stores them.

A memory saves a :class:`Kept` atomically: if saving is interrupted, it contains either all the old values or
all the new ones. :mod:`skinnode.node.memory_file` implements a memory in a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from skinnode.errors import SkinError


@dataclass(frozen=True, slots=True)
class Parameters:
    """Saved values of a group of parameters (CiA 301 v4.2, 7.5.2.13). Default values are not saved."""

    node_id: int = 0
    """Node-ID at the time of saving. Some saved COB-IDs include it."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Saved bytes, by index and sub-index."""


@dataclass(frozen=True, slots=True)
class Kept:
    """Contents of a memory: the non-volatile values of a node."""

    patch: str = ""
    """Identifier of the patch's dimensions and layout. Other patches must not use the contents."""
    node_id: int | None = None
    """Node-ID stored by LSS, 1 to 127, or 255 for no node-ID; None if LSS has stored nothing."""
    bit_rate_bps: int | None = None
    """Bit rate stored by LSS in bit/s; None if LSS has not stored a bit rate."""
    communication: Parameters = Parameters()
    """Saved communication parameters (0x1000 to 0x1FFF)."""
    application: Parameters = Parameters()
    """Saved application parameters (0x2000 to 0x9FFF)."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) baseline R0 in ohms with REAL32 precision; empty if none has been saved."""


class Fault(IntEnum):
    """Memory fault. The value is the first manufacturer-specific byte of the emergency message."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """The contents belong to another patch or have an unknown format."""
    REFUSED = 4
    """An object rejects its saved value."""
    NOT_SAVED = 5
    """The node could not save a value that it saves automatically, such as the baseline."""


class MemoryFault(SkinError):
    """Raised if a memory has no usable contents."""

    def __init__(self, fault: Fault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


class Memory(Protocol):
    """Interface to a node's non-volatile memory."""

    def load(self) -> Kept | None:
        """Return the contents, or None if nothing has been saved.

        Raises:
            MemoryFault: If the contents are not usable.
        """

    def save(self, kept: Kept) -> None:
        """Replace the contents, and return once a power failure can no longer destroy the new contents.

        Raises:
            OSError: If saving fails. The memory keeps its old contents.
        """


class VolatileMemory:
    """Memory of a simulated board; its contents exist only as long as this object."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """Return the contents, or None if nothing has been saved."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """Replace the contents."""
        self._kept = kept
