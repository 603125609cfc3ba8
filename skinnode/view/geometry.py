"""Shapes drawn in 3-D, as arrays in patch coordinates: the surface, its edge and the contacts.

A surface is the (U, N, 3) grid of upper electrodes, in metres. The first index counts the upper wires (y),
the second the electrodes along a wire (x), and z points out of the skin.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import Contact
from skinnode.model.layout import Float

RING_POINTS: Final = 33
"""Number of points in the circle around a contact; the last point equals the first."""


def triangles(wires: int, electrodes: int) -> NDArray[np.uint32]:
    """Return the (T, 3) triangles of a grid, as indices into its points in row-major order.

    Each grid cell consists of two triangles, counter-clockwise as seen from outside the skin. A grid with one
    row or one column has no triangles.

    Args:
        wires: Number of rows, U.
        electrodes: Number N of points per row.
    """
    index = np.arange(wires * electrodes, dtype=np.uint32).reshape(wires, electrodes)
    here, right, above, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    halves = [np.stack(corners, axis=-1) for corners in ((here, right, across), (here, across, above))]
    return np.stack(halves, axis=2).reshape(-1, 3)


def normals(surface_m: Float) -> Float:
    """Return the (U, N, 3) unit normals of a surface, pointing out of the skin.

    A normal is perpendicular to the differences between neighbouring points: central differences inside the
    grid, one-sided differences at its edge. Where the surface is degenerate, the normal is the z axis.

    Args:
        surface_m: (U, N, 3) points, in m.
    """
    if min(surface_m.shape[:2]) < 2:
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), surface_m.shape).copy()
    # np.gradient and np.cross are three times slower
    along, across = np.empty_like(surface_m), np.empty_like(surface_m)
    along[:, 1:-1] = surface_m[:, 2:] - surface_m[:, :-2]
    along[:, 0], along[:, -1] = surface_m[:, 1] - surface_m[:, 0], surface_m[:, -1] - surface_m[:, -2]
    across[1:-1] = surface_m[2:] - surface_m[:-2]
    across[0], across[-1] = surface_m[1] - surface_m[0], surface_m[-1] - surface_m[-2]
    (ax, ay, az), (bx, by, bz) = np.moveaxis(along, -1, 0), np.moveaxis(across, -1, 0)
    made = np.empty_like(surface_m)
    made[..., 0], made[..., 1], made[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(np.einsum("...i,...i", made, made))
    flat = length <= np.finfo(np.float64).tiny
    if flat.any():
        made[flat] = 0.0, 0.0, 1.0
        length[flat] = 1.0
    made /= length[..., None]
    return made


def displaced_m(rest_m: Float, displacement_m: Float, exaggeration: float) -> Float:
    """Return the (U, N, 3) surface in m with exaggerated displacement; unknown displacements count as zero.

    Args:
        rest_m: (U, N, 3) positions of the electrodes at rest, in m.
        displacement_m: (U, N, 3) displacements, in m; NaN where unknown.
        exaggeration: Ratio of drawn to measured displacement.
    """
    return rest_m + exaggeration * np.where(np.isfinite(displacement_m), displacement_m, 0.0)


def edge_m(surface_m: Float) -> Float:
    """Return a surface's edge as a closed (P, 3) line in m, counter-clockwise as seen from outside the skin.

    Args:
        surface_m: (U, N, 3) points, in m.
    """
    sides = (surface_m[0], surface_m[1:, -1], surface_m[-1, -2::-1], surface_m[-2::-1, 0])
    line = np.concatenate(sides)
    return line if np.array_equal(line[-1], line[0]) else np.concatenate([line, line[:1]])


def ring_m(contact: Contact, lift_m: float) -> Float:
    """Return a closed (:data:`RING_POINTS`, 3) circle in m with the same area as a contact.

    Args:
        contact: Contact in patch coordinates.
        lift_m: Height of the circle above the undeformed skin, in m.
    """
    radius_m = math.sqrt(max(contact.area_m2, 0.0) / math.pi)
    angle = np.linspace(0.0, 2.0 * math.pi, RING_POINTS)
    x, y, out = contact.axes
    circle = radius_m * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y)
    return np.asarray(contact.centroid_m + lift_m * out + circle)


def force_n(contact: Contact) -> Float:
    """Return a contact's (3,) force on the skin, in N and in patch coordinates.

    Args:
        contact: Contact; a positive normal force points into the skin.
    """
    local = np.array([contact.shear_force_n[0], contact.shear_force_n[1], -contact.normal_force_n])
    return np.asarray(local @ contact.axes)
