"""Fault list: the faults of a stream and the readings left out because of them.

A fault is confirmed if it is found in several frames. The readings of a confirmed fault are left out until
they have agreed with the field for long enough.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import DataFault, FaultKind
from skinnode.model.layout import Float
from skinnode.solve.checks.explanations import Group

FRAMES: Final = 3
"""Number of frames, out of the last :data:`WITHIN`, in which a fault must be found before it is confirmed.
Not tuned."""
WITHIN: Final = 10
"""Number of successive frames in which the detections of a fault are counted."""
ADMIT: Final = 64
"""Number of consecutive frames in which the readings of a confirmed fault must agree with the field before
they are used again. The number doubles each time the fault returns, up to :data:`MOST_ADMIT`. Not tuned."""
MOST_ADMIT: Final = 4096
"""Maximum of this number. Without this limit, the readings of a loose contact would stay unused for hours
after its repair."""
AGREE: Final = 3.0
"""Maximum RMS deviation of readings that agree with a field, in standard deviations."""

Mask = NDArray[np.bool_]


def agree(deviation: Float) -> bool:
    """Return whether readings agree with a field, given their deviations in standard deviations."""
    return float(np.mean(deviation**2)) <= AGREE**2


@dataclass
class _Named:
    fault: DataFault
    mask: Mask
    agreed: int = 0
    needed: int = ADMIT


class FaultList:
    """Faults of one patch, updated frame by frame. Each stream needs its own instance.

    Args:
        shape: Numbers of upper and lower wires.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self.reset()

    def reset(self) -> None:
        """Discard all faults."""
        self._named: dict[tuple[int | None, int | None], _Named] = {}
        self._seen: dict[tuple[int | None, int | None], list[int]] = {}
        self._needed: dict[tuple[int | None, int | None], int] = {}

    @property
    def faults(self) -> tuple[DataFault, ...]:
        """Confirmed faults, oldest first."""
        return tuple(named.fault for named in self._named.values())

    @property
    def mask(self) -> Mask | None:
        """(U, K) mask of the readings with a confirmed fault; None if there are none."""
        if not self._named:
            return None
        found = np.zeros(self._shape, bool)
        for named in self._named.values():
            found |= named.mask
        return found

    def add(self, groups: Sequence[Group], frame: int, scan: int) -> tuple[DataFault, ...]:
        """Record the groups of wrong readings in a frame and return the faults that are not yet confirmed.

        Crossed wires are reported only after confirmation: real ones stay crossed, whereas a press that does
        not yet show in one wire can resemble crossed wires for one frame.

        Args:
            groups: Groups of wrong readings.
            frame: Number of the frame, as counted by the data check.
            scan: Scan number of the frame, to be reported with its faults.
        """
        passing = []
        for group in groups:
            key = group.upper, group.lower
            frames = [old for old in self._seen.get(key, ()) if frame - old < WITHIN]
            self._seen[key] = [*frames, frame]
            deviations = math.sqrt(2.0 * max(group.gain, 0.0))
            fault = DataFault(group.part, group.kind, *key, scan, deviations)
            if len(self._seen[key]) >= FRAMES:
                needed = self._needed[key] = min(2 * self._needed.get(key, ADMIT // 2), MOST_ADMIT)
                self._named[key] = _Named(fault, group.mask(self._shape), needed=needed)
            elif group.kind is not FaultKind.CROSSED:
                passing.append(fault)
        return tuple(passing)

    def follow(self, deviation: Float, known: Mask) -> None:
        """Remove the faults whose readings have agreed with the field for long enough.

        Args:
            deviation: (U, K) deviations of the readings from the field, in standard deviations.
            known: (U, K) mask of the readings whose deviation is known.
        """
        for key, named in list(self._named.items()):
            here = named.mask & known
            if not here.any():
                continue
            named.agreed = named.agreed + 1 if agree(deviation[here]) else 0
            if named.agreed >= named.needed:
                del self._named[key]
                self._seen.pop(key, None)
