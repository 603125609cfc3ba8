"""Upper bound on a contact's normal force if the forces are not calibrated.

The solver computes forces from the displacement of an elastic half-space, but real skin is a layer on a
support. The stiffest case is a layer of incompressible rubber bonded to a rigid support. For the same
displacement, a bonded layer carries more force than a half-space; the ratio of the forces grows with the
ratio of contact radius to layer thickness. A Hertz pressure p over a circle of radius a indents a layer of
thickness t and shear modulus G by

    δ = (1/2πG) ∫ p̂(k) f(k t) dk,   f(x) = (sinh 2x − 2x) / (cosh 2x + 1 + 2x²),   p̂(k) = ∫ p e^(ikx) d²x

where f = 1 for the half-space (Johnson, Contact Mechanics, 1985, 5.8; the thin-layer limit F ∝ G a⁴ δ / t³ is
from Barber, International Journal of Mechanical Sciences 32, 129, 1990). At the same δ, the ratio of the
bonded layer's force to the half-space's force is a function of a/t. A real layer carries more force than the
half-space and less force than the bonded layer. On thick layers, the half-space model needs negative loads
that cancel part of the positive loads; the sum of the positive loads is therefore a second bound.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.model.elastic import Rubber

LINEAR: Final = 1.05
"""Coefficient of a/t in the ratio of the bonded layer's force to the half-space's force.

The coefficients LINEAR and CUBIC were fitted to the exact integral for a/t from 0.05 to 20; the error is at
most 12 %.
"""
CUBIC: Final = 0.51
"""Coefficient of (a/t)³ in the ratio of the bonded layer's force to the half-space's force."""
SPAN: Final = 2.5
"""Ratio of the difference between the two forces (bonded layer and half-space) to the reported standard
deviation. In tests, force errors were at most 4.3 standard deviations even with a ratio of 3; the value of
2.5 adds a margin."""


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
    """Return the standard deviation, N, that covers the difference between bonded layer and half-space."""
    return math.fabs(max(bonded_n - force_n, 0.0)) / SPAN
