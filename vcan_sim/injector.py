"""Fault injector of one node: current faults, random generator and counts."""

from __future__ import annotations

import numpy as np

from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.tally import Tally


class Injector:
    """Fault injector that draws and counts a node's faults, determined by a seed and the order of calls.

    :attr:`faults` can be replaced at any time from any thread.

    Args:
        faults: Initial faults; their seed remains in use when the faults are replaced.
        node_id: Node-ID, which makes nodes with the same seed draw different faults.
    """

    def __init__(self, faults: Faults, node_id: int) -> None:
        self.faults = faults
        self.injected, self.tally = Injected(), Tally()
        self.random = np.random.default_rng([faults.seed, node_id])

    def draw(self, share: float) -> bool:
        """Return True with probability ``share``."""
        return share > 0.0 and bool(self.random.random() < share)

    def draw_one(self, names: tuple[str, ...]) -> str:
        """Draw at most one fault, each with the probability given by its fraction; return its name, or ""."""
        faults = self.faults
        if faults is NO_FAULTS:
            return ""
        left = self.random.random()
        for name in names:
            left -= getattr(faults, name)
            if left < 0.0:
                return name
        return ""

    def loses(self, fault: str | None) -> bool:
        """Draw whether a fault drops a frame; if so, count the frame."""
        if fault is None or not self.draw(getattr(self.faults, fault)):
            return False
        self.count(fault)
        return True

    def count(self, fault: str) -> None:
        """Count one injection of a fault."""
        setattr(self.injected, fault, getattr(self.injected, fault) + 1)
