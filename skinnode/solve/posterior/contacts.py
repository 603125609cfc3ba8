"""Contacts on the skin, found from the posterior of the loads.

The loads q ~ N(0, s² D) of the prior move the electrodes by u = G q + slack. Given the displacement, the mean
of q is D Gᵀ C⁻¹ u. Given the frame, the variance of a sum wᵀ q is s² wᵀ D w − ‖L⁻¹ J G s² D w‖², in the
notation of :mod:`skinnode.solve.posterior.measurement_update`.

The errors in single cells are large but cancel between neighbours, so contacts are found in sums of 3 × 3
cells. Cells whose sum is significant, and not much smaller than the largest sum, form contacts with their
neighbours.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.frames import Contact
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.posterior.load_posterior import LoadPosterior
from skinnode.solve.posterior.map_estimate import PRIOR_DOUBT

SIGNIFICANT: Final = 5.0
"""Significance, in standard deviations, above which a sum is part of a contact; with 200 sums per frame,
noise reaches it about once in ten thousand frames."""
RELEVANT: Final = 0.25
"""Fraction of the largest sum that another sum must exceed; ringing next to a contact reaches a tenth of the
largest sum."""
HERTZ_SPREAD: Final = 2.5
"""Ratio of a² to the mean of r² under Hertz's pressure √(1 − r²/a²)."""


class ContactFinder:
    """Finder of the contacts on one patch, frame by frame.

    Args:
        prior: Elasticity of the patch.
        layout: The patch.
    """

    def __init__(self, prior: ElasticPrior, layout: PatchLayout) -> None:
        self._prior = prior
        self._own = prior.own_cells().ravel()
        self._own_frame = prior.frame[self._own]
        self._electrodes = layout.upper_m.shape
        cells = prior.shape[0] * prior.shape[1]
        near = np.pad(np.arange(cells).reshape(prior.shape), 1, constant_values=-1)
        rows, columns = prior.shape
        box = np.stack([near[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=-1)
        self._near: Index = box.reshape(cells, 9)  # each cell with its neighbours; −1 outside the lattice
        self._region, self._label, self._stack = np.empty((3, cells), np.int64)
        self._made_by = -1
        self._box_std = np.full(cells, np.nan)

    def find(self, loads: LoadPosterior) -> tuple[Float, tuple[Contact, ...]]:
        """Return the loads on the electrodes and the contacts.

        Args:
            loads: Posterior of the loads.

        Returns:
            (U, N, 3) forces on the electrodes' cells, N, and the contacts, largest normal force first.
        """
        q = loads.mean()
        force = np.einsum("qt,qti->qi", q[self._own] * self._prior.load_n, self._own_frame)
        pressing = -np.append(q[:, 2], 0.0)[self._near].sum(axis=1)
        strong = np.flatnonzero(pressing > RELEVANT * max(float(pressing.max()), 0.0))
        seed = strong[pressing[strong] > SIGNIFICANT * self._deviations(strong, loads)]
        count = _number_regions(self._near, seed, self._label, self._region, self._stack)
        found = [
            contact
            for number in range(1, count + 1)
            if (contact := self._contact(np.flatnonzero(self._region == number), q, loads)) is not None
        ]
        found.sort(key=lambda contact: -contact.normal_force_n)
        return force.reshape(self._electrodes), tuple(found)

    def warm_up(self, posterior: LoadPosterior) -> None:
        """Compile the kernels that contact finding needs."""
        self._contact(np.arange(1), np.full((len(self._near), 3), -1.0), posterior)

    def _deviations(self, boxes: Index, posterior: LoadPosterior) -> Float:
        """Return the standard deviations (B,) of the sums at ``boxes`` (B,), cached per set of factors."""
        if self._made_by != posterior.factors:
            self._made_by = posterior.factors
            self._box_std[:] = np.nan
        new = boxes[np.isnan(self._box_std[boxes])]
        if new.size:
            near = self._near[new]
            self._box_std[new] = posterior.std(3 * np.maximum(near, 0) + 2, (near >= 0).astype(float))
        return self._box_std[boxes]

    def _contact(self, region: Index, q: Float, posterior: LoadPosterior) -> Contact | None:
        """Return the contact on the cells ``region``, or None if their normal force is not compressive."""
        loads, weights = np.empty((7, len(region)), np.int64), np.empty((7, len(region)))
        centroid, shear = np.empty((2, 3))
        force, spread = _sum_region(
            region, q, self._prior.load_n, self._prior.cell_m, centroid, shear, loads, weights
        )
        if not force > 0:
            return None
        # the prior largely determines how a contact's load is distributed over its cells
        std = math.sqrt(PRIOR_DOUBT) * posterior.std(loads, weights)
        spread += self._prior.cell_area_m2 / 6.0  # mean r² of a load that is uniform over its cell
        away = self._prior.cell_m[region] - centroid
        middle = region[np.argmin(np.einsum("qi,qi->q", away, away))]
        return Contact(
            centroid_m=centroid,
            centroid_std_m=std[1:4],
            area_m2=math.pi * HERTZ_SPREAD * max(spread, 0.0),
            area_std_m2=math.pi * HERTZ_SPREAD * float(std[4]),
            normal_force_n=force,
            normal_force_std_n=float(std[0]),
            shear_force_n=shear[:2],
            shear_force_std_n=std[5:],
            axes=self._prior.frame[middle],
        )


@njit
def _number_regions(near: Index, seed: Index, label: Index, region: Index, stack: Index) -> int:
    """Number the connected groups of the cells ``seed`` from 1, and return the number of groups.

    ``label`` (Q,) receives the group number of each seed cell, ``region`` (Q,) that of each seed cell and its
    neighbours; both are 0 elsewhere. A cell between two groups belongs to the first. ``stack`` (Q,) is
    scratch.
    """
    label[:], region[:] = 0, 0
    for cell in seed:
        label[cell] = -1
    count = 0
    for first in seed:
        if label[first] > 0:
            continue
        count += 1
        label[first], stack[0], top = count, first, 1
        while top > 0:
            top -= 1
            for i in near[stack[top]]:
                if i < 0:
                    continue
                if region[i] == 0:
                    region[i] = count
                if label[i] < 0:
                    label[i], stack[top] = count, i
                    top += 1
    return count


@njit
def _sum_region(  # noqa: PLR0913 - a kernel: cells, loads and outputs by name
    region: Index,
    q: Float,
    load: Float,
    place: Float,
    centroid: Float,
    shear: Float,
    loads: Index,
    weights: Float,
) -> tuple[float, float]:
    """Return the normal force in N and the mean r² of the pressure in m² on the cells ``region`` (n,).

    Writes ``centroid`` (3,) in m and ``shear`` (3,) in N. Also writes ``loads`` and ``weights`` (7, n), the
    first-order sensitivities of force, centroid, mean r² and shear to the loads (delta method). If the force
    is not positive, all other outputs are undefined.
    """
    force, mean = 0.0, 0.0
    for t in range(3):
        centroid[t], shear[t] = 0.0, 0.0
    for cell in region:
        force -= q[cell, 2] * load[2]
    if not force > 0.0:
        return force, mean
    for cell in region:
        for t in range(3):
            centroid[t] -= q[cell, 2] * load[2] * place[cell, t] / force
            shear[t] += q[cell, t] * load[t]
    for c in range(region.size):
        cell = region[c]
        spread = 0.0
        for t in range(3):
            away = place[cell, t] - centroid[t]
            weights[1 + t, c] = away * load[2] / force
            spread += away * away
        weights[4, c] = spread
        mean -= q[cell, 2] * load[2] * spread / force
    for c in range(region.size):
        weights[0, c] = load[2]
        weights[4, c] = (weights[4, c] - mean) * load[2] / force
        weights[5, c], weights[6, c] = load[0], load[1]
        for f in range(5):
            loads[f, c] = 3 * region[c] + 2
        loads[5, c], loads[6, c] = 3 * region[c], 3 * region[c] + 1
    return force, mean
