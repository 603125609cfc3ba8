"""Trust in a field: the one place that says when a field is trusted, and why not.

A field is trusted if every wire whose readings were used converged, if what was left out can be spared, and
if nothing contradicts the rest. The host adds that the patch must be alive.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import DataFault
from skinnode.model.status import Status

OF_PATCH: Final = 0.75
"""Share of a patch's readings, and of its upper wires, that a trusted field needs. Two upper wires and a
lower wire of the reference patch may be missing (0.77), three upper wires may not (0.7)."""
OF_WIRE: Final = 0.8
"""Share of a wire's readings that a trusted wire needs."""
CONTRADICTION: Final = "the readings contradict each other, and no wire or crossing explains it"
UNEXAMINED: Final = (
    "the readings seem to contradict each other, and the deadline left no time to examine them"
)
NOISIER: Final = "the readings are noisier than stated"

Mask = NDArray[np.bool_]


def assess(
    status: Sequence[Status], used: Mask, faults: Sequence[DataFault], *, contradiction: str
) -> tuple[str, Mask]:
    """Return why a field is not trusted, in words, and which of its wires are.

    Args:
        status: Status of each of the U wires.
        used: (U, K) readings used.
        faults: What was found and left out.
        contradiction: What the readings used still contradict, in words; empty if nothing.

    Returns:
        The reason, empty if the field is trusted, and (U,) wires that are trusted.
    """
    share = used.mean(axis=1)
    converged = np.array([each is Status.CONVERGED for each in status])
    trusted = converged & (share >= OF_WIRE)
    if contradiction:
        return contradiction, np.zeros_like(trusted)
    left_out = np.zeros_like(trusted)
    for fault in faults:
        if fault.upper is not None and fault.lower is None:
            left_out[fault.upper] = True
    failed = [each for u, each in enumerate(status) if each is not Status.CONVERGED and not left_out[u]]
    if failed:
        counts = Counter(each.name for each in failed).most_common()
        parts = ", ".join(f"{count} of {len(status)} wires {name}" for name, count in counts)
        return f"not solved: {parts}", trusted
    if used.mean() < OF_PATCH:
        return f"only {used.mean():.0%} of the readings are usable", trusted
    if trusted.mean() < OF_PATCH:
        return f"only {np.count_nonzero(trusted)} of {len(status)} upper wires are trusted", trusted
    return "", trusted
