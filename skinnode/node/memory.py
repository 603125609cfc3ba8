"""Values that survive a node's power cycle, and the interface of the memory that stores these values.

A memory saves a :class:`Kept` atomically. After an interrupted save, the memory contains either the complete
old values or the complete new values. The module :mod:`skinnode.node.memory_file` implements a memory in a
file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from skinnode.errors import SkinError


@dataclass(frozen=True, slots=True)
class Parameters:
    """Saved values of a parameter group (CiA 301 v4.2, 7.5.2.13). Default values are not saved."""

    node_id: int = 0
    """Node-ID of the node when the parameters were saved; some saved COB-IDs include this node-ID."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Saved bytes of each parameter, by index and sub-index."""


@dataclass(frozen=True, slots=True)
class Kept:
    """Content of a memory: all values that survive a power cycle."""

    patch: str = ""
    """Text that identifies the sizes and layout of the patch. Other patches must not use this content."""
    node_id: int | None = None
    """Node-ID stored by LSS: 1 to 127, or 255 for no node-ID; None if LSS has not stored a configuration."""
    bit_rate_bps: int | None = None
    """Bit rate stored by LSS, bit/s; None if LSS has not stored a bit rate."""
    communication: Parameters = Parameters()
    """Saved communication parameters (0x1000 to 0x1FFF)."""
    application: Parameters = Parameters()
    """Saved application parameters (0x2000 to 0x9FFF)."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) baseline R0 with REAL32 precision, ohm; empty if no baseline has been saved."""


class Fault(IntEnum):
    """Fault of a memory; the numeric value is the first detail byte of the emergency message."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """The memory's content belongs to another patch or has an unknown format."""
    REFUSED = 4
    """The object dictionary does not accept a saved parameter."""
    NOT_SAVED = 5
    """The node failed to save a value that it saves automatically, such as the baseline."""


class MemoryFault(SkinError):
    """Error raised if a memory has no usable content."""

    def __init__(self, fault: Fault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


class Memory(Protocol):
    """Interface of a node's non-volatile memory."""

    def load(self) -> Kept | None:
        """Return the saved content; None if nothing has been saved.

        Raises:
            MemoryFault: if the memory has no usable content.
        """

    def save(self, kept: Kept) -> None:
        """Replace the saved content, and return when the new content would survive a power failure.

        Raises:
            OSError: if saving fails; the memory then keeps its old content.
        """


class VolatileMemory:
    """Non-volatile memory of a simulated board. The content exists only as long as this object."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """Return the saved content; None if nothing has been saved."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """Replace the saved content."""
        self._kept = kept
