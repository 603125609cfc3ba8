"""Scans that say which reading they hold."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from skinnode.host.code_watch import Verdict
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame, ResistanceFrame, ScanStamp
from skinnode.model.layout import Float
from skinnode.protocol.scan import Scan
from vcan_sim.sensor import SimulatedPatch

STEP = 1.0 / 65532
"""Of R/R0: one code of 16 bits."""
RANGE = 4000
"""Tags before they come round: one and a half minutes of readings, each one code above the one before."""


class Tags:
    """Readings that are all alike, k codes above the patch at rest in the k-th since a tare, and a look at
    every frame that is solved."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.mixed: list[str] = []
        """What was published of more than one reading."""
        self.seen = 0
        self._sources: dict[int, _Tagged] = {}
        self._looking = threading.Lock()
        solve = ScanSolver.solve

        def look(
            solver: ScanSolver, scan: Scan, stamp: ScanStamp, verdict: Verdict
        ) -> tuple[FieldFrame, int]:
            self._look(solver.decode(verdict.admitted(scan), stamp), solver.facts.baseline_ohm)
            return solve(solver, scan, stamp, verdict)

        monkeypatch.setattr(ScanSolver, "solve", look)

    def wire_up(self, patch: SimulatedPatch) -> _Tagged:
        """A source for the fleet in place of the simulated patch."""
        tagged = self._sources[patch.scene.number] = _Tagged(patch)
        return tagged

    def twin(self, patch: SimulatedPatch) -> _Tagged:
        """A source for another node of the same name, whose readings no other has."""
        return _Tagged(patch, RANGE)

    def taken(self, patch: str) -> int:
        """Readings so far of the patch p0, p1 …"""
        return self._sources[int(patch[1:])].count

    def _look(self, frame: ResistanceFrame, baseline_ohm: Float) -> None:
        ratio = frame.resistance_ohm[frame.valid] / baseline_ohm[frame.valid]
        tags = np.unique(np.rint((ratio - 1.0) / STEP).astype(int))
        stamp, source = frame.stamp, self._sources[int(frame.stamp.patch[1:])]
        with self._looking:
            self.seen += 1
            if len(tags) > 1:
                self.mixed.append(f"{stamp.patch} scan {stamp.scan}: readings {tags.tolist()}")
            elif len(tags) and stamp.device_time_us:
                readings = source.at_64us.get(stamp.device_time_us // 64, set())
                if tags[0] not in readings:
                    self.mixed.append(f"{stamp.patch} scan {stamp.scan}: {tags[0]}, summary of {readings}")


class _Tagged:
    """The resistances of a patch at rest, the tag's part of a code higher with each reading."""

    def __init__(self, patch: SimulatedPatch, offset: int = 0) -> None:
        self._offset = offset
        self._rest_ohm = SimulatedPatch(patch.scene, converter_noise=0.0).read(0)
        self._tare_left = 16  # the node's own at power-on
        self.count = 0
        self.at_64us: dict[int, set[int]] = {}
        """Readings by device time: after a stall of the machine, two may have the same."""

    def read(self, t_ns: int) -> Float:
        if self._tare_left:
            self._tare_left -= 1
            return self._rest_ohm
        self.count += 1
        tag = self._offset + self.count % RANGE
        self.at_64us.setdefault((t_ns // 1000 & 0xFFFF_FFFF) // 64, set()).add(tag)
        return self._rest_ohm * (1.0 + tag * STEP)
