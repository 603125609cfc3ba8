"""Trust: decides whether a field is trusted and states the reason if it is not.

A field is trusted if all upper wires in use converged, enough readings and upper wires are in use, and no
readings contradict each other. The host also requires the patch to be alive.
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
"""Minimum fraction of usable readings, and of trusted upper wires, in a trusted field. With this limit, the
field of the reference patch is trusted if two upper wires and one lower wire are missing (77 % of the
readings remain), but not if three upper wires are missing (70 %)."""
OF_WIRE: Final = 0.8
"""Minimum fraction of usable readings for a trusted wire."""
CONTRADICTION: Final = (
    "the readings contradict each other, and no faulty wire or crossing explains the contradiction"
)
UNEXAMINED: Final = (
    "the readings seem to contradict each other, and the deadline left no time to examine them"
)
NOISIER: Final = "the readings are noisier than relative_noise states"

Mask = NDArray[np.bool_]


def assess(
    status: Sequence[Status], used: Mask, faults: Sequence[DataFault], *, contradiction: str
) -> tuple[str, Mask]:
    """Return why a field is not trusted, and a mask of its trusted upper wires.

    Args:
        status: (U,) statuses of the upper wires.
        used: (U, K) mask of the readings used in the solve.
        faults: Faults whose readings were left out.
        contradiction: Description of a contradiction between the readings used; empty if there is none.

    Returns:
        The reason (empty if the field is trusted), and a (U,) mask of the trusted upper wires.
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
