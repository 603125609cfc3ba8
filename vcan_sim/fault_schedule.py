"""Faults that start and end at times of a scene, as pure data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from vcan_sim.fault_text import Value

CLOSE_S: Final = 1e-9
"""Largest rounding error of a scene time, s: a fault whose start is that near is active."""


@dataclass(frozen=True, slots=True)
class TimedFault:
    """Faults of one patch or bus from one time to another."""

    number: int
    """Position among the ``[[faults]]`` of the scene."""
    place: str
    """Name of the patch or bus."""
    on_bus: bool
    start_s: float
    """Scene time of the start, s."""
    end_s: float
    """Scene time of the end, s; infinity if the fault does not end."""
    values: Mapping[str, Value] = field(hash=False)
    """Values of the faults, by name."""


@dataclass(frozen=True, slots=True)
class FaultSchedule:
    """Faults of a scene."""

    faults: tuple[TimedFault, ...] = ()
    repeat_s: float | None = None
    """Period of the scene, s; None if it plays once."""

    def active(self, t_s: float) -> tuple[TimedFault, ...]:
        """Return the faults that are active at a scene time, in the order of the scene.

        Args:
            t_s: Scene time, s; before 0 nothing is active.
        """
        if t_s < -CLOSE_S:
            return ()
        at_s = self._within(t_s)
        return tuple(each for each in self.faults if each.start_s - CLOSE_S <= at_s < each.end_s - CLOSE_S)

    def next_change_s(self, t_s: float) -> float | None:
        """Return the scene time of the first start or end after a time, s; None if there is none.

        Args:
            t_s: Scene time, s.
        """
        at_s = self._within(t_s) if t_s >= 0.0 else t_s
        times = {time for each in self.faults for time in (each.start_s, each.end_s) if math.isfinite(time)}
        if self.repeat_s is not None:
            times |= {time + self.repeat_s for time in times}
        later = [time for time in times if time > at_s + CLOSE_S]
        return (t_s - at_s) + min(later) if later else None

    def _within(self, t_s: float) -> float:
        """Return a scene time within the first period."""
        if self.repeat_s is None:
            return t_s
        at_s = math.fmod(max(t_s, 0.0), self.repeat_s)
        return 0.0 if self.repeat_s - at_s <= CLOSE_S else at_s
