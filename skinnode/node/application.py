"""Interface between a CANopen device and its application, such as the patch application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from skinnode.node.clock import Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.tpdo import TpdoEngine
from skinnode.node.storage import Storage


class Application(Protocol):
    """Application of a CANopen device, which shares the device's object dictionary."""

    @property
    def deadline_ns(self) -> int:
        """Time (ns) at which :meth:`on_timer` must be called next."""
        ...

    def power_on(self, t_ns: int) -> None:
        """Start the application at power-on, before the boot-up message.

        The device does not call this method on a reset.
        """
        ...

    def reset(self) -> None:
        """Reset the application.

        The device has already set the application's objects to their power-on values.
        """
        ...

    def enter(self, *, operational: bool) -> None:
        """Handle a change of the NMT state; ``operational`` is true if the new state is OPERATIONAL."""
        ...

    def on_sync(self, counter: int | None, turns: frozenset[int], t_ns: int) -> None:
        """Handle a SYNC in OPERATIONAL; ``turns`` contains the numbers of the synchronous TPDOs to send."""
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
    """Storage of the values that survive a power cycle."""
    tpdos: TpdoEngine
    """Transmitter of all TPDOs."""
    emcy: EmcyProducer
    """Emergency producer."""
    now: Clock
    """Function that returns the time (ns) of the event being handled."""
