"""Detect frozen wires and crossings while the converter is running, and leave them out of the solve.

**Movement.** A crossing is frozen if its code stays constant while the codes of all four neighbours rise, or
all fall, by at least ``CROSSING_LEAD``. A wire is frozen if all its codes stay constant while, at ``LEADS``
or more crossings, the codes of both adjacent wires rise, or both fall, by at least ``WIRE_LEAD``. This change
of the neighbours' codes is called the lead (:mod:`skinnode.host.repeated_codes`). The criteria do not depend
on the converter's noise.

Both limits are based on simulated presses on fault-free patches:

- In 696 presses, the largest lead of a crossing whose code was constant for five scans was 75 codes.
- In 1,800 presses without converter noise, the largest lead of a wire whose codes were constant for one scan
  was 25 codes.

**Noise.** A wire or crossing is also frozen if a running converter would produce its run with a probability
of at most :data:`~skinnode.host.converter_liveness.FALSE_ALARM`. The assumed noise is a tenth of the stated
noise, or half the recently measured noise if that is larger. In addition, at least three quarters of the
other crossings must have runs shorter than a quarter of this run. This second condition prevents false alarms
if the converter has less noise than assumed, because then all crossings repeat their codes.

The solver uses a frozen wire or crossing again as soon as one of its codes changes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.host.converter_liveness import FALSE_ALARM, QUIETER
from skinnode.host.repeat_odds import deviations_of, log_stay
from skinnode.host.repeated_codes import (
    ACROSS,
    ALONG,
    CROSSING,
    LAST,
    LEADS,
    LEAST_RUN,
    LOWER,
    NAMED,
    RUN,
    STEPS,
    UPPER,
)
from skinnode.host.repeated_codes import CROSSING_LEAD as _CROSSING_LEAD
from skinnode.host.repeated_codes import WIRE_LEAD as _WIRE_LEAD
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.protocol.codes import CodeScale

CROSSING_LEAD: Final = 512
"""Minimum lead (codes) of a frozen crossing: seven times the largest lead in 696 simulated presses on
fault-free patches.
"""
WIRE_LEAD: Final = 64
"""Minimum lead (codes) at ``LEADS`` crossings of a frozen wire: 2.5 times the largest lead in 1,800 simulated
presses on fault-free patches.
"""
_NEVER: Final = 2**62
_OTHERS: Final = 0.75
"""Minimum fraction of the other crossings whose runs must be shorter than a quarter of the frozen wire's or
crossing's run.
"""


class FrozenParts:
    """Detector for frozen wires and crossings on one patch. Used only by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, relative to the resistance.
        state: State array of :mod:`skinnode.host.repeated_codes`. The detector sets the array's ``NAMED``
            plane.
    """

    def __init__(self, scale: CodeScale, relative_noise: float, state: NDArray[np.int64]) -> None:
        self._scale, self._stated, self._state = scale, relative_noise / scale.step, state
        self._log_stay = 0.0
        self.faults: tuple[DataFault, ...] = ()
        self.left_out: NDArray[np.bool_] | None = None
        """(U, K) mask of the crossings to leave out of the solve; None if no crossing is frozen."""
        self.limits = np.zeros(7, np.int64)
        self.limits[STEPS] = scale.steps
        self.limits[_WIRE_LEAD], self.limits[_CROSSING_LEAD] = WIRE_LEAD, CROSSING_LEAD
        self.assume_noise(0.0, 0)

    def assume_noise(self, measured: float, least: int) -> None:
        """Set the run lengths at which a wire or crossing may be frozen, based on the assumed noise.

        Args:
            measured: Noise (codes) measured in the recent windows of scans; 0 if not measurable.
            least: Smallest code of a scan. This code has the least noise, because noise is proportional to
                the resistance.
        """
        ratio = max(self._scale.lo + least * self._scale.step, self._scale.step)
        self._log_stay = log_stay(ratio * max(self._stated / QUIETER, 0.5 * measured))
        rows, columns = self._state.shape[1:]
        for limit, codes in ((UPPER, columns), (LOWER, rows), (CROSSING, 1)):
            evidence = -self._log_stay * codes
            needed = -math.log(FALSE_ALARM) / evidence if evidence > 0.0 else math.inf
            self.limits[limit] = max(LEAST_RUN, math.ceil(needed)) if needed < _NEVER else _NEVER

    def release(self) -> None:
        """Remove the faults of wires and crossings whose codes have changed."""
        alive = (self._state[NAMED] != 0) & (self._state[RUN] == 0)
        self._set([fault for fault in self.faults if not alive[_place(fault)].any()])

    def name(self, scan: int) -> None:
        """Add a fault for each wire and crossing found to be frozen.

        Args:
            scan: Number of the newest scan, recorded as the start of the new faults.
        """
        last, run, named = self._state[LAST], self._state[RUN], self._state[NAMED] != 0
        known = (last >= 0) & (last <= self._scale.steps) & ~named
        found = list(self.faults)
        for side, part, lead in ((0, FaultyPart.UPPER, ACROSS), (1, FaultyPart.LOWER, ALONG)):
            for number in range(self._state.shape[1 + side]):
                at = (number, slice(None)) if side == 0 else (slice(None), number)
                log_p = self._wire(known, run, np.abs(self._state[lead]), at, (UPPER, LOWER)[side])
                if log_p is not None:
                    found = [each for each in found if not _lies_on(each, part, number)]
                    found.append(_fault(part, number, scan, log_p))
        taken = np.zeros(known.shape, np.bool_)
        for fault in found:
            taken[_place(fault)] = True
        found += self._crossings(known & ~taken, run, scan)
        self._set(found)

    def _wire(
        self, known: NDArray[np.bool_], run: NDArray[np.int64], lead: NDArray[np.int64], at: Any, limit: int
    ) -> float | None:
        """Return the log probability of a frozen wire's run; None if the wire is not frozen."""
        here = known[at]
        if not here.any() or (least := int(run[at][here].min())) < 1:
            return None
        leads = lead[at][here]
        leads = leads[leads >= WIRE_LEAD]
        moved = -float(np.log(leads).sum()) if leads.size >= LEADS else 0.0
        still = least * int(here.sum()) * self._log_stay
        enough = least >= self.limits[limit] and self._others_change(known, run, at, least)
        if not (leads.size >= LEADS or enough):
            return None
        return min(moved, still if enough else 0.0)

    def _crossings(self, known: NDArray[np.bool_], run: NDArray[np.int64], scan: int) -> Iterator[DataFault]:
        along, across = self._state[ALONG], self._state[ACROSS]
        together = np.where(along * across > 0, np.minimum(np.abs(along), np.abs(across)), 0)
        moved = known & (run >= LEAST_RUN) & (together >= CROSSING_LEAD)
        still = known & (run >= self.limits[CROSSING])
        for u, k in np.argwhere(moved | still).tolist():
            log_p = -2.0 * math.log(together[u, k]) if moved[u, k] else 0.0
            if still[u, k] and self._others_change(known, run, (u, k), int(run[u, k])):
                log_p = min(log_p, int(run[u, k]) * self._log_stay)
            if log_p < 0.0:
                sure = deviations_of(log_p)
                yield DataFault(FaultyPart.CROSSING, FaultKind.FROZEN, u, k, since=scan, deviations=sure)

    def _others_change(self, known: NDArray[np.bool_], run: NDArray[np.int64], at: Any, least: int) -> bool:
        others = known.copy()
        others[at] = False
        return bool(others.any() and (4 * run[others] < least).mean() >= _OTHERS)

    def _set(self, faults: list[DataFault]) -> None:
        self.faults = tuple(faults)
        mask = np.zeros(self._state.shape[1:], np.bool_)
        for fault in faults:
            mask[_place(fault)] = True
        self._state[NAMED] = mask
        self.left_out = mask if faults else None


def _place(fault: DataFault) -> Any:
    """Return the index that selects a fault's crossings in a (U, K) array."""
    return (
        slice(None) if fault.upper is None else fault.upper,
        slice(None) if fault.lower is None else fault.lower,
    )


def _lies_on(fault: DataFault, part: FaultyPart, number: int) -> bool:
    """Return whether a fault concerns a single crossing on the given wire."""
    wire = fault.upper if part is FaultyPart.UPPER else fault.lower
    return fault.part is FaultyPart.CROSSING and wire == number


def _fault(part: FaultyPart, number: int, scan: int, log_p: float) -> DataFault:
    wire = {"upper" if part is FaultyPart.UPPER else "lower": number}
    return DataFault(part, FaultKind.FROZEN, since=scan, deviations=deviations_of(log_p), **wire)
