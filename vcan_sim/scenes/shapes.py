"""Shapes of rigid bodies, defined by the height of their lower surface.

A shape maps positions (…, 2) in the body frame to heights (…,) above the lowest point of the body, both in
metres. The height is inf at positions outside the body.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Height = Callable[[Float], Float]


@dataclass(frozen=True, slots=True)
class Shape:
    """Shape of a rigid body.

    Attributes:
        height: Function that maps positions (…, 2) in the body frame to heights (…,) above the lowest point,
            metres.
        round: Whether the height depends only on the horizontal distance from the lowest point.
        key: Values that determine the height. Shapes with equal keys are equal.
    """

    height: Height
    round: bool
    key: tuple[object, ...]

    def over(self, places_m: Float, yaw_rad: float) -> Float:
        """Return the heights of the rotated body at given positions.

        Args:
            places_m: (…, 2) positions relative to the lowest point of the body, along the axes of the patch,
                metres.
            yaw_rad: Rotation of the body about z, rad.

        Returns:
            (…,) heights above the lowest point, in metres; inf outside the body.
        """
        if self.round or yaw_rad == 0.0:
            return self.height(places_m)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        x, y = places_m[..., 0], places_m[..., 1]
        return self.height(np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1))


def ellipsoid(radii_m: tuple[float, float, float], name: str = "ellipsoid") -> Shape:
    """Return the shape of an ellipsoid whose lowest point is on its z axis.

    Args:
        radii_m: Semi-axes along x, y and z, metres, each positive.
        name: Name of the shape, the first part of its key.
    """
    rx, ry, rz = radii_m

    def height(places_m: Float) -> Float:
        inside = 1.0 - (places_m[..., 0] / rx) ** 2 - (places_m[..., 1] / ry) ** 2
        return np.where(inside > 0.0, rz * (1.0 - np.sqrt(np.maximum(inside, 0.0))), math.inf)

    return Shape(height, rx == ry, (name, *radii_m))


def sphere(radius_m: float) -> Shape:
    """Return the shape of a sphere.

    Args:
        radius_m: Radius, in metres.
    """
    return ellipsoid((radius_m, radius_m, radius_m), "sphere")


def punch(radius_m: float, edge_radius_m: float) -> Shape:
    """Return the shape of a flat circular punch with a rounded rim.

    Args:
        radius_m: Radius of the punch including its rim, in metres.
        edge_radius_m: Rounding radius of the rim, in metres; at most ``radius_m``, 0 for a sharp rim.
    """
    flat = radius_m - edge_radius_m

    def height(places_m: Float) -> Float:
        r = np.hypot(places_m[..., 0], places_m[..., 1])
        return np.where(r <= radius_m, _rounded(np.maximum(r - flat, 0.0), edge_radius_m), math.inf)

    return Shape(height, True, ("punch", radius_m, edge_radius_m))


def box_edge(length_m: float, slope_rad: float, edge_radius_m: float) -> Shape:
    """Return the shape of a downward-pointing box edge along x, with a flank on each side.

    Args:
        length_m: Length of the edge along x, in metres.
        slope_rad: Angle between each flank and the skin, rad.
        edge_radius_m: Rounding radius of the edge, in metres.
    """
    tangent_m = edge_radius_m * math.sin(slope_rad)  # half width of the rounded part
    tangent_height_m = edge_radius_m * (1.0 - math.cos(slope_rad))

    def height(places_m: Float) -> Float:
        across = np.abs(places_m[..., 1])
        flank = tangent_height_m + (across - tangent_m) * math.tan(slope_rad)
        risen = np.where(across <= tangent_m, _rounded(np.minimum(across, tangent_m), edge_radius_m), flank)
        return np.where(np.abs(places_m[..., 0]) <= 0.5 * length_m, risen, math.inf)

    return Shape(height, False, ("box_edge", length_m, slope_rad, edge_radius_m))


def ridge(radius_m: float, length_m: float) -> Shape:
    """Return the shape of a cylinder along x with hemispherical ends.

    Args:
        radius_m: Radius of the cylinder, in metres.
        length_m: Length of the cylinder, excluding its hemispherical ends, in metres.
    """

    def height(places_m: Float) -> Float:
        beyond = np.maximum(np.abs(places_m[..., 0]) - 0.5 * length_m, 0.0)
        r = np.hypot(beyond, places_m[..., 1])
        return np.where(r < radius_m, _rounded(np.minimum(r, radius_m), radius_m), math.inf)

    return Shape(height, False, ("ridge", radius_m, length_m))


def _rounded(distance_m: Float, radius_m: float) -> Float:
    """Return the height of a circle above its lowest point at a given horizontal distance from that point."""
    return np.asarray(radius_m - np.sqrt(np.maximum(radius_m**2 - distance_m**2, 0.0)))
