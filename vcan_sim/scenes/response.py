"""Displacement of the electrodes, which lie on the surface, under the tractions of a window."""

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
"""Distance from a point force, in thicknesses of the layer, beyond which the response is below ``FAR``."""
CLUSTER_CELLS: Final = 6.0
"""Distance from the window, in cells, beyond which 2 × 2 cells act as one force."""
FAR: Final = 1e-5
"""Response to a point force, relative to that next to the force, below which it counts as zero. The response
of a layer falls exponentially with the distance."""
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
    _far_m: float
    """Distance from which the response is negligible, metres."""

    @classmethod
    def of(cls, layer: Layer, places_m: Float, surface_m: float) -> Electrodes:
        """Tabulate the response of a layer.

        Args:
            layer: The layer.
            places_m: (E, 2) places in the frame of the patch, metres.
            surface_m: Height of the undeformed surface in the frame of the patch, metres.
        """
        reach = min(3.0 * float(np.linalg.norm(np.ptp(places_m, axis=0))) + 0.01, BEYOND * layer.thickness_m)
        table, step = _radial(layer, reach)
        noticed = np.flatnonzero((np.abs(table) > FAR * np.abs(table).max()).any(axis=1))
        return cls(places_m, surface_m, table, step, step * float(noticed[-1] + 1))

    def displacement_m(self, grid: Grid, origin_m: Float, contact: Contact) -> Float:
        """Return the displacement of the electrodes.

        Electrodes inside the window take the displacement of its cells, interpolated by cubics. All others
        are at least two cells from a loaded cell, whose traction then acts as a force at its centre. At a
        distance of ``CLUSTER_CELLS`` from the window, the force of 2 × 2 cells acts at their centre.

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
    """Return the table of the response to a point force, and the distance between its points, metres.

    On a half-space it is the solution of Boussinesq and Cerruti (Johnson, Contact Mechanics, 1985, sections
    3.2 and 3.6); :class:`vcan_sim.contact.layer.PointResponse` is the difference of a layer.
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
    """Return the places (F, 2), metres, and the forces (3, F), N, that are not zero of cells (3, X, Y)."""
    loaded = np.argwhere(force_n.any(axis=0))
    return origin_m + size_m * loaded, force_n[:, loaded[:, 0], loaded[:, 1]]


def _clustered(force_n: Float) -> Float:
    """Return the sums (3, X/2, Y/2) of 2 × 2 cells each of forces (3, X, Y), N."""
    x, y = force_n.shape[1:]
    even = np.pad(force_n, ((0, 0), (0, x % 2), (0, y % 2)))
    return np.asarray(even.reshape(3, (x + 1) // 2, 2, (y + 1) // 2, 2).sum(axis=(2, 4)))


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
