"""Recovers wires for which the solver found no acceptable root in a frame.

A wire is recovered in three stages:

- bridge: divide the change in R since the last trusted frame into substeps, and solve them in turn;
- restart: bridge from the rest position instead;
- give up: keep the last trusted position, with an infinite standard deviation and a status other than
  CONVERGED.
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
"""Numbers of substeps in successive bridges.

On the staggered layout (h = 0.5), 3 substeps solved every wire after a press of 50 % of h in a single frame;
5 substeps solved 23 of 24 wires after a press of 70 %. Adaptive substeps that stay on the branch of the rest
position solved fewer wires, because the straight line in R crosses folds that the press avoids.
"""
BRIDGE_TOLERANCE: Final = 1e-6
"""Tolerance of all substeps of a bridge except the last; this is the paper's intermediate tolerance."""
BRIDGE_STEPS: Final = 20
"""Maximum number of solver steps per substep."""
RECOVERY_STEPS: Final = 300
"""Number of solver steps per frame (about 15 ms) above which no further bridge is started.

The limit prevents a corrupt frame from stalling the stream.
"""
# Bridges use Levenberg-Marquardt, which converges most reliably from a distant starting point.
_ACROSS: Final = solve_options(op.LEVENBERG_MARQUARDT, 0, BRIDGE_TOLERANCE, BRIDGE_TOLERANCE, BRIDGE_STEPS)
_LAST: Final = solve_options(op.LEVENBERG_MARQUARDT, TASKS, TOLERANCE, TOLERANCE, BRIDGE_STEPS)


def recover_lost(
    stream: StreamState, frame: Frame, turns: NDArray[np.bool_], exhausted: NDArray[np.bool_]
) -> None:
    """Recover the wires without an acceptable root; update ``good`` and ``status`` of the stream.

    Args:
        stream: State of the stream.
        frame: The current frame.
        turns: (U,) mask of the processed wires; set to False for wires that the deadline interrupts.
        exhausted: (U,) mask of the wires that have no attempts left and are given up.
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
    arrays.predictable &= ~(lost | exhausted)  # the inverses of the other wires remain valid


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
    """Solve wire u in ``substeps`` equal substeps from the resistances ``a_from`` (K,) to those of the frame.

    The outcome of the last substep is in the solver's report. The interpolated resistances do not correspond
    to any deformation of the skin, so the solutions of the other substeps may be on any branch. Returns False
    if the deadline interrupts the bridge.
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
