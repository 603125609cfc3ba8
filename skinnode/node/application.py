"""The interface between a CANopen device and its application: the patch, or anything else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from skinnode.node.clock import Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.tpdo import TpdoEngine
from skinnode.node.storage import Storage


class Application(Protocol):
    """The purpose of a device. Its objects are in the dictionary from the start."""

    @property
    def deadline_ns(self) -> int:
        """Time at which :meth:`on_timer` has something to do, ns."""
        ...

    def power_on(self, t_ns: int) -> None:
        """Start, before the boot-up message. A reset does not call this."""
        ...

    def reset(self) -> None:
        """Reset, after the objects have got their defaults."""
        ...

    def enter(self, *, operational: bool) -> None:
        """Follow a change of the NMT state."""
        ...

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """Handle a SYNC in OPERATIONAL. ``turns``: numbers of the synchronous TPDOs that are due."""
        ...

    def on_timer(self, t_ns: int) -> None:
        """Do everything that is due at ``t_ns``."""
        ...


@dataclass(frozen=True, slots=True)
class ApplicationServices:
    """The services of a device that its application uses."""

    store: ObjectStore
    """Object dictionary."""
    storage: Storage
    """Values that survive a power cycle."""
    tpdos: TpdoEngine
    """Transmitter of PDOs."""
    emcy: EmcyProducer
    """Emergency producer."""
    now: Clock
    """Time of the event being handled, ns."""
