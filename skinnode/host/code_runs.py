"""Compiled kernel that follows, for each crossing, how often its code has repeated and what moved meanwhile.

A crossing's *run* is the number of times that its code has arrived again without a change. Its *lead* along
the upper wire is the change, since its run began, of the codes of its two neighbours on the same upper wire:
the smaller of the two amounts, with their sign, or 0 if their signs differ. Its lead across is the same for
its neighbours on the same lower wire. At an edge, the two nearest crossings on one side are the neighbours.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_brief, njit_part
from skinnode.protocol.codes import MISSING as _MISSING

LAST, BEFORE, RUN, NAMED, ALONG, ACROSS, _ANCHORS = range(7)
"""Planes of the state: last code (-1 before the first), its predecessor, run, whether the crossing belongs to
a part that was named as frozen, lead along the upper wire, lead across; then four neighbours' codes when the
run began."""
_PLANES: Final = 10

UPPER, LOWER, CROSSING, WIRE_LEAD, CROSSING_LEAD, STEPS, FRESH = range(7)
"""Limits: runs from which an upper wire, a lower wire and a crossing repeat improbably often; leads from
which a crossing counts for its wire, and proves that it is frozen itself; highest code of a measurement;
1 if every code was sent with this scan, 0 if a repeated code is no evidence because unchanged codes were not
sent."""
MEASURED, CHANGED, RETURNED, LARGEST, RESERVED, LEAST, RELEASED, SUSPECT = range(8)
"""Results: number of crossings received and measured, of those that changed, and of those that returned to
the code before; largest change; number of crossings whose last code is reserved; smallest code; number of
named crossings that changed; whether a part that is not named may be frozen."""

LEAST_RUN: Final = 5
"""Minimum run of a frozen crossing, of a part without noise and of a frozen patch, in scans. A wire whose
neighbours have moved needs no more than one."""
LEADS: Final = 3
"""Minimum number of crossings of a frozen wire whose neighbours have moved."""

_Int = NDArray[np.int64]


def new_runs(shape: tuple[int, int]) -> _Int:
    """Return the state (10, U, K) before the first scan."""
    state = np.zeros((_PLANES, *shape), np.int64)
    state[LAST] = state[BEFORE] = -1
    return state


@njit_brief
def follow(codes: NDArray[np.uint32], state: _Int, limits: _Int, found: _Int) -> None:
    """Update the runs with the codes of a scan.

    Args:
        codes: (U, K) codes; a missing code neither repeats nor changes.
        state: (10, U, K) planes; updated.
        limits: (7,) limits.
        found: (8,) results; overwritten.
    """
    rows, columns = codes.shape
    steps, fresh = limits[STEPS], limits[FRESH]
    measured = changed = returned = largest = reserved = released = 0
    least = steps
    for u in range(rows):
        for k in range(columns):
            code, last = np.int64(codes[u, k]), state[LAST, u, k]
            if code == _MISSING:
                reserved += last > steps
                continue
            if code > steps or last < 0 or last > steps:
                reserved += code > steps
                released += state[NAMED, u, k] != 0
                state[LAST, u, k], state[BEFORE, u, k], state[RUN, u, k] = code, -1, 0
                continue
            measured += 1
            least = min(least, code)
            if code == last:
                state[RUN, u, k] += fresh
                continue
            changed += 1
            returned += code == state[BEFORE, u, k]
            released += state[NAMED, u, k] != 0
            largest = max(largest, abs(code - last))
            state[BEFORE, u, k], state[LAST, u, k], state[RUN, u, k] = last, code, 0
    _update_leads(state, steps)
    found[MEASURED], found[CHANGED], found[RETURNED] = measured, changed, returned
    found[LARGEST], found[RESERVED], found[LEAST], found[RELEASED] = largest, reserved, least, released
    found[SUSPECT] = _any_crossing(state, limits) or _any_wire(state, limits)


@njit_part
def _update_leads(state: _Int, steps: int) -> None:
    """Update the leads, and the neighbours' codes at the beginning of each run."""
    rows, columns = state.shape[1], state.shape[2]
    for u in range(rows):
        for k in range(columns):
            if columns > 2:
                one, two = _one(k), _two(k, columns)
                a, b = state[LAST, u, one], state[LAST, u, two]
                _set_lead(state, u, k, 0, a, b, steps)
            if rows > 2:
                one, two = _one(u), _two(u, rows)
                a, b = state[LAST, one, k], state[LAST, two, k]
                _set_lead(state, u, k, 1, a, b, steps)


@njit_part
def _one(here: int) -> int:
    """Return the number of the first neighbour of a wire."""
    return 1 if here == 0 else here - 1


@njit_part
def _two(here: int, size: int) -> int:
    """Return the number of the second neighbour of a wire, among ``size`` wires."""
    if here == 0:
        return 2
    return size - 3 if here == size - 1 else here + 1


@njit_part
def _set_lead(state: _Int, u: int, k: int, axis: int, a: int, b: int, steps: int) -> None:  # noqa: PLR0913
    """Set the lead of a crossing whose neighbours along an axis have the codes ``a`` and ``b``."""
    plane = _ANCHORS + 2 * axis
    lead = 0
    if state[RUN, u, k] == 0:
        state[plane, u, k], state[plane + 1, u, k] = a, b
    else:
        was_a, was_b = state[plane, u, k], state[plane + 1, u, k]
        known = min(min(a, b), min(was_a, was_b)) >= 0 and max(max(a, b), max(was_a, was_b)) <= steps
        if known and a > was_a and b > was_b:
            lead = min(a - was_a, b - was_b)
        elif known and a < was_a and b < was_b:
            lead = max(a - was_a, b - was_b)
    state[ALONG + axis, u, k] = lead


@njit_part
def _counts(state: _Int, u: int, k: int, steps: int) -> bool:
    """Return whether a crossing is measured and does not belong to a named part."""
    return bool(0 <= state[LAST, u, k] <= steps and state[NAMED, u, k] == 0)


@njit_part
def _any_crossing(state: _Int, limits: _Int) -> bool:
    """Return whether a crossing repeats while its neighbours move, or much longer than most others."""
    known = still = longest = 0
    lead = limits[CROSSING_LEAD]
    for u in range(state.shape[1]):
        for k in range(state.shape[2]):
            if not _counts(state, u, k, limits[STEPS]):
                continue
            run, along, across = state[RUN, u, k], state[ALONG, u, k], state[ACROSS, u, k]
            known += 1
            longest = max(longest, run)
            still += 4 * run >= limits[CROSSING]
            if run >= LEAST_RUN and (min(along, across) >= lead or max(along, across) <= -lead):
                return True
    return bool(longest >= limits[CROSSING] and 4 * still <= known)


@njit_part
def _any_wire(state: _Int, limits: _Int) -> bool:
    """Return whether a wire repeats while its neighbours move, or much longer than most crossings."""
    for side in range(2):
        wires, others = state.shape[1 + side], state.shape[2 - side]
        known = still = 0
        likely = False
        for i in range(wires):
            least, leads = -1, 0
            for j in range(others):
                u, k = (i, j) if side == 0 else (j, i)
                if not _counts(state, u, k, limits[STEPS]):
                    continue
                run = state[RUN, u, k]
                known += 1
                still += 4 * run >= limits[side]
                least = run if least < 0 else min(least, run)
                leads += abs(state[ACROSS - side, u, k]) >= limits[WIRE_LEAD]
            if least >= 1 and leads >= LEADS:
                return True
            likely |= least >= limits[side]
        if likely and 4 * still <= known + 4 * others:
            return True
    return False


def compile_kernels() -> None:
    """Compile the kernel, or load it from the cache, before the first scan, whose codes are read-only."""
    codes = np.zeros((1, 1), np.uint32)
    codes.setflags(write=False)
    follow(codes, new_runs((1, 1)), np.zeros(7, np.int64), np.zeros(8, np.int64))
