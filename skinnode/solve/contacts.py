"""Loads on the skin and the contacts they form, from the posterior of the displacement.

The prior's loads q ~ N(0, s² D) move the electrodes by u = G q + slack. Given the displacement their mean is
D Gᵀ C⁻¹ u; after the frame the variance of any sum wᵀ q is s² wᵀ D w − ‖L⁻¹ J G s² D w‖², in the notation of
solve/innovation.py.

Single cells are noisy and their neighbours make up for it, so contacts are looked for in sums of 3 × 3 cells:
those that press significantly, and not much less than the strongest, form contacts with their neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import Contact
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.prior import ElasticPrior

if TYPE_CHECKING:
    from skinnode.solve.estimate import Estimator

SIGNIFICANT: Final = 5.0
"""Deviations by which a sum of cells must press to be part of a contact: with 200 sums a frame, noise does so
once in some ten thousand frames."""
RELEVANT: Final = 0.25
"""Share of the strongest sum that another must reach: the flanks of a contact ring at a tenth."""
HERTZ_SPREAD: Final = 2.5
"""a² over the mean of r² under Hertz's pressure √(1 − r²/a²)."""


class ContactFinder:
    """The constants of a patch, and the deviations of its sums of cells."""

    def __init__(self, prior: ElasticPrior, layout: PatchLayout) -> None:
        self._prior = prior
        self._own = prior.own_cells().ravel()
        self._electrodes = layout.upper_m.shape
        rows, columns = prior.shape
        box = np.zeros((rows, columns, rows, columns))
        for i in range(rows):
            for j in range(columns):
                box[i, j, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = 1.0
        self._box = np.zeros((rows * columns, 3 * rows * columns))
        self._box[:, 2::3] = box.reshape(rows * columns, -1)

        self._made_by = -1
        self._box_std = np.full(rows * columns, np.nan)

    def find(self, estimator: Estimator) -> tuple[Float, tuple[Contact, ...]]:
        """(U, N, 3) forces on the cells of the electrodes, N, and the contacts, the strongest first."""
        q = estimator.loads()
        force = np.einsum("qt,qti->qi", q * self._prior.load_n, self._prior.frame)
        pressing = -np.einsum("bq,q->b", self._box, q.ravel())
        strong = np.flatnonzero(pressing > RELEVANT * max(float(pressing.max()), 0.0))
        seed = np.zeros(len(pressing), bool)
        seed[strong] = pressing[strong] > SIGNIFICANT * self._deviations(strong, estimator)
        found = [
            contact
            for region in _regions(seed.reshape(self._prior.shape))
            if (contact := self._contact(region, q, estimator)) is not None
        ]
        found.sort(key=lambda contact: -contact.normal_force_n)
        return force[self._own].reshape(self._electrodes), tuple(found)

    def _deviations(self, boxes: NDArray[np.int64], estimator: Estimator) -> Float:
        """(B,) deviations of these sums; each is worked out once for a set of factors."""
        if self._made_by != estimator.factors:
            self._made_by = estimator.factors
            self._box_std[:] = np.nan
        new = boxes[np.isnan(self._box_std[boxes])]
        if new.size:
            self._box_std[new] = estimator.load_std(self._box[new])
        return self._box_std[boxes]

    def _contact(self, region: NDArray[np.int64], q: Float, estimator: Estimator) -> Contact | None:
        """The contact on the cells ``region``."""
        load = self._prior.load_n
        pressure = -q[region, 2] * load[2]
        force = float(pressure.sum())
        if not force > 0:
            return None
        place = self._prior.cell_m[region]
        centroid = (pressure[:, None] * place).sum(axis=0) / force
        away = place - centroid
        spread = (away**2).sum(axis=1)
        mean = float((pressure * spread).sum() / force)
        area = math.pi * HERTZ_SPREAD * max(mean, 0.0)
        weights = np.zeros((7, 3 * len(q)))  # force, centroid, mean r², shear: by the delta method
        weights[0, 3 * region + 2] = load[2]
        weights[1:4, 3 * region + 2] = away.T * (load[2] / force)
        weights[4, 3 * region + 2] = (spread - mean) * (load[2] / force)
        weights[5, 3 * region] = load[0]
        weights[6, 3 * region + 1] = load[1]
        std = estimator.load_std(weights)
        return Contact(
            centroid_m=centroid,
            centroid_std_m=std[1:4],
            area_m2=area,
            area_std_m2=math.pi * HERTZ_SPREAD * float(std[4]),
            normal_force_n=force,
            normal_force_std_n=float(std[0]),
            shear_force_n=q[region, :2].sum(axis=0) * load[:2],
            shear_force_std_n=std[5:],
        )


def _regions(seed: NDArray[np.bool_]) -> Iterator[NDArray[np.int64]]:
    """Cells of each connected group of ``seed`` and their neighbours; a cell belongs to one group only."""
    rows, columns = seed.shape
    left = {(int(i), int(j)) for i, j in np.argwhere(seed)}
    taken: set[tuple[int, int]] = set()
    while left:
        group, border = set(), [min(left)]
        while border:
            cell = border.pop()
            if cell in left:
                left.discard(cell)
                group.add(cell)
                border.extend((cell[0] + i, cell[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1))
        grown = {(c[0] + i, c[1] + j) for c in group for i in (-1, 0, 1) for j in (-1, 0, 1)}
        region = {c for c in grown - taken if 0 <= c[0] < rows and 0 <= c[1] < columns}
        taken |= region
        yield np.array(sorted(i * columns + j for i, j in region))
