"""What is done to a frame before and after its solve, compiled. Some thirty NumPy calls on 300 numbers each
took longer than the solve of a patch at rest."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import (
    Bundle,
    byte_matrix,
    byte_vector,
    code_matrix,
    cube,
    int_matrix,
    int_vector,
    matrix,
    vector,
)
from skinnode.compiled.jit import njit_brief, njit_part
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.solve.inputs import NOISE_MAX, CodeMap
from skinnode.solve.linalg.factorisations import Index
from skinnode.solve.operators.steps import CONVERGED
from skinnode.solve.wires import driver as wires
from skinnode.solve.wires.driver import A_MAX, A_MIN
from skinnode.solve.wires.problem import PatchProblem

STALE: Final = 2.0
"""The J⁺ of a tall system is used again while no equation's share of the weights has changed by more."""
DEADLINE: Final = int(Status.DEADLINE)

# The arrays of a frame, by their number in its bundle
(
    CODES,
    BASELINE,
    CODE_GAIN,
    ROUNDING,
    CODE_MAP,
    OHM,
    NOISE,
    VALID,
    GAIN,
    A,
    WEIGHT,
    USED,
    X,
    A_SOLVED,
    WEIGHT_SOLVED,
    PREDICTABLE,
    UNKNOWNS,
    REST,
    REST_BRANCH,
    CLEARANCE,
    GOOD,
    STATUS,
    MOVED,
    STD,
    HELD,
) = range(25)


class FrameArrays:
    """What is known of the stream of a patch and of the frame at hand. Written in place only."""

    def __init__(self, problem: PatchProblem, rest_branch: Index, unknowns: Index) -> None:
        shape, flat = problem.layout.shape, problem.rest.shape
        wires_ = shape[0]
        self.codes = np.zeros(shape, np.uint32)
        self.baseline_ohm, self.code_gain, self.rounding_ohm = np.ones((3, *shape))
        self.code_map = np.zeros(4)
        """R/R0 of code 0, that of a step, the highest code, and the converter's relative noise."""
        self.ohm, self.noise, self.a, self.weight, self.used = np.empty((5, *shape))
        """(U, K) resistance; its relative deviation; a = R gain; σ over the deviation, 0 where there is none
        or the resistance is not valid; the same, 0 also where a is no resistance."""
        self.valid = np.empty(shape, np.bool_)
        self.x = problem.rest.copy()
        """(U, 3N) last trusted position of each wire, pitches."""
        self.a_solved = problem.a_rest.copy()
        """(U, K) its a."""
        self.weight_solved = np.ones(shape)
        """(U, K) at which the inverse of each wire was made."""
        self.predictable = np.zeros(wires_, np.bool_)
        """(U,) wires whose inverse in the solver belongs to their x."""
        self.good = np.empty(wires_, np.bool_)
        """(U,) wires that the solver brought to a root that counts."""
        self.status = np.zeros(wires_, np.int64)
        self.unknowns = unknowns
        """(U,) of each wire."""
        self.outcome_m = np.empty((2, *problem.layout.upper_m.shape))
        """Displacement and its deviation, (2, U, N, 3)."""
        self.held = np.empty(wires_, np.bool_)
        moved, std = self.outcome_m.reshape(2, *flat)
        self._bundle = Bundle(
            [
                self.codes, self.baseline_ohm, self.code_gain, self.rounding_ohm, self.code_map,
                self.ohm, self.noise, self.valid, problem.gain.copy(), self.a, self.weight, self.used,
                self.x, self.a_solved, self.weight_solved, self.predictable, unknowns,
                problem.rest.copy(), rest_branch, problem.clearance.copy(),
                self.good, self.status, moved, std, self.held,
            ]
        )  # fmt: skip
        self.table = self._bundle.table

    def set_codes(self, codes: CodeMap) -> None:
        """What codes stand for from now on."""
        self.baseline_ohm[:], self.rounding_ohm[:] = codes.baseline_ohm, codes.rounding_ohm
        self.code_gain[:] = 1.0 if codes.gain is None else codes.gain
        self.code_map[:] = codes.lo, codes.step, codes.steps, codes.relative_noise


@njit_part
def decode(its: Index) -> int:
    """Codes to resistances and their deviations, NaN where there is none; how many are no measurement. The
    noise is that of the front end and of the codes together."""
    codes, baseline, gain = code_matrix(its, CODES), matrix(its, BASELINE), matrix(its, CODE_GAIN)
    rounding, code_map = matrix(its, ROUNDING), vector(its, CODE_MAP)
    ohm, noise, valid = matrix(its, OHM), matrix(its, NOISE), byte_matrix(its, VALID)
    lo, step, steps, relative = code_map[0], code_map[1], code_map[2], code_map[3]
    invalid = 0
    for u in range(codes.shape[0]):
        for k in range(codes.shape[1]):
            code = float(codes[u, k])
            r0 = baseline[u, k]
            measured = code <= steps and 0.0 < r0 < math.inf
            r = (lo + code * step) * r0 * gain[u, k] if measured else math.nan
            share = rounding[u, k] / r
            ohm[u, k] = r
            noise[u, k] = math.sqrt(relative * relative + share * share)
            valid[u, k] = measured
            invalid += not measured
    return invalid


@njit_part
def take(its: Index, sigma: float) -> float:
    """A frame in the units of the problem: a, weight and used. Returns σ, the least deviation known;
    ``sigma`` where there is none."""
    frame_ohm, gain, noise, valid = (
        matrix(its, OHM),
        matrix(its, GAIN),
        matrix(its, NOISE),
        byte_matrix(its, VALID),
    )
    a, weight, used = matrix(its, A), matrix(its, WEIGHT), matrix(its, USED)
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
def clear(own: Index, its: Index) -> None:
    """A solver that starts from the last trusted position, and of every wire that it had no turn yet."""
    x, start, std = matrix(its, X), matrix(own, wires.X), matrix(own, wires.STD)
    report, measure = int_matrix(own, wires.REPORTS), matrix(own, wires.MEASURE)
    for u in range(x.shape[0]):
        for j in range(x.shape[1]):
            start[u, j] = x[u, j]
            std[u, j] = math.inf
        for i in range(wires.REPORT):
            report[u, i] = 0
        report[u, wires.STATUS] = DEADLINE
        for i in range(wires.MEASURES):
            measure[u, i] = math.inf
    tally = int_vector(own, wires.TALLY)
    for i in range(tally.size):
        tally[i] = 0


@njit_part
def _stale(weight: Float, before: Float) -> bool:
    stale = False
    for k in range(weight.size):
        stale |= weight[k] > STALE * before[k] or before[k] > STALE * weight[k]
    return stale


@njit_part
def choose(its: Index, first: int, todo: NDArray[np.uint8]) -> None:
    """What to do with each wire into ``todo`` (U,): ``first`` where its inverse is that of its position, but
    SOLVE where that is J⁺ of a tall system made for other weights: what it trusted may be noise by now."""
    predictable, unknowns = byte_vector(its, PREDICTABLE), int_vector(its, UNKNOWNS)
    used, weight = matrix(its, USED), matrix(its, WEIGHT_SOLVED)
    for u in range(todo.size):
        todo[u] = first if predictable[u] else wires.SOLVE
        if 0 < unknowns[u] < used.shape[1] and _stale(used[u], weight[u]):
            todo[u] = wires.SOLVE


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


@njit_part
def reach(own: Index, its: Index) -> bool:
    """Whether all wires were brought to a root on the branch of the rest position and within reach; into
    ``good`` (U,) which, and into ``status`` (U,) what the solver says."""
    report, x, rest = int_matrix(own, wires.REPORTS), matrix(own, wires.X), matrix(its, REST)
    branch, clearance = int_vector(its, REST_BRANCH), matrix(its, CLEARANCE)
    good, status = byte_vector(its, GOOD), int_vector(its, STATUS)
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
def finish(own: Index, its: Index, pitch_m: float) -> bool:
    """Take over position, a and weights of the wires that were solved; displacement and deviation of all, and
    which were held. Whether a solved wire had an equation without weight: its a there is not known yet."""
    report, good = int_matrix(own, wires.REPORTS), byte_vector(its, GOOD)
    solved_x, solved_a, solved_std = matrix(own, wires.X), matrix(own, wires.A_SOLVED), matrix(own, wires.STD)
    used, x, a, weight = matrix(its, USED), matrix(its, X), matrix(its, A_SOLVED), matrix(its, WEIGHT_SOLVED)
    predictable, held, rest = byte_vector(its, PREDICTABLE), byte_vector(its, HELD), matrix(its, REST)
    moved_m, std_m = matrix(its, MOVED), matrix(its, STD)
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


# The arrays of a judgement, by their number in its bundle
J_MOVED, J_LAST, J_STATUS, J_HELD, J_FOLDED, J_WHITENING, J_LOST, J_UNSURE, J_ROUGH = range(9)

# What a judgement may find, or-ed together
SOME_DOUBT: Final = 1
SOME_ROUGH: Final = 2


@njit_brief
def judge(its: Index, jump_m: float, far_m: float, pitch_m: float, limit: float) -> int:
    """Into ``lost``, ``unsure`` and ``rough`` (U,): wires without a root, those solved whose root may not be
    the right one (``folded``, or moved by more than ``jump_m`` since ``last``), and those solved farther than
    ``far_m`` from rest and rougher than ``limit``. Returns whether there is any."""
    moved_m, last_m, status = cube(its, J_MOVED), cube(its, J_LAST), int_vector(its, J_STATUS)
    held, folded, whitening = byte_vector(its, J_HELD), byte_vector(its, J_FOLDED), cube(its, J_WHITENING)
    lost, unsure, rough = byte_vector(its, J_LOST), byte_vector(its, J_UNSURE), byte_vector(its, J_ROUGH)
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
            found |= SOME_DOUBT
        if rough[u]:
            found |= SOME_ROUGH
    return found
