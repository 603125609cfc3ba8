"""Interface between a CANopen device and its application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pacing import Clock
from skinnode.node.pdo.tpdo import TpdoEngine
from skinnode.node.storage import Storage


class Application(Protocol):
    """Application of a CANopen device."""

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        ...

    def power_on(self, t_ns: int) -> None:
        """Start the application at power-on, before the boot-up message. Not called on a reset."""
        ...

    def reset(self, *, everything: bool) -> None:
        """Restart the application's communication at power-on and after a reset.

        If ``everything`` is true (at power-on and after *reset node*), reset its state, too; its objects
        already have their power-on values. *Reset communication* keeps them.
        """
        ...

    def enter(self, *, operational: bool) -> None:
        """Handle an NMT state change into or out of OPERATIONAL."""
        ...

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """Handle a SYNC in OPERATIONAL. ``turns`` contains the numbers of the due synchronous TPDOs."""
        ...

    def on_timer(self, t_ns: int) -> None:
        """Perform all actions due at ``t_ns``."""
        ...


@dataclass(frozen=True, slots=True)
class ApplicationServices:
    """Services that a device provides to its application."""

    store: ObjectStore
    """Object dictionary."""
    storage: Storage
    """Storage of the non-volatile values."""
    tpdos: TpdoEngine
    """TPDO engine."""
    emcy: EmcyProducer
    """EMCY producer."""
    now: Clock
    """Function that returns the time (ns) of the event being handled."""
