"""Contact regions: assignment of a patch's loaded cells to contacts.

The load sum of a cell is the sum of the pressing loads in its 3 × 3 neighbourhood. A peak is a local maximum
of the load sum. The cells are visited in order of decreasing load sum, and each is added to the area of a
neighbouring peak. Where two areas meet, their peaks stay separate contacts only if the load sum between them
is much smaller than at both peaks, and the difference is significant (topological persistence).

If the loads are expected in discs that form several groups, and the skin rises between the groups, the cells
of each group are an area from the beginning: the load sums of bodies close to each other have a single peak.

A peak is a contact if its load sum, the χ² of the loads of the same cells, or the sum of the loads over its
area is significant. The strongest peak is also a contact if the skin there is significantly indented. Such an
indentation indicates a touch even if the loads cannot be located. A group of discs is a contact if it
increases the evidence of the frame.

Only cells with an electrode are tested. The loads on cells beyond the outermost electrodes are ambiguous,
because a small load nearby and a large load farther away cause nearly the same displacement. Cells beyond the
outermost electrodes are added to the adjacent contact.

The thresholds have hysteresis, so that noise does not make contacts appear and disappear. A contact splits in
two, or two contacts merge, only if the load sum between the peaks changes by a third.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index

SIGNIFICANT: Final = 5.0
"""Minimum load of a contact, in standard deviations. In about one frame in ten thousand, noise alone makes
one of the 100 load sums exceed this limit."""
SIGNIFICANT_STILL: Final = 4.0
"""Value of :data:`SIGNIFICANT` for a contact that existed in the last frame."""
BLOCK_EXTRA: Final = 22.0
"""Amount by which the χ² of the nine loads around a peak must exceed the squared significance threshold. With
nine degrees of freedom, χ² exceeds 25 + 22 as rarely as a normal variable exceeds five standard
deviations."""
PRESSED: Final = 6.0
"""Minimum skin indentation at the strongest peak for it to count as a contact, in standard deviations."""
PRESSED_STILL: Final = 5.0
"""Value of :data:`PRESSED` for a contact that existed in the last frame."""
RELEVANT: Final = 0.2
"""Minimum load sum of a contact, as a fraction of the strongest contact's load sum. Errors in the load
estimate next to a contact reach a tenth of the contact's load sum."""
RELEVANT_STILL: Final = 0.15
"""Value of :data:`RELEVANT` for a contact that existed in the last frame."""
PART: Final = 0.1
"""Minimum load sum of a cell in a contact, as a fraction of the load sum at the peak."""
PART_SIGNIFICANT: Final = 3.0
"""Minimum load sum of a cell in a contact, in standard deviations of the peak's load sum. Without this limit,
noise shifts the centre of a very light touch by up to a pitch."""
PART_MOST: Final = 0.6
"""Load sum, as a fraction of the load sum at the peak, above which a cell is part of the contact even if it
does not reach :data:`PART_SIGNIFICANT`."""
GAP: Final = 0.5
"""Maximum load sum between two contacts, as a fraction of the load sum at the smaller peak. In
``tests/solve/test_contact_number.py``, no single body was split with limits from 0.4 to 0.6. With 0.75,
plates at the edge of the patch were split. With 0.5, two spheres are separated if they are at least 5 pitches
apart."""
GAP_ONE: Final = 0.4
"""Value of :data:`GAP` for two peaks that belonged to the same contact in the last frame."""
GAP_TWO: Final = 0.6
"""Value of :data:`GAP` for two peaks that belonged to different contacts in the last frame."""
LEVEL: Final = 0.8
"""Maximum depth of the skin between two contacts, relative to the smaller depth at their peaks. Between two
bodies, the skin rises; under a plate, whose loads are largest at its border, it does not. Not tuned."""
RELEVANT_GROUP: Final = 0.05
"""Value of :data:`RELEVANT` for a contact in a group of discs of its own. The evidence for the group shows
that its loads are not an error of the loads nearby."""
EVIDENT: Final = 12.0
"""Gain in log evidence due to a group of discs, in nats, above which the group is a contact. In 1,500
untouched frames at a noise of 1e-3, discs gained at most 6 nats."""
GAP_SIGNIFICANT: Final = 3.0
"""Minimum difference between the load sum at the smaller of two peaks and the load sum between the peaks, in
standard deviations, for the peaks to be separate contacts."""


RegionScratch = tuple[
    Float, Float, Float, Float, Float, Index, Index, Index, Index, Index, Index, NDArray[np.bool_]
]


def region_scratch(cells: int) -> RegionScratch:
    """Return the work arrays of :func:`find_regions` for a lattice of ``cells`` cells."""
    return (
        np.empty(cells), np.ones(cells), np.empty((9, 9)), np.empty(9), np.empty(18),
        np.empty(cells, np.int64), np.empty(cells, np.int64), np.empty(cells, np.int64),
        np.empty(cells, np.int64), np.empty(9, np.int64), np.empty(27, np.int64),
        np.empty((cells, cells), np.bool_),
    )  # fmt: skip


@njit_part
def _variance(  # noqa: PLR0913 - a kernel: loads and their posterior by name
    cells: Index, signs: Float, count: int, rows: Float, weight: Float, share: Float, scale2: float
) -> float:
    """Return the posterior variance of Σ ``signs`` q, for the normal loads q of ``cells``."""
    own, seen = 0.0, 0.0
    for c in range(count):
        own += signs[c] * signs[c] * share[cells[c]]
    for i in range(rows.shape[0]):
        row, value = rows[i], 0.0
        for c in range(count):
            value += signs[c] * share[cells[c]] * row[3 * cells[c] + 2]
        seen += weight[i] * value * value
    return max(scale2 * (own - scale2 * seen), 1e-300)


@njit_part
def _block_chi2(  # noqa: PLR0913, C901 - a kernel: loads and their posterior by name, sums as loops
    cells: Index,
    count: int,
    press: Float,
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    s: Float,
    b: Float,
) -> float:
    """Return χ² = qᵀ Σ⁻¹ q for the normal loads q of up to nine cells with posterior covariance Σ.

    ``s`` (9, 9) and ``b`` (9,) are work arrays.
    """
    for c in range(count):
        for d in range(count):
            s[c, d] = 0.0
    for i in range(rows.shape[0]):
        row, w = rows[i], weight[i]
        for c in range(count):
            b[c] = scale2 * share[cells[c]] * row[3 * cells[c] + 2]
        for c in range(count):
            for d in range(c + 1):
                s[c, d] -= w * b[c] * b[d]
    for c in range(count):
        s[c, c] = max(s[c, c] + scale2 * share[cells[c]], 1e-9 * scale2 * share[cells[c]])
    chi2 = 0.0
    for c in range(count):  # compute the Cholesky factor L of Σ, and L⁻¹ q, row by row
        value = press[cells[c]]
        for d in range(c):
            entry = s[c, d]
            for e in range(d):
                entry -= s[c, e] * s[d, e]
            s[c, d] = entry / s[d, d]
            value -= s[c, d] * b[d]
        pivot = s[c, c]
        for e in range(c):
            pivot -= s[c, e] * s[c, e]
        s[c, c] = math.sqrt(max(pivot, 1e-9 * scale2 * share[cells[c]]))
        b[c] = value / s[c, c]
        chi2 += b[c] * b[c]
    return chi2


@njit_part
def _box(cell: int, near: Index, own: NDArray[np.bool_], out: Index) -> int:
    """Write those of ``cell`` and its neighbours that have an electrode into ``out``; return their number."""
    count = 0
    for i in near[cell]:
        if i >= 0 and own[i]:
            out[count] = i
            count += 1
    return count


@njit_part
def _apart(  # noqa: PLR0913 - a kernel: loads and their posterior by name
    peak: int,
    other: int,
    between: int,
    total: Float,
    depth_m: Float,
    before: Index,
    near: Index,
    own: NDArray[np.bool_],
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    cells: Index,
    signs: Float,
) -> bool:
    """Return whether ``peak`` and the smaller peak ``other`` belong to different contacts.

    ``between`` is a cell between them. ``cells`` (27,) and ``signs`` (18,) are work arrays.
    """
    gap = GAP
    if before[peak] > 0 and before[other] > 0:
        gap = GAP_ONE if before[peak] == before[other] else GAP_TWO
    if depth_m[between] > LEVEL * min(depth_m[peak], depth_m[other]):
        return False
    fall = total[other] - total[between]
    if not total[between] < gap * total[other]:
        return False
    count = _box(other, near, own, cells)
    for c in range(count):
        signs[c] = 1.0
    part = cells[18:]
    for c in range(_box(between, near, own, part)):
        known = False
        for d in range(count):
            if cells[d] == part[c]:
                signs[d] -= 1.0
                known = True
        if not known:
            cells[count], signs[count] = part[c], -1.0
            count += 1
    variance = _variance(cells, signs, count, rows, weight, share, scale2)
    certain: bool = fall * fall > GAP_SIGNIFICANT * GAP_SIGNIFICANT * variance
    return certain


@njit_part
def _sort_peaks(press: Float, own: NDArray[np.bool_], near: Index, total: Float, order: Index) -> int:
    """Write the load sums into ``total``, and the cells in order of decreasing load sum into ``order``.

    Returns the number of cells with an electrode.
    """
    count = 0
    for cell in range(press.size):
        total[cell] = 0.0
        if not own[cell]:
            continue
        for i in near[cell]:
            if i >= 0 and own[i] and press[i] > 0.0:
                total[cell] += press[i]
        at = count
        while at > 0 and total[order[at - 1]] < total[cell]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = cell
        count += 1
    return count


@njit_part
def _grow_areas(  # noqa: PLR0913, C901 - a kernel: loads, their posterior and scratch by name
    electrodes: int,
    order: Index,
    total: Float,
    press: Float,
    depth_m: Float,
    group: Index,
    before: Index,
    near: Index,
    own: NDArray[np.bool_],
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    parent: Index,
    area: Index,
    around: Index,
    few: Index,
    signs: Float,
    split: NDArray[np.bool_],
) -> None:
    """Write the peak to which each cell belongs into ``area`` (Q,); −1 for cells with a small load sum."""
    cells, top = total.size, total[order[0]]
    for cell in range(cells):
        area[cell], parent[cell] = -1, cell
    for k in range(electrodes):  # each group of discs is the area of its largest load
        cell = order[k]
        if group[cell] > 0:
            peak = cell
            for j in range(electrodes):
                other = order[j]
                if group[other] == group[cell] and press[other] > press[peak]:
                    peak = other
            area[cell] = peak
    for k in range(electrodes):
        cell = order[k]
        if group[cell] > 0:
            continue
        if total[cell] <= PART * RELEVANT_GROUP * top:
            break
        for other in range(cells):
            split[cell, other] = False
        count = 0
        for i in near[cell]:
            if i < 0 or area[i] < 0:
                continue
            peak = area[i]
            while parent[peak] != peak:
                peak = parent[peak]
            known = False
            for c in range(count):
                known = known or around[c] == peak
            if not known:
                around[count] = peak
                count += 1
        if count == 0:
            area[cell] = cell
            continue
        best = around[0]
        for c in range(1, count):
            if total[around[c]] > total[best]:
                best = around[c]
        area[cell] = best
        for c in range(count):
            other = around[c]
            if other == best or split[best, other]:
                continue
            known = group[best] > 0 and group[other] > 0
            if known or _apart(
                best, other, cell, total, depth_m, before, near, own, rows, weight, share, scale2, few, signs
            ):
                split[best, other] = True
            else:
                parent[other] = best
    for cell in range(cells):
        if area[cell] >= 0:
            while parent[area[cell]] != area[cell]:
                area[cell] = parent[area[cell]]


@njit_part
def _number_contacts(  # noqa: PLR0913, C901 - a kernel: loads, their posterior and scratch by name
    electrodes: int,
    order: Index,
    total: Float,
    press: Float,
    depth: Float,
    group: Index,
    gain: Float,
    before: Index,
    near: Index,
    own: NDArray[np.bool_],
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    area: Index,
    patch: Index,
    few: Index,
    ones: Float,
    block_cov: Float,
    block: Float,
    number: Index,
) -> int:
    """Number the cells of each peak that is a contact, and return the number of contacts."""
    cells = total.size
    found, strongest = 0, 0.0
    for k in range(electrodes):
        peak = order[k]
        if area[peak] != peak:
            continue
        still = before[peak] > 0
        relevant = RELEVANT_GROUP if group[peak] > 0 else RELEVANT_STILL if still else RELEVANT
        if found > 0 and total[peak] < relevant * strongest:
            continue
        count, box = _box(peak, near, own, few), 0.0
        for c in range(count):
            box += press[few[c]]
        variance = _variance(few, ones, count, rows, weight, share, scale2)
        part = max(PART * total[peak], min(PART_SIGNIFICANT * math.sqrt(variance), PART_MOST * total[peak]))
        size, deep, load = 0, 0.0, 0.0
        for cell in range(cells):
            if area[cell] == peak and total[cell] > part:
                patch[size] = cell
                size += 1
                deep = max(deep, depth[cell])
                load += press[cell]
        if size == 0:  # the loads around the peak do not press
            continue
        least = SIGNIFICANT_STILL if still else SIGNIFICANT
        alone = group[peak] > 0 or (found == 0 and peak == order[0])
        real = alone and (gain[group[peak]] > EVIDENT or deep > (PRESSED_STILL if still else PRESSED))
        if not real:
            real = box > 0.0 and box * box > least * least * variance
            if not real and press[peak] > 0.0:
                chi2 = _block_chi2(few, count, press, rows, weight, share, scale2, block_cov, block)
                real = chi2 > least * least + BLOCK_EXTRA
        if not real and load > 0.0:
            real = load * load > least * least * _variance(patch, ones, size, rows, weight, share, scale2)
        if real:
            found += 1
            if found == 1:
                strongest = total[peak]
            for c in range(size):
                number[patch[c]] = found
    return found


@njit
def find_regions(  # noqa: PLR0913 - a kernel: loads, their posterior, lattice and outputs by name
    press: Float,
    depth: Float,
    depth_m: Float,
    group: Index,
    gain: Float,
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    own: NDArray[np.bool_],
    near: Index,
    before: Index,
    number: Index,
    outside: Index,
    scratch: RegionScratch,
) -> int:
    """Find the contacts, and return their number. Contact 1 has the strongest peak.

    Args:
        press: (Q,) pressing loads.
        depth: (Q,) depth of the skin at the electrode of each cell, in standard deviations.
        depth_m: (Q,) the same in metres.
        group: (Q,) number of the group of discs that contains each cell; 0 for other cells.
        gain: (G + 1,) gain in log evidence due to each group, in nats; the first value is the largest gain.
        rows: (m, 3Q) rows of the information about the loads.
        weight: (m,) weight of each row (:class:`skinnode.solve.posterior.contacts.LoadEstimate`).
        share: (Q,) prior variances of the loads, relative to ``scale2``.
        scale2: Squared scale s² of the prior, in pitch².
        own: (Q,) bool: True for a cell with an electrode.
        near: (Q, 9) indices of each cell and its neighbours; −1 outside the lattice.
        before: (Q,) contact number of each cell in the last frame.
        number: (Q,) receives the contact number of each cell; 0 for cells without a contact and for the
            outermost ring.
        outside: (Q,) receives the contact numbers of the outermost ring; 0 for all other cells.
        scratch: Work arrays from :func:`region_scratch`.
    """
    total, ones, block_cov, block, signs, order, parent, area, patch, around, few, split = scratch
    for cell in range(press.size):
        number[cell], outside[cell] = 0, 0
    electrodes = _sort_peaks(press, own, near, total, order)
    if not total[order[0]] > 0.0:
        return 0
    _grow_areas(
        electrodes, order, total, press, depth_m, group, before, near, own, rows, weight, share, scale2,
        parent, area, around, few, signs, split,
    )  # fmt: skip
    found = _number_contacts(
        electrodes, order, total, press, depth, group, gain, before, near, own, rows, weight, share, scale2,
        area, patch, few, ones, block_cov, block, number,
    )  # fmt: skip
    if found > 0:
        _dilate(total, near, number, outside, patch)
    return found


@njit_part
def _dilate(  # noqa: C901 - neighbours as loops
    total: Float, near: Index, number: Index, outside: Index, added: Index
) -> None:
    """Add the neighbouring cells to each contact, and number the adjacent cells of the outermost ring."""
    cells = number.size
    for cell in range(cells):
        added[cell] = 0
        if number[cell] > 0:
            continue
        best = -1.0
        for i in near[cell]:
            if i >= 0 and number[i] > 0 and total[i] > best:
                added[cell], best = number[i], total[i]
    for cell in range(cells):
        if added[cell] > 0:
            number[cell] = added[cell]
    for cell in range(cells):
        ring = False
        for i in near[cell]:
            ring = ring or i < 0
        if ring:
            for i in near[cell]:
                if i >= 0 and number[i] > 0:
                    outside[cell] = number[i]
    for cell in range(cells):
        for i in near[cell]:
            if i < 0:
                number[cell] = 0
