"""Interface between a CANopen device and its application, for example a patch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from skinnode.node.clock import Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.tpdo import TpdoEngine
from skinnode.node.storage import Storage


class Application(Protocol):
    """Application of a device. The object dictionary contains the application's objects from the start."""

    @property
    def deadline_ns(self) -> int:
        """Time at which :meth:`on_timer` must be called next, ns."""
        ...

    def power_on(self, t_ns: int) -> None:
        """Start the application before the boot-up message is sent. A reset does not call this method."""
        ...

    def reset(self) -> None:
        """Reset the application; its objects have already been set to their defaults."""
        ...

    def enter(self, *, operational: bool) -> None:
        """Handle a change of the NMT state."""
        ...

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """Handle a SYNC in OPERATIONAL. ``turns``: numbers of the synchronous TPDOs now due."""
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
    """Values that survive a power cycle."""
    tpdos: TpdoEngine
    """TPDO transmitter."""
    emcy: EmcyProducer
    """Emergency producer."""
    now: Clock
    """Time of the event being handled, ns."""
