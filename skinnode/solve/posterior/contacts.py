"""Contacts on the skin, computed from the posterior of the loads.

In the prior, the loads q ~ N(0, s² D) cause the displacement u = G q plus a small independent term. For a
displacement u, the posterior mean of q is D Gᵀ C⁻¹ u. The posterior variance of a weighted sum wᵀ q is s² wᵀ
D w − ‖L⁻¹ J G s² D w‖², in the notation of :mod:`skinnode.solve.posterior.measurement_update`.

:mod:`skinnode.solve.posterior.contact_regions` assigns cells to contacts. This module computes the force,
centre, area and shear of each contact, with standard deviations.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.elastic import Rubber
from skinnode.model.frames import Contact
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.layer_force import bonded_force_n, layer_std_n
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.contact_regions import LEVEL, find_regions, region_scratch
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.posterior.load_prior import PRIOR_DOUBT

HERTZ_SPREAD: Final = 2.5
"""Ratio of a² to the pressure-weighted mean of r² in a Hertz contact of radius a, where the pressure is
proportional to √(1 − r²/a²)."""
PULLING: Final = 0.25
"""Minimum ratio of the sum of all loads of a contact to the sum of its pressing loads; below this ratio,
tensile loads are ignored. The half-space model needs tensile loads at the rim of a contact to reproduce the
displacement of a supported layer. The measured ratio was at most 0.15 on bonded layers of up to 8 mm, and at
least 0.33 on a half-space."""
PULLED_OFF: Final = 0.1
"""Standard deviation, in cell widths, of the position of a contact's centre if its tensile loads are ignored.
The measured RMS error on layers of 2 to 8 mm was at most 0.11 cell widths."""
BEYOND: Final = 1.0
"""Standard deviation of the loads in the outermost ring of cells, relative to these loads. The outermost ring
represents all loads beyond the patch. With a value of 0.5, errors in the force under plates larger than the
patch would reach 4.8 standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadEstimate:
    """Loads estimated from a frame, with covariance s² (D − s² D Rᵀ diag(``weight``) R D), R = ``rows``."""

    mean: Float
    """(Q, 3) mean loads, in units of the prior's loads."""
    rows: Float
    """(m, 3Q) rows of the information about the loads."""
    weight: Float
    """(m,) weight of each row; negative for rows that remove the information about left-out coordinates."""
    share: Float
    """(Q,) diagonal of D: load variance of each cell, relative to s²."""
    scale2: float
    """Squared scale s² of the prior, in pitch²."""
    doubt: float = PRIOR_DOUBT
    """Factor applied to the variances, because the loads depend mainly on the prior."""
    add_shear: Callable[[Index], None] | None = None
    """Function that computes the columns of ``rows`` for the shear loads of given cells; None if ``rows`` is
    complete. Only the shear loads of the cells in contacts are needed."""


class ContactFinder:
    """Finds the contacts on one patch, frame by frame. Each stream needs its own instance.

    The detection thresholds depend on the contacts of the last frame
    (:mod:`skinnode.solve.posterior.contact_regions`).

    Args:
        prior: Elastic prior of the patch.
        layout: The patch.
        rubber: Material of the skin.
        calibrated: Whether forces are calibrated. If not, the standard deviation of a normal force covers the
            range from a half-space to a layer that is as thick as the clearance and bonded to a rigid
            support.
        thickness: Thickness tolerance, as a fraction of the clearance.
        outermost: Whether a contact includes the loads of adjacent cells in the outermost ring. Set this to
            False if the prior expects equal loads everywhere, because the loads in the ring are then
            overestimated.
    """

    def __init__(  # noqa: PLR0913 - what the patch is
        self,
        prior: ElasticPrior,
        layout: PatchLayout,
        rubber: Rubber | None = None,
        *,
        calibrated: bool = False,
        thickness: float = 0.0,
        outermost: bool = True,
    ) -> None:
        self._prior = prior
        self._rubber = Rubber() if rubber is None else rubber
        self._calibrated, self._outermost = calibrated, outermost
        gaps = layout.upper_m.reshape(-1, 1, 3) - layout.lower_m.reshape(1, -1, 3)
        self._thickness_m = (1.0 - thickness) * float(np.median(np.linalg.norm(gaps, axis=2).min(axis=1)))
        self._own = prior.own_cells().ravel()
        self._own_frame = prior.frame[self._own]
        self._electrodes = layout.upper_m.shape
        cells = prior.shape[0] * prior.shape[1]
        near = np.pad(np.arange(cells).reshape(prior.shape), 1, constant_values=-1)
        rows, columns = prior.shape
        box = np.stack([near[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=-1)
        self._near: Index = box.reshape(cells, 9)  # each cell and its neighbours; −1 outside the lattice
        self._has_electrode = np.zeros(cells, bool)
        self._has_electrode[self._own] = True
        self._number, self._outside, self._before = np.zeros((3, cells), np.int64)
        self._depth_m, self._depth = np.zeros((2, cells))
        self._none = np.zeros(cells, np.int64)
        self._press = np.zeros(cells)
        self._field = np.zeros((2, len(self._own), 3))  # displacement and its standard deviations, in m
        self._scratch = region_scratch(cells)
        self._work = np.empty(cells, np.int64), np.empty(cells), np.empty((cells, 5))

    def reset(self) -> None:
        """Discard the contacts of the last frame."""
        self._number[:] = 0

    def find(
        self,
        loads: LoadEstimate,
        displacement_m: Float,
        std_m: Float,
        groups: Index | None = None,
        gain: Float | None = None,
    ) -> tuple[Float, tuple[Contact, ...]]:
        """Return the forces on the electrodes' cells, and the contacts.

        Args:
            loads: Loads estimated from the frame.
            displacement_m: (U, N, 3) displacement, in m.
            std_m: (U, N, 3) standard deviation of the displacement, in m; inf for unsolved electrodes.
            groups: (Q,) number of the group of discs that contains each cell; 0 for other cells. Each group
                may be a contact. Default: all 0.
            gain: (G + 1,) gain in log evidence due to each group, in nats; the first value is the largest
                gain. Default: 0.

        Returns:
            (U, N, 3) forces on the electrodes' cells, in N, and the contacts in order of decreasing normal
                force.
        """
        np.copyto(self._field[0], displacement_m.reshape(-1, 3))
        np.copyto(self._field[1], std_m.reshape(-1, 3))
        force = np.empty(self._electrodes)
        _prepare(
            loads.mean, self._prior.load_n, self._own, self._own_frame, self._field, self._press,
            self._depth_m, self._depth, force.reshape(-1, 3),
        )  # fmt: skip
        self._before[:] = self._number
        group, gain = self._none if groups is None else groups, np.zeros(1) if gain is None else gain
        if group.any():
            group, gain = self._apart(group, gain)
        count = find_regions(
            self._press, self._depth, self._depth_m, group, gain, loads.rows, loads.weight, loads.share,
            loads.scale2, self._has_electrode, self._near, self._before, self._number, self._outside,
            self._scratch,
        )  # fmt: skip
        if loads.add_shear is not None:
            loads.add_shear(np.flatnonzero((self._number > 0) | (self._outside > 0)))
        found = [self._contact(number, loads) for number in range(1, count + 1)]
        found.sort(key=lambda contact: -contact.normal_force_n)
        return force, tuple(found)

    def _apart(self, groups: Index, gain: Float) -> tuple[Index, Float]:
        """Merge those groups of discs between which the skin does not rise.

        Args:
            groups: (Q,) number of the group that contains each cell; 0 for other cells.
            gain: (G + 1,) gain due to each group; the first value is the largest gain.

        Returns:
            The groups and their gains; the gain for cells in no group is 0. If only one group remains, all
            cells are in no group, and the first gain is unchanged.
        """
        groups, gain = np.where(self._has_electrode, groups, 0), gain.copy()
        numbers = np.unique(groups[groups > 0])
        peaks = [int(np.argmax(np.where(groups == number, self._depth_m, -np.inf))) for number in numbers]
        for i, j in itertools.combinations(range(len(numbers)), 2):
            first, last = (np.array(np.unravel_index(peaks[k], self._prior.shape)) for k in (i, j))
            steps = 2 * int(np.abs(last - first).max())
            line = np.rint(np.linspace(first, last, steps + 1)).astype(np.int64)
            depth_m = self._depth_m[np.ravel_multi_index(tuple(line.T), self._prior.shape)]
            known_m = depth_m[depth_m != 0.0]  # 0: unsolved
            if known_m.min(initial=np.inf) > LEVEL * min(depth_m[0], depth_m[-1]):
                gain[numbers[i]] = max(gain[numbers[[i, j]]])
                groups[groups == numbers[j]] = numbers[j] = numbers[i]
        if len(np.unique(numbers)) < 2:
            return self._none, gain
        gain[0] = 0.0
        return groups, gain

    def warm_up(self, loads: LoadEstimate) -> None:
        """Compile the kernels."""
        pressed = dataclasses.replace(loads, mean=-np.ones_like(loads.mean))
        self.find(pressed, -self._own_frame[:, 2].reshape(self._electrodes), np.ones(self._electrodes))
        self.reset()

    def _contact(self, number: int, loads: LoadEstimate) -> Contact:
        """Measure the contact with the given number."""
        prior, mean, std = self._prior, np.empty(7), np.empty(7)
        middle, pulls, pressing_n = _measure(
            number, self._number, self._outside, self._outermost, loads.mean, prior.load_n, prior.cell_m,
            loads.rows, loads.weight, loads.share, loads.scale2, loads.doubt, mean, std, *self._work,
        )  # fmt: skip
        force_n, force_std_n = float(mean[0]), float(std[0])
        # a load distributed uniformly over a square cell has a mean r² of cell_area / 6
        area = math.pi * HERTZ_SPREAD * (max(float(mean[4]), 0.0) + prior.cell_area_m2 / 6.0)
        if not self._calibrated:
            depth_m = max(float(self._depth_m[self._number == number].max()), 0.0)
            radius_m = math.sqrt(area / math.pi)
            bonded_n = bonded_force_n(self._rubber, depth_m, radius_m, self._thickness_m)
            force_std_n = math.hypot(force_std_n, layer_std_n(max(bonded_n, pressing_n), force_n))
        centroid_std_m, area_std = std[1:4], math.pi * HERTZ_SPREAD * float(std[4])
        if pulls:
            along = 1.0 - prior.frame[middle][2] ** 2
            centroid_std_m = np.sqrt(centroid_std_m**2 + PULLED_OFF**2 * prior.cell_area_m2 * along)
            area_std = math.hypot(area_std, area)
        return Contact(
            centroid_m=mean[1:4],
            centroid_std_m=centroid_std_m,
            area_m2=area,
            area_std_m2=area_std,
            normal_force_n=force_n,
            normal_force_std_n=force_std_n,
            shear_force_n=mean[5:],
            shear_force_std_n=std[5:],
            force_calibrated=self._calibrated,
            axes=prior.frame[middle],
        )


@njit
def _prepare(  # noqa: PLR0913 - a kernel: loads, field and outputs by name
    q: Float,
    load: Float,
    own: Index,
    frame: Float,
    field: Float,
    press: Float,
    depth_m: Float,
    depth: Float,
    force: Float,
) -> None:
    """Write pressing loads (Q,), depths (Q,) in m and in standard deviations, and forces (UN, 3) in N.

    ``field`` (2, UN, 3) contains the displacement and its standard deviations, in m. A depth with an infinite
    standard deviation is written as 0. Depths of cells without an electrode are not written.
    """
    for cell in range(press.size):
        press[cell] = -q[cell, 2]
    for e in range(own.size):
        cell, deep, variance = own[e], 0.0, 0.0
        for t in range(3):
            normal = frame[e, 2, t]
            deep -= normal * field[0, e, t]
            variance += (normal * field[1, e, t]) ** 2 if normal != 0.0 else 0.0
            force[e, t] = 0.0
            for s in range(3):
                force[e, t] += q[cell, s] * load[s] * frame[e, s, t]
        known = variance > 0.0 and variance < math.inf
        depth_m[cell] = deep if variance < math.inf else 0.0
        depth[cell] = deep / math.sqrt(variance) if known else 0.0


@njit
def _measure(  # noqa: PLR0913, C901 - a kernel: cells, loads and outputs by name
    contact: int,
    number: Index,
    outside: Index,
    outermost: bool,
    q: Float,
    load: Float,
    place: Float,
    rows: Float,
    weight: Float,
    share: Float,
    scale2: float,
    doubt: float,
    mean: Float,
    std: Float,
    cells: Index,
    r2: Float,
    slopes: Float,
) -> tuple[int, bool, float]:
    """Compute the force in N, centre (3) in m, mean r² in m² and shear (2) in N of one contact.

    The seven values are written into ``mean``, and their standard deviations (by the delta method) into
    ``std``. The variances are multiplied by ``doubt``, because the distribution of the load over the
    cells depends mainly on the prior. ``cells`` (Q,), ``r2`` (Q,) and ``slopes`` (Q, 5) are work arrays.

    Returns the cell closest to the centre, a bool that is True if tensile loads were ignored, and the sum of
    the pressing loads in N.
    """
    size, every, pressing = 0, 0.0, 0.0
    for cell in range(number.size):
        if number[cell] == contact or (outermost and outside[cell] == contact):
            cells[size] = cell
            size += 1
            every -= q[cell, 2]
            pressing += max(-q[cell, 2], 0.0)
    pulls = every < PULLING * pressing
    if pulls:
        kept = 0
        for c in range(size):
            if q[cells[c], 2] < 0.0:
                cells[kept] = cells[c]
                kept += 1
        size = kept
    for f in range(7):
        mean[f], std[f] = 0.0, 0.0
    for c in range(size):
        mean[0] -= q[cells[c], 2] * load[2]
    force = mean[0]
    for c in range(size):
        cell = cells[c]
        for t in range(3):
            mean[1 + t] -= q[cell, 2] * load[2] * place[cell, t] / force
        mean[5] += q[cell, 0] * load[0]
        mean[6] += q[cell, 1] * load[1]
    middle = cells[0]
    for cell in range(number.size):
        r2[cell] = 0.0
        for t in range(3):
            r2[cell] += (place[cell, t] - mean[1 + t]) ** 2
    for c in range(size):
        cell = cells[c]
        mean[4] -= q[cell, 2] * load[2] * r2[cell] / force
        if r2[cell] < r2[middle]:
            middle = cell
    for c in range(size):
        cell = cells[c]
        slope, shared = slopes[c], share[cells[c]]
        slope[0] = load[2]
        for t in range(3):
            slope[1 + t] = (place[cell, t] - mean[1 + t]) * load[2] / force
        slope[4] = (r2[cell] - mean[4]) * load[2] / force
        for f in range(5):
            std[f] += slope[f] * slope[f] * shared
            slope[f] *= shared
        std[5] += load[0] * load[0] * shared
        std[6] += load[1] * load[1] * shared
    s0, s1, s2, s3, s4, s5, s6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows.shape[0]):
        row, w = rows[i], weight[i]
        v0, v1, v2, v3, v4, v5, v6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(size):
            first, slope, shared = 3 * cells[c], slopes[c], share[cells[c]]
            normal = row[first + 2]
            v0 += slope[0] * normal
            v1 += slope[1] * normal
            v2 += slope[2] * normal
            v3 += slope[3] * normal
            v4 += slope[4] * normal
            v5 += shared * row[first]
            v6 += shared * row[first + 1]
        s0 += w * v0 * v0
        s1 += w * v1 * v1
        s2 += w * v2 * v2
        s3 += w * v3 * v3
        s4 += w * v4 * v4
        s5 += w * v5 * v5
        s6 += w * v6 * v6
    std[0], std[1], std[2], std[3], std[4] = (
        std[0] - scale2 * s0, std[1] - scale2 * s1, std[2] - scale2 * s2, std[3] - scale2 * s3,
        std[4] - scale2 * s4,
    )  # fmt: skip
    std[5] -= scale2 * load[0] * load[0] * s5
    std[6] -= scale2 * load[1] * load[1] * s6
    for f in range(7):
        std[f] = doubt * scale2 * max(std[f], 0.0)
    b0, b1, b2, b3, b4, b5, b6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for cell in range(number.size):
        if outside[cell] == contact:
            pressed = abs(q[cell, 2]) * load[2]
            b0 += pressed
            b1 += pressed * abs(place[cell, 0] - mean[1]) / force
            b2 += pressed * abs(place[cell, 1] - mean[2]) / force
            b3 += pressed * abs(place[cell, 2] - mean[3]) / force
            b4 += pressed * abs(r2[cell] - mean[4]) / force
            b5 += abs(q[cell, 0]) * load[0]
            b6 += abs(q[cell, 1]) * load[1]
    std[0] = math.sqrt(std[0] + (BEYOND * b0) ** 2)
    std[1] = math.sqrt(std[1] + (BEYOND * b1) ** 2)
    std[2] = math.sqrt(std[2] + (BEYOND * b2) ** 2)
    std[3] = math.sqrt(std[3] + (BEYOND * b3) ** 2)
    std[4] = math.sqrt(std[4] + (BEYOND * b4) ** 2)
    std[5] = math.sqrt(std[5] + (BEYOND * b5) ** 2)
    std[6] = math.sqrt(std[6] + (BEYOND * b6) ** 2)
    return middle, pulls, pressing * load[2]
