"""Upper bound on the force of a contact on an uncalibrated layer.

The solver computes forces from the displacement of an elastic half-space, but real skin is a layer on a
support. The stiffest case is a layer of incompressible rubber bonded to a rigid support. For the same
displacement, such a layer carries more force than the half-space, and the ratio grows with the width of the
contact relative to the layer's thickness. Under Hertz's pressure over a circle of radius a, a layer of
thickness t is indented by

    δ = (1/2πG) ∫ p̂(k) f(k t) dk,   f(x) = (sinh 2x − 2x) / (cosh 2x + 1 + 2x²),   p̂(k) = ∫ p e^(ikx) d²x

where f = 1 for the half-space (Johnson, Contact Mechanics, 1985, 5.8; the thin-layer limit F ∝ G a⁴ δ / t³ is
from Barber, International Journal of Mechanical Sciences 32, 129, 1990). At the same δ, the ratio of the
bonded layer's force to the half-space's force is a function of a/t. The force on any real layer is between
these two limits. The sum of the half-space's pressing loads is a second bound: on thicker layers, pulling
loads cancel part of this sum.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.model.elastic import Rubber

LINEAR: Final = 1.05
"""Coefficient of a/t in the ratio of the bonded layer's force to the half-space's force.

This coefficient and :data:`CUBIC` were fitted to the exact integral for a/t from 0.05 to 20; the error is at
most 12 %.
"""
CUBIC: Final = 0.51
"""Coefficient of (a/t)³ in the ratio of the bonded layer's force to the half-space's force."""
SPAN: Final = 2.5
"""Difference between the half-space's force and the bonded layer's force, in standard deviations. This
standard deviation represents a bound on the model error rather than noise. At a value of 3, force errors
reached 4.3 standard deviations (layers of 2, 4, 8 and 16 mm, contact radii from 1.6 to 10 mm, clearance of
2 mm). A value of 2.5 keeps force errors below 5 standard deviations with some margin."""


def stiffening(radius_m: float, thickness_m: float) -> float:
    """Return the ratio of a bonded layer's force to a half-space's force at the same indentation depth.

    Args:
        radius_m: Radius of the contact, metres.
        thickness_m: Thickness of the layer, metres.
    """
    ratio = radius_m / thickness_m
    return 1.0 + LINEAR * ratio + CUBIC * ratio**3


def bonded_force_n(rubber: Rubber, depth_m: float, radius_m: float, thickness_m: float) -> float:
    """Return the force in N that indents a bonded layer by ``depth_m`` over a circular contact.

    Args:
        rubber: The material.
        depth_m: Depth at the centre of the contact, metres.
        radius_m: Radius of the contact, metres.
        thickness_m: Thickness of the layer, metres.
    """
    half_space_n = 4.0 / 3.0 * rubber.contact_modulus_pa * radius_m * depth_m
    return half_space_n * stiffening(radius_m, thickness_m)


def layer_std_n(bonded_n: float, force_n: float) -> float:
    """Return the force difference between bonded layer and half-space as a standard deviation, N."""
    return math.fabs(max(bonded_n - force_n, 0.0)) / SPAN
