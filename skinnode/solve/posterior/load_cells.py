"""Cells on which surface loads act: one around each electrode, and rings of cells beyond the edge.

Curved skin is unrolled. Distances are chords, and the response to a load is expressed in the tangent frame of
each electrode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float, PatchLayout

MARGIN: Final = 2
"""Number of rings of cells beyond the outermost electrodes. In tests with Hertz presses on the patch and
across its edge, more rings hardly changed the marginal likelihood."""


@dataclass(frozen=True, eq=False)
class LoadCells:
    """Cells of one layout, with E = U N electrodes and Q cells."""

    centre_m: Float
    """(Q, 3) centres of the cells, in m."""
    frame: Float
    """(Q, 3, 3) unit vectors as rows: tangent along the wire, tangent across the wire, outward normal."""
    electrode_frame: Float
    """(E, 3, 3) unit vectors at the electrodes, in the order of ``frame``."""
    offset_m: Float
    """(E, Q, 2) offset of each electrode from each cell, along the tangents of the cell, in m."""
    height_m: float
    """Median height of the electrodes above the lower layer, in m."""
    size_m: tuple[float, float]
    """Size of a cell along and across the wires, in m."""
    shape: tuple[int, int]
    """Numbers of cells across and along the wires; their product is Q."""

    @classmethod
    def of(cls, layout: PatchLayout) -> LoadCells:
        """Return the cells of ``layout``."""
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
        gap = layout.upper_m.reshape(-1, 1, 3) - cell  # (E, Q, 3)
        flat = np.einsum("eqi,qti->eqt", gap, frame[:, :2])
        chord, length = np.linalg.norm(gap, axis=-1), np.linalg.norm(flat, axis=-1)
        flat *= np.where(length > 0, chord / np.where(length > 0, length, 1.0), 1.0)[..., None]
        lower = layout.lower_m.reshape(-1, 3)
        up = layout.upper_m - lower[_nearest(layout.upper_m, lower)]
        height = float(np.median(np.abs((up.reshape(-1, 3) * own[:, 2]).sum(axis=-1))))
        return cls(cell, frame, own, flat, height, size, shape)

    def displacement(self, compliance: Float) -> Float:
        """Return the displacements (E, 3, Q, L) per unit load in the axes of the patch, in m.

        Args:
            compliance: (E, Q, 3, L) displacements per unit load along the tangents and the normal of the
                electrode, in m.
        """
        return np.asarray(np.einsum("eti,eqtl->eiql", self.electrode_frame, compliance))


def _lattice(layout: PatchLayout) -> tuple[Float, Float, Float, Float]:
    """Return the sites of the cells, the steps along and across the wires, and the surface normals.

    The lattice consists of the electrode sites and :data:`MARGIN` additional rows at each edge. Each array
    has the shape (U + 2 MARGIN, N + 2 MARGIN, 3). Sites and steps are in m. The normals are unit vectors that
    point away from the lower layer.
    """
    site = layout.upper_m
    lower = layout.lower_m.reshape(-1, 3)
    up = (site - lower[_nearest(site, lower)]).mean(axis=(0, 1))
    wires, electrodes = site.shape[:2]
    if min(wires, electrodes) == 1:  # a single row defines no plane; use the plane of the lower layer
        flat = np.linalg.svd(lower - lower.mean(axis=0))[2][-1]
        up = flat * np.sign(flat @ up) if len(lower) > 2 and flat @ up != 0 else up
    up = up / np.linalg.norm(up)
    if electrodes > 1:
        along = np.gradient(site, axis=1)
    else:  # a single electrode gives no wire direction; derive it
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


def _nearest(site: Float, lower: Float) -> NDArray[np.intp]:
    """Return the index (U, N) of the lower electrode nearest to each site."""
    return np.asarray(np.argmin(((site[:, :, None] - lower) ** 2).sum(axis=-1), axis=-1))


def _sized(direction: Float, length: float) -> Float:
    return np.asarray(direction * (length / np.linalg.norm(direction)))


def _carried_on(
    fields: tuple[Float, Float, Float, Float], axis: int, step: Float
) -> tuple[Float, Float, Float, Float]:
    """Add :data:`MARGIN` rows at each end of ``axis``: extrapolated sites, repeated steps and normals."""
    pad = [(MARGIN, MARGIN) if i == axis else (0, 0) for i in range(3)]
    site, along, across, normal = fields
    along, across, normal = (np.pad(field, pad, mode="edge") for field in (along, across, normal))
    shape = [MARGIN if i == axis else 1 for i in range(3)]
    count = np.arange(MARGIN, 0, -1).reshape(shape)
    before = np.take(site, [0], axis) - count * np.take(step, [0], axis)
    after = np.take(site, [-1], axis) + np.flip(count, axis) * np.take(step, [-1], axis)
    return np.concatenate([before, site, after], axis), along, across, normal
