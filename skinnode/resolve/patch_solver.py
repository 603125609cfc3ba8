"""Solves the captured scans of one patch in order, as the host would."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.host.containment import one_line
from skinnode.model.frames import FieldFrame, ResistanceFrame
from skinnode.model.layout import Float
from skinnode.record.journal import facts_of
from skinnode.record.keeping_solver import KeepingSolver
from skinnode.resolve.scan_capture import CapturedFacts, CapturedScan, Place


@dataclass(frozen=True, slots=True)
class SolvedScan:
    """Field of a scan."""

    place: Place
    field: FieldFrame
    resistance: ResistanceFrame


@dataclass(frozen=True, slots=True)
class SolveSummary:
    """Sums over the fields of a patch."""

    fields: int = 0
    untrusted: int = 0
    touched: int = 0
    contacts: int = 0
    deepest_m: float = 0.0
    """Largest displacement into the skin, in m."""
    std_sum_m: float = 0.0
    """Sum, over all fields, of the median standard deviation of z, in m; unknown deviations are left out."""
    known_std: int = 0
    """Number of fields in ``std_sum_m``."""
    cpu_s: float = 0.0
    """CPU time spent on solving, in s."""
    rest_m: tuple[Float, ...] = ()
    """(U, N, 3) electrode positions at rest for each solver, in m."""

    def __add__(self, other: SolveSummary) -> SolveSummary:
        return SolveSummary(
            self.fields + other.fields,
            self.untrusted + other.untrusted,
            self.touched + other.touched,
            self.contacts + other.contacts,
            max(self.deepest_m, other.deepest_m),
            self.std_sum_m + other.std_sum_m,
            self.known_std + other.known_std,
            self.cpu_s + other.cpu_s,
        )


class PatchFields:
    """Fields of a patch. They can be iterated only once.

    Args:
        hand: The hand with the options of the variant.
        patch: Name of the patch.
        captured: Captured facts and scans of the patch, in order.
    """

    def __init__(
        self, hand: HandConfig, patch: str, captured: Iterable[CapturedFacts | CapturedScan]
    ) -> None:
        self._hand, self._patch, self._captured = hand, patch, captured
        self._kept: deque[ResistanceFrame] = deque()
        self._now_ns = 0
        self._summary = SolveSummary()
        self._rest_m: list[Float] = []

    def __iter__(self) -> Iterator[tuple[SolvedScan, int]]:
        """Yield each solved scan with the index of its electrode positions in :attr:`SolveSummary.rest_m`.

        Raises:
            SkinError: The patch cannot be solved with these settings, or solving a scan raised an exception.
        """
        solver: KeepingSolver | None = None
        for item in self._captured:
            if isinstance(item, CapturedFacts):
                solver = self._solver(item)
            elif solver is not None:
                yield self._solved(solver, item), len(self._rest_m) - 1

    def summary(self) -> SolveSummary:
        """Return the summary; complete after the iteration."""
        return replace(self._summary, rest_m=tuple(self._rest_m))

    def _solver(self, item: CapturedFacts) -> KeepingSolver:
        patch = self._hand.patch(self._patch)
        facts = facts_of(item.facts, patch, self._hand.bus(patch.bus))
        try:
            solver = KeepingSolver(facts, self._hand, lambda: self._now_ns, self._kept)
        except ValueError as error:
            raise SkinError(f"cannot be solved with these settings ({error})") from error
        self._rest_m.append(facts.layout.upper_m)
        return solver

    def _solved(self, solver: KeepingSolver, item: CapturedScan) -> SolvedScan:
        self._now_ns, start_s = item.now_ns, time.thread_time()
        try:
            field, _ = solver.solve(item.scan, item.stamp, item.verdict)
        except Exception as error:
            raise SkinError(f"scan {item.stamp.scan}: {one_line(error)}") from error
        self._count(field, time.thread_time() - start_s)
        return SolvedScan(item.place, field, self._kept.popleft())

    def _count(self, field: FieldFrame, cpu_s: float) -> None:
        std_m = float(np.median(field.displacement_std_m[..., 2]))
        known = math.isfinite(std_m)
        self._summary += SolveSummary(
            1,
            int(not field.trusted),
            int(bool(field.touched)),
            len(field.contacts),
            float(-field.displacement_m[..., 2].min()),
            std_m if known else 0.0,
            int(known),
            cpu_s,
        )
