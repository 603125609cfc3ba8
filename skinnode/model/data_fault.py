"""Faults in the data of a patch: readings that failed a test and are left out of the solution."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class FaultyPart(enum.StrEnum):
    """Part of a patch that a fault affects."""

    CROSSING = "crossing"
    """Crossing of one upper wire and one lower wire."""
    UPPER = "upper wire"
    LOWER = "lower wire"
    PATCH = "patch"


class FaultKind(enum.StrEnum):
    """Kind of fault in the readings."""

    CONTRADICTS = "contradicts the other readings"
    CROSSED = "exchanged with another wire"
    FROZEN = "repeats its codes"
    OPEN = "open"
    SHORT = "short"
    NOISY = "noisy"
    DRIFTING = "drifting"


@dataclass(frozen=True, slots=True)
class DataFault:
    """Faulty readings of a patch, which are left out of the solution."""

    part: FaultyPart
    kind: FaultKind
    upper: int | None = None
    """Number of the upper wire; None if the fault affects all upper wires."""
    lower: int | None = None
    """Number of the lower wire; None if the fault affects all lower wires."""
    since: int = 0
    """Number of the scan in which the fault was found. Without a host, scans are counted from the last reset
    of the tracker.
    """
    deviations: float = 0.0
    """Significance of the fault, in standard deviations of a normal distribution with the same tail
    probability; inf if the fault is certain.
    """

    @property
    def place(self) -> str:
        """Faulty part and its wire numbers, such as ``crossing of upper wire 3 and lower wire 12``."""
        match self.part:
            case FaultyPart.CROSSING:
                return f"crossing of upper wire {self.upper} and lower wire {self.lower}"
            case FaultyPart.UPPER:
                return f"upper wire {self.upper}"
            case FaultyPart.LOWER:
                return f"lower wire {self.lower}"
            case FaultyPart.PATCH:
                return "patch"

    def __str__(self) -> str:
        return f"{self.place}: {self.kind} since scan {self.since}"
