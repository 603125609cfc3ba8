"""Bound on the force of a contact whose layer is not calibrated.

Forces follow from the displacement of an elastic half-space. Real skin is a layer on a support. A layer of
incompressible rubber bonded to a rigid support is the stiffest support there is: for the same displacement it
carries more force, the more so the wider the contact is relative to the layer's thickness. Under Hertz's
pressure over a circle of radius a, a layer of thickness t sinks by

    δ = (1/2πG) ∫ p̂(k) f(k t) dk,   f(x) = (sinh 2x − 2x) / (cosh 2x + 1 + 2x²),   p̂(k) = ∫ p e^(ikx) d²x

where f = 1 is the half-space (Johnson, Contact Mechanics, 1985, 5.8; the thin-layer limit F ∝ G a⁴ δ / t³ is
that of Barber, Int. J. Mech. Sci. 32, 129, 1990). The ratio of the two forces at the same δ is a function of
a/t. Layers between the two need a force between the two. The sum of the pressing loads of the half-space is a
second bound: on thicker layers the pulling loads cancel part of it.
"""

from __future__ import annotations

import math
from typing import Final

from skinnode.model.elastic import Rubber

LINEAR: Final = 1.05
"""Coefficient of a/t in the ratio of the forces; fitted, with :data:`CUBIC`, to the integral above at a/t
from 0.05 to 20: within 12 %."""
CUBIC: Final = 0.51
"""Coefficient of (a/t)³ in the ratio of the forces."""
SPAN: Final = 2.5
"""Number of standard deviations from the half-space's force to the bonded layer's; a bound on the model, no
noise. With 3, the forces of layers of 2, 4, 8 and 16 mm, pressed over radii from 1.6 to 10 mm on a patch with
a clearance of 2 mm, were up to 4.3 standard deviations off; 2.5 keeps them within 5 with some margin."""


def stiffening(radius_m: float, thickness_m: float) -> float:
    """Return the ratio of the force of a bonded layer to that of a half-space at the same depth.

    Args:
        radius_m: Radius of the contact, metres.
        thickness_m: Thickness of the layer, metres.
    """
    ratio = radius_m / thickness_m
    return 1.0 + LINEAR * ratio + CUBIC * ratio**3


def bonded_force_n(rubber: Rubber, depth_m: float, radius_m: float, thickness_m: float) -> float:
    """Return the force in N that presses a bonded layer in by ``depth_m`` over a circle.

    Args:
        rubber: The material.
        depth_m: Depth at the centre of the contact, metres.
        radius_m: Radius of the contact, metres.
        thickness_m: Thickness of the layer, metres.
    """
    half_space_n = 4.0 / 3.0 * rubber.contact_modulus_pa * radius_m * depth_m
    return half_space_n * stiffening(radius_m, thickness_m)


def layer_std_n(bonded_n: float, force_n: float) -> float:
    """Return the standard deviation that reaches from the half-space's force to the bonded layer's, N."""
    return math.fabs(max(bonded_n - force_n, 0.0)) / SPAN
