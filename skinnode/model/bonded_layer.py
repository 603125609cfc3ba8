"""Surface displacement of an incompressible elastic layer on a rigid base, under normal loads.

The layer has thickness h and shear modulus G, and is bonded to the base. A sinusoidal pressure with wave
number k and amplitude 1 displaces the surface by the following amplitudes, where x = k h:

    normal      (sinh 2x − 2x) / (2 G k (cosh 2x + 1 + 2x²))
    outwards            x²     / (  G k (cosh 2x + 1 + 2x²))

The normal displacement has the direction of the pressure. The outward displacement is tangential, points away
from the load, and has a phase shift of 90°. Both formulas follow from the biharmonic stream function of an
incompressible layer with zero displacement at z = −h and zero shear traction at z = 0. For x → ∞, the normal
displacement approaches the half-space value, 1 / (2 G k), and the outward displacement vanishes.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import scipy

from skinnode.model.elastic import Rubber
from skinnode.model.layout import Float

BLUR: Final = 0.1
"""Standard deviation of the Gaussian that smooths the edge of the load, relative to the load's radius.
Without smoothing, the integral over the wave number would converge too slowly.
"""
_END: Final = 6.0
"""Upper limit of the integral over the wave number, multiplied by the standard deviation of the Gaussian. At
this limit, the Gaussian attenuates the Fourier transform of the load by a factor of 1e-8.
"""
_NODES_PER_WAVE: Final = 8
"""Number of quadrature nodes per period of the Bessel functions at the largest distance."""


def bonded_layer_compliance(
    rubber: Rubber, thickness_m: float, distance_m: Float, radius_m: float
) -> tuple[Float, Float]:
    """Return the displacement of surface points per unit normal force on a disc.

    Args:
        rubber: The material; Poisson's ratio is assumed to be 0.5.
        thickness_m: Thickness h of the layer, in metres.
        distance_m: Distance of each surface point from the centre of the disc, in metres; any shape.
        radius_m: Radius of the disc, in metres. The pressure is uniform except at the smoothed edge
            (:data:`BLUR`).

    Returns:
        Normal and tangential displacement per unit force, in m/N, each with the shape of ``distance_m``. The
        normal displacement has the direction of the force. Under a pressing force, a positive tangential
        displacement points away from the load.

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
    disc = 2.0 * scipy.special.j1(k * radius_m) / (k * radius_m) * np.exp(-0.5 * (BLUR * k * radius_m) ** 2)
    weight = np.tile(weights, panels) * (0.5 * end / panels) * disc
    x = np.minimum(k * thickness_m, 300.0)
    below = 2.0 * rubber.shear_modulus_pa * (np.cosh(2.0 * x) + 1.0 + 2.0 * x**2)
    normal = weight * (np.sinh(2.0 * x) - 2.0 * x) / below / (2.0 * math.pi)
    outwards = weight * 2.0 * x**2 / below / (2.0 * math.pi)
    different, where = np.unique(distance, return_inverse=True)
    of_normal, of_outwards = np.empty((2, different.size))
    for first in range(0, different.size, 256):
        waves = np.outer(different[first : first + 256], k)
        of_normal[first : first + 256] = scipy.special.j0(waves) @ normal
        of_outwards[first : first + 256] = scipy.special.j1(waves) @ outwards
    return of_normal[where].reshape(distance.shape), of_outwards[where].reshape(distance.shape)
