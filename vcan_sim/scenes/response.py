"""Displacement of the electrodes due to the tractions in a window of cells."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Layer, PointResponse
from vcan_sim.contact.solve import Contact
from vcan_sim.scenes.shapes import Float

BEYOND: Final = 20.0
"""Maximum range of the displacement-versus-distance table, as a multiple of the layer thickness. Beyond it,
the displacement is below ``FAR``."""
CLUSTER_CELLS: Final = 6.0
"""Distance from the window, in cells, beyond which each block of 2 × 2 cells acts as one point force."""
FAR: Final = 1e-5
"""Threshold below which the displacement due to a point force is neglected, relative to the maximum. In a
bonded layer, the displacement decays exponentially with distance from the force."""
POINTS: Final = 4096
"""Number of points in the table of displacement versus distance from a point force."""


@dataclass(frozen=True, eq=False)
class Electrodes:
    """Electrodes on the surface of an elastic layer. Create instances with :meth:`of`.

    Attributes:
        places_m: (E, 2) electrode positions in the patch frame, in metres.
        surface_m: Height of the undeformed surface in the patch frame, in metres.
    """

    places_m: Float
    surface_m: float
    _table: Float
    """(POINTS, 4) table of r Z, r A, r B and r K versus distance r, m²/N; see
    :class:`vcan_sim.contact.layer.PointResponse` for Z, A, B and K."""
    _step_m: float
    _far_m: float
    """Distance from a point force beyond which the displacement is neglected, in metres."""

    @classmethod
    def of(cls, layer: Layer, places_m: Float, surface_m: float) -> Electrodes:
        """Create electrodes, and tabulate the layer's displacement under a point force.

        Args:
            layer: Elastic layer.
            places_m: (E, 2) electrode positions in the patch frame, in metres.
            surface_m: Height of the undeformed surface in the patch frame, in metres.
        """
        reach = min(3.0 * float(np.linalg.norm(np.ptp(places_m, axis=0))) + 0.01, BEYOND * layer.thickness_m)
        table, step = _radial(layer, reach)
        noticed = np.flatnonzero((np.abs(table) > FAR * np.abs(table).max()).any(axis=1))
        return cls(places_m, surface_m, table, step, step * float(noticed[-1] + 1))

    def displacement_m(self, grid: Grid, origin_m: Float, contact: Contact) -> Float:
        """Return the displacement of the electrodes due to a contact.

        Inside the window, cubic polynomials interpolate the displacement of the cells. Outside, electrodes
        are at least two cells away from any loaded cell, so the traction on a cell is treated as a point
        force at its centre. Beyond ``CLUSTER_CELLS``, the forces on each block of 2 × 2 cells are lumped at
        the centre of the block.

        Args:
            grid: Cells of the window.
            origin_m: (2,) centre of the first cell in the patch frame, in metres.
            contact: State of the contact in the window.

        Returns:
            (E, 3) displacement, in metres.
        """
        moved = np.zeros((len(self.places_m), 3))
        index = (self.places_m - origin_m) / grid.size_m
        inside = ((index >= 1.0) & (index <= np.array(grid.shape) - 2.0)).all(axis=1)
        moved[inside] = _cubic(contact.displacement_m, index[inside])
        force = contact.traction_pa * grid.size_m**2
        last_m = origin_m + grid.size_m * (np.array(grid.shape) - 1.0)
        away = np.maximum(np.maximum(origin_m - self.places_m, self.places_m - last_m), 0.0)
        distance = np.hypot(away[:, 0], away[:, 1])
        near = ~inside & (distance < CLUSTER_CELLS * grid.size_m)
        far = ~inside & ~near & (distance < self._far_m)
        for places, (at, forces) in (
            (near, _forces(force, origin_m, grid.size_m)),
            (far, _forces(_clustered(force), origin_m + 0.5 * grid.size_m, 2.0 * grid.size_m)),
        ):
            if places.any():
                moved[places] = self._under_forces(self.places_m[places], at, forces)
        return moved

    def _under_forces(self, places_m: Float, at_m: Float, force_n: Float) -> Float:
        """Return the displacement (P, 3) in metres at positions (P, 2) under point forces (3, F)."""
        x = places_m[:, None, 0] - at_m[:, 0]
        y = places_m[:, None, 1] - at_m[:, 1]
        r = np.sqrt(x * x + y * y)
        position = np.minimum(r / self._step_m, POINTS - 1.001)
        below = position.astype(np.intp)
        share = (position - below)[..., None]
        row = self._table[below] * (1.0 - share) + self._table[below + 1] * share
        normal, mean, twofold, outwards = np.moveaxis(row / r[..., None], -1, 0)
        cos, sin = x / r, y / r
        cos2, sin2 = cos * cos - sin * sin, 2.0 * cos * sin
        fx, fy, fz = force_n
        moved_x = (mean + twofold * cos2) @ fx + (twofold * sin2) @ fy + (outwards * cos) @ fz
        moved_y = (twofold * sin2) @ fx + (mean - twofold * cos2) @ fy + (outwards * sin) @ fz
        moved_z = normal @ fz - (outwards * cos) @ fx - (outwards * sin) @ fy
        return np.stack([moved_x, moved_y, moved_z], axis=-1)


@functools.lru_cache(maxsize=64)
def _radial(layer: Layer, reach_m: float) -> tuple[Float, float]:
    """Return a table of displacement versus distance from a point force, and its step in metres.

    The half-space solution is due to Boussinesq and Cerruti (Johnson, Contact Mechanics, 1985, sections 3.2
    and 3.6). :class:`vcan_sim.contact.layer.PointResponse` adds the correction for a layer.
    """
    r = np.linspace(0.0, reach_m, POINTS)
    nu = layer.poisson
    half_space = np.array([1.0 - nu, 1.0 - 0.5 * nu, 0.5 * nu, 0.5 - nu])
    table = np.tile(half_space / (2.0 * math.pi * layer.shear_modulus_pa), (POINTS, 1))
    if math.isfinite(layer.thickness_m):
        table += r[:, None] * np.stack(PointResponse(layer, reach_m)(r), axis=-1)
    table.setflags(write=False)
    return table, float(r[1])


def _forces(force_n: Float, origin_m: Float, size_m: float) -> tuple[Float, Float]:
    """Return the positions (F, 2) in metres and forces (3, F) in N of the loaded cells in a window."""
    loaded = np.argwhere(force_n.any(axis=0))
    return origin_m + size_m * loaded, force_n[:, loaded[:, 0], loaded[:, 1]]


def _clustered(force_n: Float) -> Float:
    """Return the forces (3, X/2, Y/2) in N on blocks of 2 × 2 cells, given the forces (3, X, Y) on cells."""
    x, y = force_n.shape[1:]
    even = np.pad(force_n, ((0, 0), (0, x % 2), (0, y % 2)))
    return np.asarray(even.reshape(3, (x + 1) // 2, 2, (y + 1) // 2, 2).sum(axis=(2, 4)))


def _cubic(field: Float, index: Float) -> Float:
    """Interpolate a field (3, X, Y) at fractional indices (P, 2) using bicubic polynomials."""
    low = np.clip(np.floor(index).astype(np.intp) - 1, 0, np.array(field.shape[1:]) - 4)
    weights = _lagrange(index - low)
    found = np.zeros((len(index), 3))
    for i in range(4):
        for j in range(4):
            values = field[:, low[:, 0] + i, low[:, 1] + j]
            found += (weights[:, 0, i] * weights[:, 1, j] * values).T
    return found


def _lagrange(position: Float) -> Float:
    """Return the cubic Lagrange weights (…, 4) of the nodes 0, 1, 2 and 3 at ``position`` (…)."""
    points = np.arange(4.0)
    weights = np.ones((*position.shape, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[..., i] *= (position - points[j]) / (points[i] - points[j])
    return weights
