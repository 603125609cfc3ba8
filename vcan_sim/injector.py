"""Random injection of faults into one simulated node."""

from __future__ import annotations

import numpy as np

from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.tally import Tally


class Injector:
    """Fault injector for one node. It draws faults at random and counts them.

    The random sequence is reproducible: it depends only on the seed, the node-ID and the order of calls. Any
    thread may assign :attr:`faults` at any time.

    Args:
        faults: Initial faults. Their seed remains in use when the faults are replaced.
        node_id: Node-ID. Nodes with the same seed have different random sequences.
    """

    def __init__(self, faults: Faults, node_id: int) -> None:
        self.faults = faults
        self.injected, self.tally = Injected(), Tally()
        self.random = np.random.default_rng([faults.seed, node_id])

    def draw(self, share: float) -> bool:
        """Return True with probability ``share``."""
        return share > 0.0 and bool(self.random.random() < share)

    def draw_one(self, names: tuple[str, ...]) -> str:
        """Select at random the fault that occurs, if any, and return its name; "" if none occurs."""
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
        """Decide at random whether a fault drops a frame, count the fault if so, and return the decision."""
        if fault is None or not self.draw(getattr(self.faults, fault)):
            return False
        self.count(fault)
        return True

    def count(self, fault: str) -> None:
        """Count one occurrence of a fault."""
        setattr(self.injected, fault, getattr(self.injected, fault) + 1)
