"""Faults of a bus, as data, and counts of the injected faults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class BusFaults:
    """Faults of one bus; none by default."""

    seed: int = 1
    """Seed of the random draws."""
    bus_off: bool = False
    """The controller of the nodes is bus-off: the nodes send and receive nothing."""


@dataclass(slots=True)
class InjectedOnBus:
    """Number of times that each fault was injected into one bus."""

    bus_off: int = 0
    """Times that the controller of the nodes went bus-off."""


NO_BUS_FAULTS: Final = BusFaults()
