"""Elastic prior: the displacement of the rubber expected before any resistance is measured.

Each electrode site is in the centre of a cell one pitch wide. Independent surface loads on the cells displace
the electrodes by the response G of an elastic half-space (Boussinesq, Cerruti;
:func:`skinnode.model.elastic.rectangle_compliance`). The prior of the displacement u is

    u ~ N(0, s² C),   C = G diag(q) Gᵀ + ε² I

One scale s for the whole patch is estimated from the data. The cells extend beyond the outermost electrodes,
because the skin can also be pressed there. The term with ε allows for small independent deviations of each
electrode from the half-space.

Curved skin is unrolled: distances are chords, and the response to a load is expressed in the tangent frame
of each electrode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.elastic import Rubber, rectangle_compliance
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.linalg.cholesky import multiply

MARGIN: Final = 2
"""Number of rings of cells beyond the outermost electrodes. A third and a fourth ring would change the
evidence for Hertz presses by less than 1 in 800, whether the press is on the patch or half outside it."""
SHEAR_SHARE: Final = 0.4
"""Ratio of the standard deviations of shear and normal loads; a contact that slides with a friction
coefficient of 0.6 has a shear load of 1.5 standard deviations. The evidence changes by 2 % between ratios of
0.25 and 0.4. With smaller ratios, the standard deviations are too small on layouts that are insensitive to
shear (`aligned`)."""
SLACK: Final = 0.005
"""Ratio of ε to the standard deviation of the normal displacement. It keeps C regular. Values from 0.001 to
0.02 give the same results."""


@dataclass(frozen=True, eq=False)
class ElasticPrior:
    """Elastic prior of one layout for s = 1.

    The median standard deviation of the normal displacement is 1 pitch.
    """

    covariance: Float
    """(3UN, 3UN) covariance C of the displacement, pitch²."""
    response: Float
    """(3UN, 3Q) displacement per unit load, pitches; loads have a standard deviation of 1 at s = 1."""
    load_n: Float
    """(3,) force of a unit load along the wire, across the wire and along the normal, N."""
    cell_m: Float
    """(Q, 3) centres of the cells, m."""
    frame: Float
    """(Q, 3, 3) unit vectors as rows: tangent along the wire, tangent across the wire, outward normal."""
    cell_area_m2: float
    """Area of a cell, m²."""
    shape: tuple[int, int]
    """Number of cells across and along the wires; their product is Q."""

    @classmethod
    def of(cls, layout: PatchLayout, rubber: Rubber | None = None) -> ElasticPrior:
        """Return the prior for ``layout`` on ``rubber``; the rubber's modulus only scales the forces."""
        rubber = Rubber() if rubber is None else rubber
        wires, electrodes = layout.upper_m.shape[:2]
        cell, along, across, normal = _lattice(layout)
        shape = (cell.shape[0], cell.shape[1])
        size = (
            float(np.median(np.linalg.norm(along, axis=-1))),
            float(np.median(np.linalg.norm(across, axis=-1))),
        )
        first = along / np.linalg.norm(along, axis=-1, keepdims=True)
        first = first - (first * normal).sum(axis=-1, keepdims=True) * normal
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        frame = np.stack([first, np.cross(normal, first), normal], axis=-2)
        inner = slice(MARGIN, MARGIN + wires), slice(MARGIN, MARGIN + electrodes)
        own = frame[inner].reshape(-1, 3, 3)
        cell, frame = cell.reshape(-1, 3), frame.reshape(-1, 3, 3)
        gap = layout.upper_m.reshape(-1, 1, 3) - cell  # (UN, Q, 3)
        flat = np.einsum("eqi,qti->eqt", gap, frame[:, :2])
        chord, length = np.linalg.norm(gap, axis=-1), np.linalg.norm(flat, axis=-1)
        flat *= np.where(length > 0, chord / np.where(length > 0, length, 1.0), 1.0)[..., None]
        local = rectangle_compliance(rubber, flat.reshape(-1, 2), size).reshape(*chord.shape, 3, 3)
        response = np.einsum("eti,eqtl->eiql", own, local)
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
        return cls(covariance, response, load_n, cell, frame, area, shape)

    def own_cells(self) -> NDArray[np.int64]:
        """Return the indices (U, N) of the cells around the electrodes."""
        index = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        return index[MARGIN : self.shape[0] - MARGIN, MARGIN : self.shape[1] - MARGIN]


def _lattice(layout: PatchLayout) -> tuple[Float, Float, Float, Float]:
    """Return the electrode sites, extended by :data:`MARGIN` sites at each edge, and their surface.

    The sites (U + 2 MARGIN, N + 2 MARGIN, 3) are in m. The surface consists of the steps along and across the
    wires, m, and the unit normals, which point away from the lower layer.
    """
    site = layout.upper_m
    lower = layout.lower_m.reshape(-1, 3)
    nearest = np.argmin(((site[:, :, None] - lower) ** 2).sum(axis=-1), axis=-1)
    up = (site - lower[nearest]).mean(axis=(0, 1))
    wires, electrodes = site.shape[:2]
    if min(wires, electrodes) == 1:  # a single row of electrodes defines no surface, so use the lower layer
        flat = np.linalg.svd(lower - lower.mean(axis=0))[2][-1]
        up = flat * np.sign(flat @ up) if len(lower) > 2 and flat @ up != 0 else up
    up = up / np.linalg.norm(up)
    if electrodes > 1:
        along = np.gradient(site, axis=1)
    else:  # a wire with one electrode has no direction of its own, so derive one
        axis = np.diff(site[:, 0], axis=0).mean(axis=0) if wires > 1 else np.eye(3)[np.argmin(np.abs(up))]
        along = np.broadcast_to(_sized(np.cross(axis, up), layout.pitch_m), site.shape)
    if wires > 1:
        across = np.gradient(site, axis=0)
    else:
        across = np.stack([_sized(np.cross(up, step), layout.pitch_m) for step in along[0]])[None]
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    if float((normal * up).sum(axis=-1).mean()) < 0:
        normal = -normal
    fields = _carried_on((site, along, across, normal), 0, across)
    return _carried_on(fields, 1, fields[1])


def _sized(direction: Float, length: float) -> Float:
    return np.asarray(direction * (length / np.linalg.norm(direction)))


def _carried_on(
    fields: tuple[Float, Float, Float, Float], axis: int, step: Float
) -> tuple[Float, Float, Float, Float]:
    """Extrapolate sites linearly by :data:`MARGIN` rows at each end of ``axis``; repeat steps and normals."""
    pad = [(MARGIN, MARGIN) if i == axis else (0, 0) for i in range(3)]
    site, along, across, normal = fields
    along, across, normal = (np.pad(field, pad, mode="edge") for field in (along, across, normal))
    shape = [MARGIN if i == axis else 1 for i in range(3)]
    count = np.arange(MARGIN, 0, -1).reshape(shape)
    before = np.take(site, [0], axis) - count * np.take(step, [0], axis)
    after = np.take(site, [-1], axis) + np.flip(count, axis) * np.take(step, [-1], axis)
    return np.concatenate([before, site, after], axis), along, across, normal
