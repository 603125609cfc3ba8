"""Check the codes of each scan for a stopped converter and for faulty wires and crossings.

Before a scan is solved, :meth:`CodeWatch.judge` compares its codes with the previous ones, which takes about
5 µs. The resulting :class:`Verdict` says:

- whether the field can be trusted, given the converter's state (:mod:`skinnode.host.converter_liveness`),
- which frozen crossings are left out of the solve (:mod:`skinnode.host.frozen_parts`),
- which wires are open or shorted.

Later, :meth:`CodeWatch.on_scan` searches for noisy and drifting wires
(:mod:`skinnode.host.noisy_and_drifting_wires`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.host import repeated_codes
from skinnode.host.converter_liveness import Alive, ConverterLiveness
from skinnode.host.frozen_parts import FrozenParts
from skinnode.host.noisy_and_drifting_wires import WireWindows
from skinnode.host.open_and_shorted_wires import WireFault, broken_wires
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.frames import FieldFrame, sealed
from skinnode.protocol.codes import MISSING, CodeScale
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag

_CHANGED_ONLY: Final = int(SummaryFlag.CHANGED_ONLY)


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Result of checking the codes of a scan."""

    distrust: str = ""
    """Human-readable reason for distrusting the scan's field; empty if there is none."""
    faults: tuple[DataFault, ...] = ()
    """Faults found: frozen patch, frozen wires and crossings, open and shorted wires."""
    left_out: NDArray[np.bool_] | None = None
    """(U, K) mask of the crossings to leave out of the solve; None if there are none."""

    def admitted(self, scan: Scan) -> Scan:
        """Return the scan with the crossings in :attr:`left_out` marked as missing."""
        if self.left_out is None:
            return scan
        codes = np.where(self.left_out, np.uint32(MISSING), scan.codes)
        return replace(scan, codes=codes, valid=scan.valid & ~self.left_out)

    def applied(self, field: FieldFrame) -> FieldFrame:
        """Return the scan's field with the faults added.

        If there is a reason for distrust, no wire of the field is trusted.
        """
        if not (self.faults or self.distrust):
            return field
        faults = (*self.faults, *field.faults)
        if not self.distrust:
            return sealed(field, faults=faults)
        words = f"{self.distrust}; {field.distrust}" if field.distrust else self.distrust
        none = np.zeros(len(field.status), np.bool_)
        return sealed(field, faults=faults, distrust=words, wires_trusted=none)


FAULTLESS: Final = Verdict()


class CodeWatch:
    """Fault detector for one patch's scans. Used only by the mainline.

    Args:
        scale: Scale of the codes.
        relative_noise: Converter noise stated in the hand file, relative to the resistance.
    """

    def __init__(self, scale: CodeScale, relative_noise: float) -> None:
        self._scale, self._relative_noise = scale, relative_noise
        self._windows = WireWindows(scale, relative_noise)
        self._life = ConverterLiveness(scale, relative_noise)
        self._parts: FrozenParts | None = None  # the first scan determines the shape
        self._state = repeated_codes.new_runs((0, 0))
        self._found = np.zeros(8, np.int64)
        repeated_codes.compile_kernels()
        self._seen_windows = 0
        self._broken: tuple[WireFault, ...] = ()
        # broken wire, or None for the whole patch -> number of the scan in which the fault was found
        self._since: dict[WireFault | None, int] = {}
        self._verdict = FAULTLESS

    @property
    def alive(self) -> Alive:
        """State of the converter as of the newest scan."""
        return self._life.alive

    @property
    def frozen(self) -> bool:
        """Whether the converter has stopped."""
        return self._life.alive is Alive.NO

    @property
    def words(self) -> str:
        """Human-readable reason to doubt that the converter is running; empty if there is none."""
        return self._life.words

    @property
    def wires(self) -> tuple[WireFault, ...]:
        """Wires that are currently open, shorted, noisy or drifting."""
        broken, unsteady = self._broken, self._windows.wires
        return tuple(sorted({*broken, *unsteady})) if broken or unsteady else ()

    def judge(self, scan: Scan, number: int | None = None) -> Verdict:
        """Check the codes of the next scan before it is solved.

        Args:
            scan: Scan to check.
            number: Scan number to record in new faults; default: the number of ``scan``.
        """
        parts = self._parts
        if parts is None:
            self._state = repeated_codes.new_runs((scan.codes.shape[0], scan.codes.shape[1]))
            parts = self._parts = FrozenParts(self._scale, self._relative_noise, self._state)
        parts.limits[repeated_codes.FRESH] = not scan.flags & _CHANGED_ONLY
        repeated_codes.follow(scan.codes, self._state, parts.limits, self._found)
        measured, changed, returned, largest, reserved, least, released, suspect = self._found.tolist()
        last, run = self._state[repeated_codes.LAST], self._state[repeated_codes.RUN]
        self._life.on_scan(scan, (measured, changed, returned, largest, least), last, run)
        number = scan.scan if number is None else number
        if released:
            parts.release()
        if suspect:
            parts.name(number)
        if self._windows.windows != self._seen_windows:
            self._seen_windows = self._windows.windows
            self._life.measured_noise = self._windows.shown_noise
            parts.assume_noise(self._life.measured_noise, least)
        if reserved or self._broken:
            self._broken = broken_wires(last, self._scale)
        if not (self._broken or parts.faults or self._life.stopped or self._life.doubtful):
            if self._since:
                self._since = {}
            self._verdict = FAULTLESS
            return FAULTLESS
        return self._judgement(parts, number)

    def _judgement(self, parts: FrozenParts, number: int) -> Verdict:
        stopped = self._life.stopped
        now: list[WireFault | None] = [*self._broken, *([None] if stopped else [])]
        self._since = {key: self._since.get(key, number) for key in now}
        faults = [
            DataFault(
                FaultyPart.UPPER if wire.side == "upper" else FaultyPart.LOWER,
                FaultKind(wire.state.value),
                upper=wire.number if wire.side == "upper" else None,
                lower=wire.number if wire.side == "lower" else None,
                since=self._since[wire],
                deviations=math.inf,
            )
            for wire in self._broken
        ]
        if stopped:
            sure = self._life.deviations
            since = self._since[None]
            faults.insert(0, DataFault(FaultyPart.PATCH, FaultKind.FROZEN, since=since, deviations=sure))
        distrust = self._life.words if stopped or self._life.doubtful else ""
        return Verdict(distrust, (*faults, *parts.faults), parts.left_out)

    def on_scan(self, scan: Scan) -> None:
        """Add a scan to the search for noisy and drifting wires.

        Call :meth:`judge` with the same scan first.
        """
        if scan.complete and not scan.flags & _CHANGED_ONLY:
            self._windows.on_scan(scan)
