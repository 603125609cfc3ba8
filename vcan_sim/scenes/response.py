"""Displacement of the electrodes, which lie on the surface, under the tractions of a window."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Layer, cell_response
from vcan_sim.contact.solve import Contact
from vcan_sim.scenes.shapes import Float

POINTS: Final = 4096
"""Points of the table of the response over the distance."""


@dataclass(frozen=True, eq=False)
class Electrodes:
    """Places at which the displacement of the surface is computed. Make one with :meth:`of`.

    Attributes:
        places_m: (E, 2) places in the frame of the patch, metres.
        surface_m: Height of the undeformed surface in the frame of the patch, metres.
    """

    places_m: Float
    surface_m: float
    _table: Float
    """(POINTS, 4) r Z, r A, r B and r K over the distance r, m²/N."""
    _step_m: float

    @classmethod
    def of(cls, layer: Layer, places_m: Float, surface_m: float) -> Electrodes:
        """Tabulate the response of a layer.

        Args:
            layer: The layer.
            places_m: (E, 2) places in the frame of the patch, metres.
            surface_m: Height of the undeformed surface in the frame of the patch, metres.
        """
        reach = 2.0 * float(np.linalg.norm(np.ptp(places_m, axis=0))) + 4.0 * min(layer.thickness_m, 0.01)
        reach = float(f"{reach:.1g}") * 1.5  # equal reaches share the table
        table, step = _radial(layer, reach)
        return cls(places_m, surface_m, table, step)

    def displacement_m(self, grid: Grid, origin_m: Float, contact: Contact) -> Float:
        """Return the displacement of the electrodes.

        Electrodes inside the window take the displacement of its cells, interpolated by cubics. All others
        are at least two cells from a loaded cell, whose traction then acts as a force at its centre.

        Args:
            grid: Cells of the window.
            origin_m: (2,) centre of the first cell in the frame of the patch, metres.
            contact: Contact in the window.

        Returns:
            (E, 3) displacement, metres.
        """
        moved = np.zeros((len(self.places_m), 3))
        index = (self.places_m - origin_m) / grid.size_m
        inside = ((index >= 1.0) & (index <= np.array(grid.shape) - 2.0)).all(axis=1)
        moved[inside] = _cubic(contact.displacement_m, index[inside])
        loaded = contact.traction_pa.any(axis=0)
        force = contact.traction_pa[:, loaded] * grid.size_m**2
        moved[~inside] = self._under_forces(self.places_m[~inside], grid.centres_m(origin_m)[loaded], force)
        return moved

    def _under_forces(self, places_m: Float, at_m: Float, force_n: Float) -> Float:
        """Return the displacement (P, 3) of places (P, 2) under forces (3, F) at places (F, 2)."""
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
    """Return the table of the response to a point force, and the distance between its points, metres."""
    r = np.linspace(0.0, reach_m, POINTS)
    step = float(r[1])
    size = 0.1 * step  # so small that the cell is a point at the first distance already
    offset = np.stack([r, np.zeros(POINTS)], axis=-1)
    response = cell_response(layer, offset, size, reach_m + size) / size**2
    along, across = response[:, 0, 0], response[:, 1, 1]
    table = np.stack(
        [response[:, 2, 2], 0.5 * (along + across), 0.5 * (along - across), response[:, 0, 2]], axis=-1
    )
    table *= r[:, None]
    table[0] = 2.0 * table[1] - table[2]
    table.setflags(write=False)
    return table, step


def _cubic(field: Float, index: Float) -> Float:
    """Return a field (3, X, Y) at fractional indices (P, 2), interpolated by cubics through 4 × 4 cells."""
    low = np.clip(np.floor(index).astype(np.intp) - 1, 0, np.array(field.shape[1:]) - 4)
    weights = _lagrange(index - low)
    found = np.zeros((len(index), 3))
    for i in range(4):
        for j in range(4):
            values = field[:, low[:, 0] + i, low[:, 1] + j]
            found += (weights[:, 0, i] * weights[:, 1, j] * values).T
    return found


def _lagrange(position: Float) -> Float:
    """Return the weights (…, 4) of the points 0, 1, 2, 3 for a cubic through them at ``position`` (…)."""
    points = np.arange(4.0)
    weights = np.ones((*position.shape, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[..., i] *= (position - points[j]) / (points[i] - points[j])
    return weights
