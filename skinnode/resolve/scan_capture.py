"""Assembles the scans of a recording with the host's code and stores them for solving later."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from skinnode.config import HandConfig
from skinnode.host.accounting import losses_of_bus, losses_of_stream
from skinnode.host.code_watch import FAULTLESS, Verdict
from skinnode.host.node_facts import NodeFacts
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
from skinnode.model.status import Status
from skinnode.protocol.scan import Scan
from skinnode.record.journal import facts_table
from skinnode.record.replay import Replay
from skinnode.resolve.recording import Recording

Place = tuple[int, int, int]
"""Position of a field in a replay: :attr:`Replay.place`, and the number of the scan at this place.

All scans at a place are from one bus, so the position does not depend on the other buses of a capture.
"""


@dataclass(frozen=True, slots=True)
class CapturedFacts:
    """Facts from which a new solver is created for the following scans of a patch.

    The facts are stored as in a journal. When the facts are rebuilt, patches with the same layout share the
    layout's tables.
    """

    patch: str
    """Name of the patch."""
    facts: dict[str, Any]
    """Result of :func:`~skinnode.record.journal.facts_table`."""


@dataclass(frozen=True, slots=True)
class CapturedScan:
    """Scan to be solved."""

    place: Place
    now_ns: int
    """Replay time at which the scan is solved, on the host's monotonic clock, in ns."""
    scan: Scan
    stamp: ScanStamp
    verdict: Verdict

    @property
    def patch(self) -> str:
        """Name of the patch."""
        return self.stamp.patch


@dataclass(frozen=True, slots=True)
class CaptureSummary:
    """Result of a capture, apart from its scans."""

    flaws: tuple[str, ...]
    """Messages about missing or unreadable parts of the recording."""
    notes: tuple[str, ...]
    """Assumptions made because there is no journal."""
    losses: tuple[str, ...]
    """Messages about lost frames and scans."""


class Capture:
    """Scans from some buses of a recording. They can be iterated only once.

    Args:
        recording: The recording.
        hand: The hand.
        buses: Names of the buses.

    Raises:
        ConfigError: The recording cannot be read.
        SkinError: The files have changed since the command started.
    """

    def __init__(self, recording: Recording, hand: HandConfig, buses: tuple[str, ...]) -> None:
        self._kept: list[CapturedFacts | CapturedScan] = []
        self._place, self._scans = (-1, -1), 0
        self._run = Replay(recording.opened(hand), solver=self._solver, buses=buses)

    def __iter__(self) -> Iterator[CapturedFacts | CapturedScan]:
        for _ in self._run:
            yield from self._taken()
        yield from self._taken()

    def summary(self) -> CaptureSummary:
        """Return the summary; complete after the iteration."""
        losses = [
            *(
                f"{n}: {text}"
                for n, bus in self._run.bus_stats().items()
                for text in losses_of_bus(bus).values()
            ),
            *(
                f"{n}: {text}"
                for n, s in self._run.patch_stats().items()
                for text in losses_of_stream(s).values()
            ),
        ]
        return CaptureSummary(tuple(self._run.flaws), self._run.notes, tuple(losses))

    def _taken(self) -> list[CapturedFacts | CapturedScan]:
        kept, self._kept = self._kept, []
        return kept

    def _solver(self, facts: NodeFacts, hand: HandConfig, now: Callable[[], int]) -> ScanSolver:
        self._kept.append(CapturedFacts(facts.config.name, facts_table(facts, facts.config.layout.build())))
        return _CapturingSolver(facts, self._keep)

    def _keep(self, scan: Scan, stamp: ScanStamp, verdict: Verdict) -> None:
        place = self._run.place
        self._scans = self._scans + 1 if place == self._place else 0
        self._place = place
        self._kept.append(CapturedScan((*place, self._scans), self._run.clock(), scan, stamp, verdict))


class _CapturingSolver(ScanSolver):
    """Stands in for a solver: passes scans on and returns empty fields."""

    def __init__(self, facts: NodeFacts, keep: Callable[[Scan, ScanStamp, Verdict], None]) -> None:
        self.facts = facts  # ScanSolver's tracker is not needed
        self._keep = keep
        shape = facts.layout.upper_m.shape
        zero = np.zeros(shape)
        status = (Status.CONVERGED,) * shape[0]
        self._field = FieldFrame(zero, zero, status, zero[:, 0, 0], SolveStats(0, 0, 0, 0.0))

    def solve(self, scan: Scan, stamp: ScanStamp, verdict: Verdict = FAULTLESS) -> tuple[FieldFrame, int]:
        self._keep(scan, stamp, verdict)
        return self._field, 0
