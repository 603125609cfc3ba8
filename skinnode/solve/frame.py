"""What is done to a frame before and after its solve, compiled. Some thirty NumPy calls on 300 numbers each
took longer than the solve of a patch at rest."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.jit import njit_brief, njit_part
from skinnode.model.layout import Float
from skinnode.solve import wires
from skinnode.solve.inputs import NOISE_MAX
from skinnode.solve.linear import Index
from skinnode.solve.operators import CONVERGED
from skinnode.solve.wires import A_MAX, A_MIN

STALE: Final = 2.0
"""The J⁺ of a tall system is used again while no equation's share of the weights has changed by more."""

Flags = NDArray[np.bool_]


@njit_part
def _take(
    frame_ohm: Float,
    gain: Float,
    noise: Float,
    sigma: float,
    valid: Flags,
    a: Float,
    weight: Float,
    used: Float,
) -> float:
    """A frame (U, K) in the units of the problem: ``a`` = R gain; ``weight`` = σ over the deviation of each
    resistance, 0 where it is not known or not ``valid``; ``used`` the weight, 0 also where ``a`` is no
    resistance. Returns σ, the least deviation known; ``sigma`` where there is none."""
    least = math.inf
    for u in range(a.shape[0]):
        for k in range(a.shape[1]):
            if 0.0 < noise[u, k] < NOISE_MAX:
                least = min(least, noise[u, k])
    if least == math.inf:
        least = sigma
    for u in range(a.shape[0]):
        for k in range(a.shape[1]):
            known = 0.0 < noise[u, k] < NOISE_MAX and valid[u, k]
            weight[u, k] = least / noise[u, k] if known else 0.0
            a[u, k] = frame_ohm[u, k] * gain[u, k]
            used[u, k] = weight[u, k] if A_MIN < a[u, k] < A_MAX else 0.0
    return least


@njit_part
def _clear(
    status: int, x: Float, start: Float, report: Index, measure: Float, std: Float, tally: Index
) -> None:
    """A solver that starts from ``x`` and has nothing to report of any wire but ``status``."""
    for u in range(x.shape[0]):
        for j in range(x.shape[1]):
            start[u, j] = x[u, j]
            std[u, j] = math.inf
        for i in range(wires.REPORT):
            report[u, i] = 0
        report[u, wires.STATUS] = status
        for i in range(wires.MEASURES):
            measure[u, i] = math.inf
    tally[:] = 0


@njit_part
def _stale(weight: Float, before: Float) -> bool:
    stale = False
    for k in range(weight.size):
        stale |= weight[k] > STALE * before[k] or before[k] > STALE * weight[k]
    return stale


@njit_part
def _choose(
    predictable: Flags, first: int, unknowns: Index, used: Float, weight: Float, todo: NDArray[np.uint8]
) -> None:
    """What to do with each wire into ``todo`` (U,): ``first`` where its inverse is that of its position, but
    SOLVE where that is J⁺ of a tall system made for other weights: what it trusted may be noise by now."""
    for u in range(todo.size):
        todo[u] = first if predictable[u] else wires.SOLVE
        if 0 < unknowns[u] < used.shape[1] and _stale(used[u], weight[u]):
            todo[u] = wires.SOLVE


@njit_brief
def begin(
    frame_ohm: Float,
    gain: Float,
    noise: Float,
    sigma: float,
    valid: Flags,
    a: Float,
    weight: Float,
    used: Float,
    status: int,
    x: Float,
    start: Float,
    report: Index,
    measure: Float,
    std: Float,
    tally: Index,
    predictable: Flags,
    first: int,
    unknowns: Index,
    solved_weight: Float,
    todo: NDArray[np.uint8],
) -> float:
    """All that comes before the solve: the frame in the units of the problem, a solver that starts from ``x``
    with nothing to report but ``status``, and what to do with each wire. Returns σ."""
    _clear(status, x, start, report, measure, std, tally)
    least = _take(frame_ohm, gain, noise, sigma, valid, a, weight, used)
    _choose(predictable, first, unknowns, used, solved_weight, todo)
    return least


@njit_brief
def choose(
    predictable: Flags, first: int, unknowns: Index, used: Float, weight: Float, todo: NDArray[np.uint8]
) -> None:
    """What to do with each wire into ``todo`` (U,), as :func:`begin` has it: where electrodes were left out
    since."""
    _choose(predictable, first, unknowns, used, weight, todo)


@njit_part
def _within_reach(x: Float, rest: Float, clearance: Float) -> bool:
    """Whether no electrode is farther from rest than its ``clearance`` (N,)."""
    for i in range(clearance.size):
        square = 0.0
        for j in range(3 * i, 3 * i + 3):
            square += (x[j] - rest[j]) ** 2
        if square > clearance[i] * clearance[i]:
            return False
    return True


@njit_brief
def reach(
    report: Index, x: Float, rest_branch: Index, rest: Float, clearance: Float, good: Flags, status: Index
) -> bool:
    """Whether all wires were brought to a root on the branch of the rest position and within reach; into
    ``good`` (U,) which, and into ``status`` (U,) that of the report."""
    every = True
    for u in range(good.size):
        status[u] = report[u, wires.STATUS]
        good[u] = (
            report[u, wires.STATUS] == CONVERGED
            and report[u, wires.BRANCH] * rest_branch[u] >= 0
            and _within_reach(x[u], rest[u], clearance[u])
        )
        every &= good[u]
    return every


@njit_brief
def finish(
    report: Index,
    good: Flags,
    solved_x: Float,
    solved_a: Float,
    solved_std: Float,
    used: Float,
    x: Float,
    a: Float,
    weight: Float,
    predictable: Flags,
    rest: Float,
    pitch_m: float,
    moved_m: Float,
    std_m: Float,
    held: Flags,
) -> bool:
    """Take over position, ``a`` and weights of the wires that were solved; displacement and deviation (U, 3N)
    of all, and (U,) which were held. Whether a solved wire had an equation without weight: its ``a`` there is
    not known yet."""
    incomplete = False
    for u in range(good.size):
        held[u] = report[u, wires.HELD] == 1
        predictable[u] |= good[u]
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


@njit_part
def _rougher(moved_m: Float, pitch_m: float, whitening: Float, limit: float) -> bool:
    """Whether √(uᵀ C⁻¹ u) of a displacement (N, 3) is above ``limit`` times its length; ``whitening`` (N, N)
    is the inverse of the Cholesky factor of C of one coordinate."""
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
def judge(
    moved_m: Float,
    last_m: Float,
    status: Index,
    held: Flags,
    folded: Flags,
    jump_m: float,
    far_m: float,
    deadline: int,
    pitch_m: float,
    whitening: Float,
    limit: float,
    lost: Flags,
    unsure: Flags,
    rough: Flags,
) -> bool:
    """Into ``lost``, ``unsure`` and ``rough`` (U,): wires without a root, those solved whose root may not be
    the right one (``folded``, or moved by more than ``jump_m`` since ``last_m``), and those solved farther
    than ``far_m`` from rest and rougher than ``limit``. Whether any is
    rough."""
    some = False
    for u in range(status.size):
        solved = status[u] == CONVERGED
        lost[u] = not solved and status[u] != deadline
        solved = solved and not held[u]
        jumped = 0.0
        size = 0.0
        for i in range(moved_m.shape[1]):
            for j in range(3):
                jumped = max(jumped, abs(moved_m[u, i, j] - last_m[u, i, j]))
                size = max(size, abs(moved_m[u, i, j]))
        unsure[u] = solved and (folded[u] or jumped > jump_m)
        rough[u] = solved and size > far_m and _rougher(moved_m[u], pitch_m, whitening[u], limit)
        some |= rough[u]
    return some
