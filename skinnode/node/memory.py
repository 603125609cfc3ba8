"""Values that a node keeps across a power cycle, and the interface of the memory that stores them.

A memory saves a :class:`Kept` as a unit. If saving is interrupted, the memory returns either the old or the
new content, never a mixture. The module :mod:`skinnode.node.memory_file` implements a memory in a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from skinnode.errors import SkinError


@dataclass(frozen=True, slots=True)
class Parameters:
    """Saved parameters of one group (CiA 301 v4.2, 7.5.2.13): those that differ from their defaults."""

    node_id: int = 0
    """Node-ID at the time of saving, to which saved COB-IDs that include a node-ID refer."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Saved bytes of each parameter, by index and sub-index."""


@dataclass(frozen=True, slots=True)
class Kept:
    """Content of a memory: all values that survive a power cycle."""

    patch: str = ""
    """Sizes and layout of the patch that saved the content, which a different patch must not use."""
    node_id: int | None = None
    """Node-ID stored by LSS: 1 to 127, or 255 for no node-ID; None if LSS has not stored a configuration."""
    bit_rate_bps: int | None = None
    """Bit rate stored by LSS, bit/s; None if LSS has not stored a bit rate."""
    communication: Parameters = Parameters()
    """Saved communication parameters (0x1000 to 0x1FFF)."""
    application: Parameters = Parameters()
    """Saved application parameters (0x2000 to 0x9FFF)."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) REAL32, ohm: baseline R0, measured or written by a client; empty if none has been saved."""


class Fault(IntEnum):
    """Fault of a memory; its value is sent in the emergency message."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """The memory's content belongs to another patch or has an unknown format."""
    REFUSED = 4
    """The object dictionary does not accept a saved parameter."""
    NOT_SAVED = 5
    """A value that the node saves without a command, such as the baseline, could not be saved."""


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
        """Replace the saved content, and return as soon as the new content is stored safely.

        Raises:
            OSError: if saving fails; the memory then keeps its old content.
        """


class VolatileMemory:
    """Non-volatile memory of a simulated board, whose content is lost with this object."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """Return the saved content; None if nothing has been saved."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """Replace the saved content."""
        self._kept = kept
