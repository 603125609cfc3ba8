"""Compiled check of a displacement field for roots that may be wrong."""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import ArrayTable, reader
from skinnode.compiled.jit import njit_brief, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.operators.codes import CONVERGED
from skinnode.solve.wires.stages import DEADLINE

Mask = NDArray[np.bool_]

# Flags that the check returns, combined with bitwise OR
SOME_SUSPECT: Final = 1
SOME_ROUGH: Final = 2


class RootCheck(ArrayTable):
    """Arrays of a root check: the field to check, the limits, and the results."""

    moved_m: Annotated[Float, "U N 3"]
    """Displacement in the frame to check, in m."""
    last_m: Annotated[Float, "U N 3"]
    """Displacement in the previous frame, in m."""
    status: Annotated[Index, "U"]
    held: Annotated[Mask, "U"]
    folded: Annotated[Mask, "U"]
    """Mask of the wires that a press can move across a fold, where two roots merge."""
    whitening: Annotated[Float, "U N N"]
    """Whitening matrix of each wire, from ``Smoothness``."""
    lost: Annotated[Mask, "U"]
    """Output: mask of the wires for which no root was found."""
    unsure: Annotated[Mask, "U"]
    """Output: mask of the solved wires that are in ``folded`` or moved by more than ``jump_m`` since the
    previous frame."""
    rough: Annotated[Mask, "U"]
    """Output: mask of the solved wires that exceed ``rough_limit`` and are farther than ``far_m`` from rest.
    """
    jump_m: float
    far_m: float
    pitch_m: float
    rough_limit: float
    """Limit on a displacement's roughness divided by its Euclidean norm in pitches."""


_read = reader(RootCheck)


@njit_part
def _rougher(moved_m: Float, pitch_m: float, whitening: Float, limit: float) -> bool:
    """Return whether the roughness of the displacement (N, 3) exceeds ``limit`` times its norm in pitches."""
    rough, size = 0.0, 0.0
    for j in range(3):
        for i in range(moved_m.shape[0]):
            size += (moved_m[i, j] / pitch_m) ** 2
            white = 0.0
            for k in range(i + 1):
                white += whitening[i, k] * moved_m[k, j]
            rough += (white / pitch_m) ** 2
    return rough > limit * limit * size


@njit_brief
def check_roots(table: Index) -> int:
    """Compute ``lost``, ``unsure`` and ``rough`` of a :class:`RootCheck`.

    Returns SOME_SUSPECT if any wire is lost or unsure, combined with SOME_ROUGH if any wire is rough.
    """
    check = _read(table)
    moved_m, last_m, status = check.moved_m, check.last_m, check.status
    held, folded, whitening = check.held, check.folded, check.whitening
    lost, unsure, rough = check.lost, check.unsure, check.rough
    jump_m, far_m, pitch_m, limit = check.jump_m, check.far_m, check.pitch_m, check.rough_limit
    found = 0
    for u in range(status.size):
        solved = status[u] == CONVERGED
        lost[u] = not solved and status[u] != DEADLINE
        solved = solved and not held[u]
        jumped = 0.0
        size = 0.0
        for i in range(moved_m.shape[1]):
            for j in range(3):
                jumped = max(jumped, abs(moved_m[u, i, j] - last_m[u, i, j]))
                size = max(size, abs(moved_m[u, i, j]))
        unsure[u] = solved and (folded[u] != 0 or jumped > jump_m)
        rough[u] = solved and size > far_m and _rougher(moved_m[u], pitch_m, whitening[u], limit)
        if lost[u] or unsure[u]:
            found |= SOME_SUSPECT
        if rough[u]:
            found |= SOME_ROUGH
    return found
