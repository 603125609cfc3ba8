"""Schedule of faults that start and end at given scene times."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from vcan_sim.fault_text import Value

CLOSE_S: Final = 1e-9
"""Tolerance for rounding errors in scene times, in s."""


@dataclass(frozen=True, slots=True)
class TimedFault:
    """Faults of one patch or bus that start and end together."""

    number: int
    """Index of the ``[[faults]]`` table in the scene file."""
    place: str
    """Name of the faulty patch or bus."""
    on_bus: bool
    from_s: float
    """Scene time at which the faults start, in s."""
    to_s: float
    """Scene time at which the faults end, in s; inf if they last until the end of the simulation."""
    values: Mapping[str, Value] = field(hash=False)
    """Values of the faults, by name."""


@dataclass(frozen=True, slots=True)
class FaultSchedule:
    """Scheduled faults of a scene."""

    faults: tuple[TimedFault, ...] = ()
    repeat_s: float | None = None
    """Period of the scene, in s; None if the scene plays once."""

    def active(self, t_s: float) -> tuple[TimedFault, ...]:
        """Return the faults active at a scene time, in the order of the scene file.

        Args:
            t_s: Scene time, in s. At negative scene times, no faults are active.
        """
        if t_s < -CLOSE_S:
            return ()
        at_s = self._within(t_s)
        return tuple(each for each in self.faults if each.from_s - CLOSE_S <= at_s < each.to_s - CLOSE_S)

    def next_change_s(self, t_s: float) -> float | None:
        """Return the next scene time (s) at which a fault starts or ends; None if there is none.

        Args:
            t_s: Current scene time, in s.
        """
        at_s = self._within(t_s) if t_s >= 0.0 else t_s
        times = {time for each in self.faults for time in (each.from_s, each.to_s) if math.isfinite(time)}
        if self.repeat_s is not None:
            times |= {time + self.repeat_s for time in times}
        later = [time for time in times if time > at_s + CLOSE_S]
        return (t_s - at_s) + min(later) if later else None

    def _within(self, t_s: float) -> float:
        """Return the scene time (s) that corresponds to ``t_s`` in the first period of the scene."""
        if self.repeat_s is None:
            return t_s
        at_s = math.fmod(max(t_s, 0.0), self.repeat_s)
        return 0.0 if self.repeat_s - at_s <= CLOSE_S else at_s
