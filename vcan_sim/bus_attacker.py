"""Faults that can be injected into a bus, as data, and counts of the injected faults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class BusFaults:
    """Faults of one bus; none by default."""

    seed: int = 1
    """Seed of the random draws of faults."""
    bus_off: bool = False
    """Whether the nodes' controller is bus-off; the nodes then send and receive no frames."""


@dataclass(slots=True)
class InjectedOnBus:
    """Number of times that each fault was injected into one bus."""

    bus_off: int = 0
    """Number of times that the nodes' controller went bus-off."""


NO_BUS_FAULTS: Final = BusFaults()
