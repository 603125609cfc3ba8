"""Keeps the resistances from which each field of a replay was computed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from skinnode.config import HandConfig
from skinnode.host.code_watch import FAULTLESS, Verdict
from skinnode.host.node_facts import NodeFacts
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame, ResistanceFrame, ScanStamp
from skinnode.protocol.scan import Scan


class KeepingSolver(ScanSolver):
    """Solver that keeps the resistances of each solved scan; NaN where a resistance was not used.

    Args:
        facts: Layout, code scale and baseline of the patch.
        hand: The hand.
        now: Function that returns the monotonic time in ns.
        kept: Queue to which the resistances are appended, in the order of the fields; the caller removes
            them.
    """

    def __init__(
        self, facts: NodeFacts, hand: HandConfig, now: Callable[[], int], kept: deque[ResistanceFrame]
    ) -> None:
        super().__init__(facts, hand.solver, now, period_s=hand.sync.period_s)
        self._kept = kept

    def solve(self, scan: Scan, stamp: ScanStamp, verdict: Verdict = FAULTLESS) -> tuple[FieldFrame, int]:
        """Solve a scan and keep its resistances; see :meth:`ScanSolver.solve`."""
        solved = super().solve(scan, stamp, verdict)
        self._kept.append(self.decode(verdict.admitted(scan), stamp))
        return solved
