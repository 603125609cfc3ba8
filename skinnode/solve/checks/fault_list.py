"""Named faults of a stream: which readings are left out, since when, and when they are admitted again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import DataFault
from skinnode.model.layout import Float
from skinnode.solve.checks.explanations import Group

FRAMES: Final = 3
"""Number of frames, among :data:`WITHIN`, in which readings must contradict the others to be named. Not
tuned."""
WITHIN: Final = 10
"""Number of frames within which these must lie."""
ADMIT: Final = 64
"""Number of consecutive frames in which named readings must agree with the field to be admitted again; twice
as many after each relapse. Not tuned."""
AGREE: Final = 3.0
"""RMS difference between a reading and the field, in standard deviations, up to which they agree."""

Mask = NDArray[np.bool_]


def agree(deviation: Float) -> bool:
    """Return whether readings agree with a field from which they differ by ``deviation``, in deviations."""
    return float(np.mean(deviation**2)) <= AGREE**2


@dataclass
class _Named:
    fault: DataFault
    mask: Mask
    agreed: int = 0
    needed: int = ADMIT


class FaultList:
    """Faults of one patch, from frame to frame. Do not share an instance between owners.

    Args:
        shape: Number of upper and lower wires.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self.reset()

    def reset(self) -> None:
        """Forget all faults."""
        self._named: dict[tuple[int | None, int | None], _Named] = {}
        self._seen: dict[tuple[int | None, int | None], list[int]] = {}
        self._needed: dict[tuple[int | None, int | None], int] = {}

    @property
    def faults(self) -> tuple[DataFault, ...]:
        """Named faults, oldest first."""
        return tuple(named.fault for named in self._named.values())

    @property
    def mask(self) -> Mask | None:
        """(U, K) readings of the named faults; None if there are none."""
        if not self._named:
            return None
        found = np.zeros(self._shape, bool)
        for named in self._named.values():
            found |= named.mask
        return found

    def add(self, groups: Sequence[Group], frame: int, scan: int) -> tuple[DataFault, ...]:
        """Record the groups found wrong in a frame; return those that are not named yet as faults.

        Args:
            groups: Groups found wrong.
            frame: Number of the frame.
            scan: Number by which the user knows the frame.
        """
        passing = []
        for group in groups:
            key = group.upper, group.lower
            frames = [old for old in self._seen.get(key, ()) if frame - old < WITHIN]
            self._seen[key] = [*frames, frame]
            deviations = math.sqrt(2.0 * max(group.gain, 0.0))
            fault = DataFault(group.part, group.kind, *key, scan, deviations)
            if len(self._seen[key]) >= FRAMES:
                needed = self._needed[key] = 2 * self._needed.get(key, ADMIT // 2)
                self._named[key] = _Named(fault, group.mask(self._shape), needed=needed)
            else:
                passing.append(fault)
        return tuple(passing)

    def follow(self, deviation: Float, known: Mask) -> None:
        """Admit the readings again that have agreed with the field for long enough.

        Args:
            deviation: (U, K) differences between the readings and the field, in standard deviations.
            known: (U, K) readings that were received.
        """
        for key, named in list(self._named.items()):
            here = named.mask & known
            if not here.any():
                continue
            named.agreed = named.agreed + 1 if agree(deviation[here]) else 0
            if named.agreed >= named.needed:
                del self._named[key]
                self._seen.pop(key, None)
