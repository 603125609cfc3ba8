"""Count each crossing's repeated codes, and measure how far its neighbours' codes move during the run.

The *run* of a crossing is the number of successive scans that have repeated its code. Its *lead* is the
change in its neighbours' codes during the run. There are two leads: one along the upper wire and one along
the lower wire. If both neighbours on the wire have changed in the same direction, the lead is the smaller of
the two changes; otherwise, it is 0. For a crossing at the end of a wire, the two nearest crossings on the
wire serve as neighbours.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_brief, njit_part
from skinnode.protocol.codes import MISSING as _MISSING

LAST, BEFORE, RUN, NAMED, ALONG, ACROSS, _ANCHORS = range(7)
"""Planes of the state array:

- ``LAST``: newest code; -1 before the first code.
- ``BEFORE``: code before the last change; -1 if there is none.
- ``RUN``: run, i.e. number of scans that have repeated the newest code.
- ``NAMED``: nonzero if the crossing, or its wire, has been reported as frozen.
- ``ALONG``, ``ACROSS``: lead along the upper wire and along the lower wire.
- ``_ANCHORS``: first of four planes with the neighbours' codes at the start of the run.
"""
_PLANES: Final = 10

UPPER, LOWER, CROSSING, WIRE_LEAD, CROSSING_LEAD, STEPS, FRESH = range(7)
"""Indices of the limits:

- ``UPPER``, ``LOWER``, ``CROSSING``: minimum run of a possibly frozen upper wire, lower wire or crossing.
- ``WIRE_LEAD``, ``CROSSING_LEAD``: minimum lead of a possibly frozen wire or crossing.
- ``STEPS``: highest code that is a measurement.
- ``FRESH``: 1 if the node sent every code of the scan, 0 if it left out unchanged codes. Runs grow only if
  ``FRESH`` is 1.
"""
MEASURED, CHANGED, RETURNED, LARGEST, RESERVED, LEAST, RELEASED, SUSPECT = range(8)
"""Indices of the results:

- ``MEASURED``: number of codes that are measurements.
- ``CHANGED``: number of changed codes.
- ``RETURNED``: number of codes that have changed back to their value before the last change.
- ``LARGEST``: largest change in a code.
- ``RESERVED``: number of crossings whose newest code is reserved.
- ``LEAST``: smallest code that is a measurement.
- ``RELEASED``: number of crossings reported as frozen whose codes have changed.
- ``SUSPECT``: 1 if another wire or crossing may be frozen, 0 otherwise.
"""

LEAST_RUN: Final = 5
"""Minimum run (scans) of a frozen crossing, wire or patch. A run of 1 is enough for a wire whose neighbours'
codes have moved.
"""
LEADS: Final = 3
"""Minimum number of crossings with a sufficient lead for a wire to count as frozen."""

_Int = NDArray[np.int64]


def new_runs(shape: tuple[int, int]) -> _Int:
    """Return the initial state array, (10, U, K) int64."""
    state = np.zeros((_PLANES, *shape), np.int64)
    state[LAST] = state[BEFORE] = -1
    return state


@njit_brief
def follow(codes: NDArray[np.uint32], state: _Int, limits: _Int, found: _Int) -> None:
    """Update all runs and leads with the codes of a scan.

    Args:
        codes: (U, K) codes; missing codes are ignored.
        state: (10, U, K) state array; updated in place.
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
    """Update the leads. At the start of a run, store the neighbours' codes."""
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
    """Return the index of the first neighbour of wire ``here``."""
    return 1 if here == 0 else here - 1


@njit_part
def _two(here: int, size: int) -> int:
    """Return the index of the second neighbour of wire ``here`` among ``size`` parallel wires."""
    if here == 0:
        return 2
    return size - 3 if here == size - 1 else here + 1


@njit_part
def _set_lead(state: _Int, u: int, k: int, axis: int, a: int, b: int, steps: int) -> None:  # noqa: PLR0913
    """Set the lead of a crossing along one axis, given its two neighbours' codes ``a`` and ``b``."""
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
    """Return whether a crossing's newest code is a measurement and the crossing is not reported as frozen."""
    return bool(0 <= state[LAST, u, k] <= steps and state[NAMED, u, k] == 0)


@njit_part
def _any_crossing(state: _Int, limits: _Int) -> bool:
    """Return whether any crossing may be frozen.

    A repeated code is suspicious if the codes of all four neighbours have moved during the run, or if the run
    is long and most other crossings have much shorter runs.
    """
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
    """Return whether any wire may be frozen.

    A wire with repeated codes is suspicious if the codes of the adjacent wires have moved during the run, or
    if the run is long and most other crossings have much shorter runs.
    """
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
    """Compile :func:`follow`, or load it from the cache, so that the first scan is not delayed."""
    codes = np.zeros((1, 1), np.uint32)
    codes.setflags(write=False)
    follow(codes, new_runs((1, 1)), np.zeros(7, np.int64), np.zeros(8, np.int64))
