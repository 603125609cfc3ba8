"""Compiled stages of a frame before and after the solve.

``start`` and ``choose`` run before the solve, ``accept_roots`` and ``store`` after it. With NumPy calls,
these stages would take longer than solving a patch at rest.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.compiled.jit import njit_part
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.solve.operators.codes import CONVERGED
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.arrays import FrameArrays, SolverArrays

STALE: Final = 2.0
"""Factor by which a weight of a tall system can change before the pseudoinverse J⁺ is recomputed."""
DEADLINE: Final = int(Status.DEADLINE)


@njit_part
def start(solver: SolverArrays, frame: FrameArrays) -> None:
    """Set the starting points to the last trusted positions, and mark all wires as unprocessed."""
    x, start_x, std = frame.x, solver.x, solver.std
    report, measure = solver.report, solver.measure
    for u in range(x.shape[0]):
        for j in range(x.shape[1]):
            start_x[u, j] = x[u, j]
            std[u, j] = math.inf
        for i in range(wires.REPORT):
            report[u, i] = 0
        report[u, wires.STATUS] = DEADLINE
        for i in range(wires.MEASURES):
            measure[u, i] = math.inf
    solver.turn[0] += 1
    tally = solver.tally
    for i in range(tally.size):
        tally[i] = 0


@njit_part
def _stale(weight: Float, before: Float) -> bool:
    stale = False
    for k in range(weight.size):
        stale |= weight[k] > STALE * before[k] or before[k] > STALE * weight[k]
    return stale


@njit_part
def choose(frame: FrameArrays) -> None:
    """Choose the action for each wire: ``first`` if the wire has a usable inverse, otherwise SOLVE.

    The pseudoinverse J⁺ of a tall system is unusable if a weight has changed by more than a factor of
    ``STALE`` since J⁺ was computed.
    """
    predictable, unknowns, todo = frame.predictable, frame.unknowns, frame.todo
    used, weight, first = frame.used, frame.weight_solved, frame.first
    for u in range(todo.size):
        todo[u] = first if predictable[u] else wires.SOLVE
        if 0 < unknowns[u] < used.shape[1] and _stale(used[u], weight[u]):
            todo[u] = wires.SOLVE


@njit_part
def _within_reach(x: Float, rest: Float, clearance: Float) -> bool:
    """Return whether every electrode is within its ``clearance`` (N,) of its rest position."""
    for i in range(clearance.size):
        square = 0.0
        for j in range(3 * i, 3 * i + 3):
            square += (x[j] - rest[j]) ** 2
        if square > clearance[i] * clearance[i]:
            return False
    return True


@njit_part
def accept_roots(solver: SolverArrays, frame: FrameArrays) -> bool:
    """Set ``good`` for each wire with an acceptable root; return whether all wires have one.

    A root is acceptable if every electrode is within its clearance of its rest position and det J has the
    same sign as at rest. Copies the solver's statuses to ``status``.
    """
    report, x, rest = solver.report, solver.x, frame.rest
    branch, clearance = frame.rest_branch, frame.clearance
    good, status = frame.good, frame.status
    every = True
    for u in range(good.size):
        status[u] = report[u, wires.STATUS]
        counts = (
            report[u, wires.STATUS] == CONVERGED
            and report[u, wires.BRANCH] * branch[u] >= 0
            and _within_reach(x[u], rest[u], clearance[u])
        )
        good[u] = counts
        every &= counts
    return every


@njit_part
def store(solver: SolverArrays, frame: FrameArrays) -> bool:
    """Make each good solution the last trusted solution; store the displacements and standard deviations.

    Returns whether the weight of any equation was 0 in a new trusted solution.
    """
    report, good = solver.report, frame.good
    solved_x, solved_a, solved_std = solver.x, solver.a_solved, solver.std
    used, x, a, weight = frame.used, frame.x, frame.a_solved, frame.weight_solved
    predictable, held, rest = frame.predictable, frame.held, frame.rest
    moved_m, std_m, pitch_m = frame.moved_m, frame.std_m, frame.pitch_m
    incomplete = False
    for u in range(good.size):
        held[u] = report[u, wires.HELD] == 1
        if good[u]:
            predictable[u] = 1
        if good[u] and not held[u]:
            for j in range(x.shape[1]):
                x[u, j] = solved_x[u, j]
            for k in range(a.shape[1]):
                a[u, k] = solved_a[u, k]
                weight[u, k] = used[u, k]
                incomplete |= used[u, k] == 0.0
        for j in range(x.shape[1]):
            moved_m[u, j] = (x[u, j] - rest[u, j]) * pitch_m
            std_m[u, j] = solved_std[u, j] * pitch_m
    return incomplete
