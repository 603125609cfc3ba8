"""A second try for the wires of a frame that no solve brought to an acceptable root.

bridge     R interpolated from the last trusted frame to the new one, solved substep by substep
restart    the same from the rest position
give up    a wire that still fails keeps its last trusted position, with an infinite deviation and a status
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve.exact.stream import TASKS, TOLERANCE, Frame, StreamState
from skinnode.solve.operators import codes as op
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.arrays import solve_options
from skinnode.solve.wires.stages import DEADLINE

BRIDGES: Final = (3, 5, 10)
"""Substeps of the bridges tried in turn. On staggered, h = 0.5, from rest: 3 bring every wire through
a 50 % press between two frames, 5 all but one of 24 through 70 %. Steps halved and doubled, and held to the
trusted branch, do worse: the straight line crosses singular points that the press does not."""
BRIDGE_TOLERANCE: Final = 1e-6
"""Tolerance of the substeps of a bridge: the paper's intermediate tolerance."""
BRIDGE_STEPS: Final = 20
"""Maximum steps of a substep."""
RECOVERY_STEPS: Final = 300
"""Maximum steps of all bridges of a frame together, about 15 ms: a broken frame must not stop the stream."""
# Levenberg-Marquardt is the sturdiest across a gap, whatever operator the stream has.
_ACROSS: Final = solve_options(op.LEVENBERG_MARQUARDT, 0, BRIDGE_TOLERANCE, BRIDGE_TOLERANCE, BRIDGE_STEPS)
_LAST: Final = solve_options(op.LEVENBERG_MARQUARDT, TASKS, TOLERANCE, TOLERANCE, BRIDGE_STEPS)


def recover_lost(
    stream: StreamState, frame: Frame, turns: NDArray[np.bool_], exhausted: NDArray[np.bool_]
) -> None:
    """Recover the wires that are not at a root; write ``good`` and ``status`` of the stream's arrays.

    Gives up wires that fail, and the ``exhausted`` (U,), for which nothing is left to try. A wire reached
    after the deadline has had no turn: ``turns`` (U,) becomes False.
    """
    solver, arrays = stream.solver, stream.arrays
    good, status = arrays.good, arrays.status
    good[:], status[:] = stream.roots(), solver.report[:, wires.STATUS]
    if good.all():
        return
    status[(status == op.CONVERGED) & ~good] = op.ILL_CONDITIONED
    lost = ~good & (status != DEADLINE) & stream.solvable()
    for u in [u for u in frame.order.tolist() if lost[u] and not exhausted[u]]:
        if frame.expired:
            turns[u], status[u] = False, DEADLINE
            continue
        good[u] = recover(stream, u, frame)
        ended = int(solver.report[u, wires.STATUS])
        status[u] = op.ILL_CONDITIONED if ended == op.CONVERGED and not good[u] else ended
    solver.std[~good] = np.inf
    arrays.predictable &= ~(lost | exhausted)  # what was not tried keeps its inverse


def recover(stream: StreamState, u: int, frame: Frame) -> bool:
    """Bridge wire u from its last trusted position, then from rest; return whether it reached a root."""
    solver, arrays, problem = stream.solver, stream.arrays, stream.problem
    starts = [(arrays.x[u].copy(), arrays.a_solved[u].copy())]
    rest = problem.rest[u], problem.a_rest[u]
    if not np.array_equal(starts[0][0], rest[0]):
        starts.append(rest)
    for substeps in BRIDGES:
        for x_from, a_from in starts:
            if solver.tally[2] >= RECOVERY_STEPS:
                return False
            if not _bridge(stream, u, x_from, a_from, frame, substeps):
                solver.report[u, wires.STATUS] = DEADLINE
                return False
            if stream.roots()[u]:
                return True
    return False


def _bridge(  # noqa: PLR0913 - both ends of the bridge
    stream: StreamState, u: int, x_from: Float, a_from: Float, frame: Frame, substeps: int
) -> bool:
    """Solve wire u along the straight line of its resistances from ``a_from`` (K,) to those of the frame.

    Only the last point counts: the line is no deformation of rubber, so the points between may lie on any
    branch. The outcome is the solver's report of the wire. Returns False if the deadline cut it short.
    """
    todo, a_to = stream.only(u), stream.arrays.a[u]
    between = stream.arrays.a.copy()
    stream.solver.x[u] = x_from
    for part in range(1, substeps):
        if frame.expired:
            return False
        between[u] = a_from + part / substeps * (a_to - a_from)
        stream.solve(todo, frame, a=between, options=_ACROSS)
    if frame.expired:
        return False
    stream.solve(todo, frame, options=_LAST)
    return True
