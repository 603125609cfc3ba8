"""Upper bound on the normal force of a contact, for uncalibrated forces.

The solver computes forces for an elastic half-space, but the skin is a layer on a support. The stiffest case
is a layer of incompressible rubber bonded to a rigid support. At the same displacement, this bonded layer
carries more force than a half-space, and the ratio grows with the contact radius divided by the layer
thickness. A Hertz pressure p over a circle of radius a indents a bonded layer of thickness t and shear
modulus G by

    δ = (1/2πG) ∫ p̂(k) f(k t) dk,   f(x) = (sinh 2x − 2x) / (cosh 2x + 1 + 2x²),   p̂(k) = ∫ p e^(ikx) d²x

where f = 1 for the half-space (Johnson, Contact Mechanics, 1985, section 5.8; the thin-layer limit
F ∝ G a⁴ δ / t³ is from Barber, International Journal of Mechanical Sciences 32, 129, 1990). At the same δ,
the ratio of the two forces depends only on a/t. The force on a real layer is between the forces on the
half-space and on the bonded layer. On thick layers, the half-space model needs negative loads, which cancel
part of the positive loads; the sum of the positive loads is therefore a second bound.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.model.elastic import Rubber

LINEAR: Final = 1.05
"""Coefficient of a/t in the ratio of the force on a bonded layer to that on a half-space.

LINEAR and CUBIC were fitted to the exact integral for a/t from 0.05 to 20. The error in the ratio is at most
12 %.
"""
CUBIC: Final = 0.51
"""Coefficient of (a/t)³ in the ratio of the force on a bonded layer to that on a half-space."""
SPAN: Final = 2.5
"""Difference between the forces on the bonded layer and on the half-space, in reported standard deviations.

With a value of 3, force errors in tests were at most 4.3 standard deviations; a value of 2.5 adds a margin.
"""


def stiffening(radius_m: float, thickness_m: float) -> float:
    """Return the ratio of the force on a bonded layer to that on a half-space at the same depth.

    Args:
        radius_m: Radius of the contact, in metres.
        thickness_m: Thickness of the layer, in metres.
    """
    ratio = radius_m / thickness_m
    return 1.0 + LINEAR * ratio + CUBIC * ratio**3


def bonded_force_n(rubber: Rubber, depth_m: float, radius_m: float, thickness_m: float) -> float:
    """Return the force, in N, that indents a bonded layer by ``depth_m`` in a circular contact.

    Args:
        rubber: The material.
        depth_m: Depth at the centre of the contact, in metres.
        radius_m: Radius of the contact, in metres.
        thickness_m: Thickness of the layer, in metres.
    """
    half_space_n = 4.0 / 3.0 * rubber.contact_modulus_pa * radius_m * depth_m
    return half_space_n * stiffening(radius_m, thickness_m)


def layer_std_n(bonded_n: float, force_n: float) -> float:
    """Return a standard deviation, in N, that covers the force on a bonded layer.

    Args:
        bonded_n: Force on a bonded layer, in N.
        force_n: Force on a half-space, in N.
    """
    return math.fabs(max(bonded_n - force_n, 0.0)) / SPAN
