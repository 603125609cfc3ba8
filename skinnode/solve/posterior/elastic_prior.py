"""Elastic prior: the rubber displacement expected before any resistance is measured.

Each electrode is at the centre of a cell one pitch wide. Independent loads on the surfaces of the cells
displace the electrodes according to the response G of an elastic half-space (Boussinesq, Cerruti;
:func:`skinnode.model.elastic.rectangle_compliance`). The prior of the displacement u is

    u ~ N(0, s² C),   C = G diag(q) Gᵀ + ε² I

The scale s applies to the whole patch and is estimated from the data. There are additional cells beyond the
outermost electrodes, because the skin can be pressed there as well. The term ε² I allows each electrode to
deviate slightly from the half-space, independently of the others.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.bonded_layer import bonded_layer_compliance
from skinnode.model.elastic import Rubber, rectangle_compliance
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.linalg.cholesky import multiply
from skinnode.solve.posterior.load_cells import MARGIN, LoadCells

SHEAR_SHARE: Final = 0.4
"""Ratio of the standard deviation of shear loads to that of normal loads. The marginal likelihood of the data
hardly changes between 0.25 and 0.4. With smaller values, the standard deviations are too small on layouts
that are insensitive to shear (`aligned`)."""
LAYER_SHARE: Final = 0.25
"""Size of the displacements that the data check expects on a bonded layer, relative to those on a half-space.
With 0.1, a dent in a thin layer is mistaken for a faulty wire. With 0.5, delayed readings of an upper wire
are not detected."""
SLACK: Final = 0.005
"""Ratio of ε to the standard deviation of the normal displacement. Because ε is positive, C is invertible.
Values from 0.001 to 0.02 lead to the same estimates."""


@dataclass(frozen=True, eq=False)
class ElasticPrior:
    """Elastic prior of one layout, at s = 1.

    The loads are scaled so that the median standard deviation of the normal displacement is 1 pitch.
    """

    covariance: Float
    """(3UN, 3UN) covariance C of the displacement, in pitch²."""
    response: Float
    """(3UN, 3Q) displacement per unit load, in pitches. At s = 1, each load has a standard deviation of 1."""
    load_n: Float
    """(3,) force of a unit load along the wire, across the wire and along the normal, in N."""
    cell_m: Float
    """(Q, 3) centres of the cells, in m."""
    frame: Float
    """(Q, 3, 3) unit vectors as rows: tangent along the wire, tangent across the wire, outward normal."""
    cell_area_m2: float
    """Area of a cell, in m²."""
    shape: tuple[int, int]
    """Numbers of cells across and along the wires; their product is Q."""

    @classmethod
    def of(cls, layout: PatchLayout, rubber: Rubber | None = None) -> ElasticPrior:
        """Return the prior for ``layout`` on ``rubber``. The modulus of the rubber scales only the forces.

        Patches of the same layout share one prior, whose arrays must not be modified.
        """
        return _elastic_prior(layout, Rubber() if rubber is None else rubber)

    @classmethod
    def compute(cls, layout: PatchLayout, rubber: Rubber) -> ElasticPrior:
        """Return a new prior, which may be modified; see :meth:`of`."""
        cells = LoadCells.of(layout)
        own, size = cells.electrode_frame, cells.size_m
        compliance = rectangle_compliance(rubber, cells.offset_m.reshape(-1, 2), size)
        response = cells.displacement(compliance.reshape(*cells.offset_m.shape[:2], 3, 3))
        response[..., :2] *= SHEAR_SHARE
        variance = np.einsum("eiql,ei->eql", response, own[:, 2])
        traction_pa = layout.pitch_m / math.sqrt(float(np.median((variance**2).sum(axis=(1, 2)))))
        response = np.ascontiguousarray(response.reshape(3 * own.shape[0], -1)) * (
            traction_pa / layout.pitch_m
        )
        covariance = np.empty((len(response), len(response)))
        multiply(response, np.ascontiguousarray(response.T), covariance)
        covariance[np.diag_indices_from(covariance)] += SLACK**2
        area = size[0] * size[1]
        load_n = traction_pa * area * np.array([SHEAR_SHARE, SHEAR_SHARE, 1.0])
        return cls(covariance, response, load_n, cells.centre_m, cells.frame, area, cells.shape)

    def own_cells(self) -> NDArray[np.int64]:
        """Return the indices (U, N) of the cells around the electrodes."""
        index = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        return index[MARGIN : self.shape[0] - MARGIN, MARGIN : self.shape[1] - MARGIN]


@functools.lru_cache(maxsize=16)  # for the reference patch, 30 ms and 2 MB
def _elastic_prior(layout: PatchLayout, rubber: Rubber) -> ElasticPrior:
    return ElasticPrior.compute(layout, rubber)


@functools.lru_cache(maxsize=16)  # for the reference patch, 130 ms and 0.5 MB
def bonded_response(layout: PatchLayout) -> Float:
    """Return the response (3UN, Q) of a bonded layer to normal loads, in pitches per unit load (read-only).

    The layer is incompressible, and its thickness equals the height of the electrodes. No support differs
    more from a half-space: around a contact, the surface moves sideways, away from the contact, rather than
    downwards. For loads with a standard deviation of 1, the median standard deviation of the normal
    displacement is :data:`LAYER_SHARE` pitches.
    """
    cells = LoadCells.of(layout)
    radius_m = math.sqrt(cells.size_m[0] * cells.size_m[1] / math.pi)  # disc with the area of a cell
    distance = np.linalg.norm(cells.offset_m, axis=-1)
    normal, outwards = bonded_layer_compliance(Rubber(), cells.height_m, distance, radius_m)
    direction = cells.offset_m / np.where(distance > 0.0, distance, 1.0)[..., None]
    compliance = np.concatenate([-outwards[..., None] * direction, normal[..., None]], axis=-1)
    response = cells.displacement(compliance[..., None])[..., 0]
    variance = np.median((normal**2).sum(axis=1))
    scale = LAYER_SHARE / math.sqrt(float(variance))
    found = np.ascontiguousarray(response.reshape(-1, response.shape[-1]) * scale)
    found.setflags(write=False)
    return found
