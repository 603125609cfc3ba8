"""Surface displacement of an incompressible elastic layer bonded to a rigid base, under normal loads.

In the Fourier domain, with the wave number k, the thickness h, x = k h and the shear modulus G, a normal
pressure of amplitude 1 displaces the surface by the amplitudes

    normal      (sinh 2x − 2x) / (2 G k (cosh 2x + 1 + 2x²))
    outwards            x²     / (  G k (cosh 2x + 1 + 2x²))

The normal displacement is in the direction of the load. The outward displacement is along the surface, away
from the load, with a phase shift of 90°. Both formulas follow from the biharmonic stream function of an
incompressible layer, with no displacement at z = −h and no shear traction at z = 0. For x → ∞ the normal
displacement is that of a half-space, 1 / (2 G k), and the outward displacement vanishes.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.special import j0, j1

from skinnode.model.elastic import Rubber
from skinnode.model.layout import Float

BLUR: Final = 0.1
"""Standard deviation of the Gaussian that blurs the rim of the load, relative to the radius of the load. The
blur limits the wave numbers that contribute to the displacement."""
_END: Final = 6.0
"""Upper limit of the integral over the wave number, times the standard deviation of the blur. At this limit,
the blur attenuates the Fourier transform of the load to 1e-8 of its value."""
_NODES_PER_WAVE: Final = 8
"""Number of quadrature nodes per period of the Bessel functions at the largest distance."""


def bonded_layer_compliance(
    rubber: Rubber, thickness_m: float, distance_m: Float, radius_m: float
) -> tuple[Float, Float]:
    """Return the displacement of the surface per unit normal force on a disc.

    Args:
        rubber: The material; its Poisson's ratio is taken as 0.5.
        thickness_m: Thickness h of the layer, m.
        distance_m: Distance of each surface point from the centre of the load, m; any shape.
        radius_m: Radius of the disc, m; the pressure is uniform except for the blurred rim (:data:`BLUR`).

    Returns:
        Two displacements per unit force, m/N, each with the shape of ``distance_m``. The first is normal to
        the surface, in the direction of the force. The second is tangential; it is positive away from the
        load if the force presses on the layer, and positive towards the load if the force pulls.

    Raises:
        ValueError: If the thickness or the radius is not positive and finite.
    """
    for name, value in (("thickness_m", thickness_m), ("radius_m", radius_m)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: got {value}, must be positive and finite")
    distance = np.asarray(distance_m, np.float64)
    end = _END / (BLUR * radius_m)
    longest = max(float(distance.max(initial=0.0)), thickness_m, radius_m)
    count = max(64, math.ceil(_NODES_PER_WAVE * end * longest / (2.0 * math.pi)))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    panels = math.ceil(count / len(nodes))
    k = (0.5 * end / panels) * (nodes + 2.0 * np.arange(panels)[:, None] + 1.0).reshape(-1)
    disc = 2.0 * j1(k * radius_m) / (k * radius_m) * np.exp(-0.5 * (BLUR * k * radius_m) ** 2)
    weight = np.tile(weights, panels) * (0.5 * end / panels) * disc
    x = np.minimum(k * thickness_m, 300.0)
    below = 2.0 * rubber.shear_modulus_pa * (np.cosh(2.0 * x) + 1.0 + 2.0 * x**2)
    normal = weight * (np.sinh(2.0 * x) - 2.0 * x) / below / (2.0 * math.pi)
    outwards = weight * 2.0 * x**2 / below / (2.0 * math.pi)
    different, where = np.unique(distance, return_inverse=True)
    of_normal, of_outwards = np.empty((2, different.size))
    for first in range(0, different.size, 256):
        waves = np.outer(different[first : first + 256], k)
        of_normal[first : first + 256] = j0(waves) @ normal
        of_outwards[first : first + 256] = j1(waves) @ outwards
    return of_normal[where].reshape(distance.shape), of_outwards[where].reshape(distance.shape)
