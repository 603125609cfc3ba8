"""Define wire faults, and detect open and shorted wires in a scan."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.codes import CodeScale


class WireState(enum.StrEnum):
    """Type of wire fault."""

    OPEN = "open"
    SHORT = "short"
    NOISY = "noisy"
    DRIFTING = "drifting"


@dataclass(frozen=True, slots=True, order=True)
class WireFault:
    """Fault of one upper or lower wire."""

    side: str
    """``upper`` or ``lower``."""
    number: int
    state: WireState


def broken_wires(codes: NDArray[Any], scale: CodeScale) -> tuple[WireFault, ...]:
    """Return the wires whose crossings are all open or all shorted.

    Args:
        codes: (U, K) codes of one scan.
        scale: Mapping of R/R0 to codes.
    """
    found = []
    for state, code in ((WireState.OPEN, scale.open), (WireState.SHORT, scale.short)):
        is_so = codes == code
        for side, axis in (("upper", 1), ("lower", 0)):
            found += [WireFault(side, int(i), state) for i in np.flatnonzero(is_so.all(axis=axis))]
    return tuple(sorted(found))
