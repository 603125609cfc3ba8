"""Surface displacement of an elastic layer bonded to a rigid base.

A sinusoidal surface traction of unit amplitude and wave number k displaces the surface with the following
amplitudes, where h is the thickness and x = k h:

    normal, due to normal traction       (1 − ν) / (G k) · (2κ sinh 2x − 4x) / D
    along k, due to traction along k     (1 − ν) / (G k) · (2κ sinh 2x + 4x) / D
    along k, due to normal traction      1 / (G k) · (κ (1 − 2ν) (cosh 2x − 1) − 2x²) / D, phase shift 90°
    across k, due to traction across k   tanh x / (G k)

Here, κ = 3 − 4ν and D = 2κ cosh 2x + 4x² + 1 + κ². The formulas are the plane-strain solution of Navier's
equations with the surface at z = h and zero displacement at z = 0 (Johnson, Contact Mechanics, 1985, section
5.8; Bentall and Johnson, Int. J. Mech. Sci. 10, 637, 1968). In the limit h → ∞, the layer becomes a
half-space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

Float = NDArray[np.float64]

DEEPEST: Final = 14.0
"""Value of x = k h above which the layer is treated as a half-space, with a relative error below 2e-10."""
STEPS: Final = 32
"""Number of points per layer thickness in tables of displacement versus distance."""
NODES: Final = 16
"""Number of Gauss-Legendre quadrature nodes per panel."""


@dataclass(frozen=True, slots=True)
class Layer:
    """Isotropic elastic layer on a rigid base.

    Args:
        thickness_m: Thickness of the layer, in metres; inf for a half-space.
        young_pa: Young's modulus, in Pa.
        poisson: Poisson's ratio, at most 0.5.

    Raises:
        ValueError: If a value is out of range.
    """

    thickness_m: float
    young_pa: float = 1e6
    poisson: float = 0.5

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("thickness_m", self.thickness_m, 0.0, math.inf),
            ("young_pa", self.young_pa, 0.0, 1e13),
        ):
            if not low < value <= high:
                raise ValueError(f"{name} is {value}, allowed: greater than {low:g}, at most {high:g}")
        if not 0.0 <= self.poisson <= 0.5:
            raise ValueError(f"poisson is {self.poisson}, allowed: 0 to 0.5")

    @property
    def shear_modulus_pa(self) -> float:
        """Shear modulus G of the layer, in Pa."""
        return 0.5 * self.young_pa / (1.0 + self.poisson)

    @property
    def contact_modulus_pa(self) -> float:
        """Contact modulus E* = E / (1 − ν²) between the layer and a rigid body, in Pa."""
        return self.young_pa / (1.0 - self.poisson**2)

    def response(self, wave_number_per_m: Float) -> tuple[Float, Float, Float, Float]:
        """Return the four amplitudes given in the module docstring, in that order, multiplied by k (1/Pa).

        Args:
            wave_number_per_m: Array of wave numbers k > 0, 1/m.
        """
        nu, modulus = self.poisson, self.shear_modulus_pa
        kappa = 3.0 - 4.0 * nu
        x = np.minimum(wave_number_per_m * self.thickness_m, 300.0)
        fall = np.exp(-2.0 * x)  # all terms are scaled by 2 e^(−2x) to prevent overflow
        sinh, cosh = 1.0 - fall**2, 1.0 + fall**2
        below = 2.0 * kappa * cosh + 2.0 * fall * (4.0 * x**2 + 1.0 + kappa**2)
        scale = (1.0 - nu) / modulus
        normal = scale * (2.0 * kappa * sinh - 8.0 * x * fall) / below
        along = scale * (2.0 * kappa * sinh + 8.0 * x * fall) / below
        across = np.tanh(x) / modulus
        crossed = (kappa * (1.0 - 2.0 * nu) * (cosh - 2.0 * fall) - 4.0 * x**2 * fall) / (modulus * below)
        return normal, along, crossed, across


class PointResponse:
    """Surface displacement of a layer under a point force, minus the displacement of a half-space.

    The difference is a smooth function of the distance from the force, so it is tabulated.

    Args:
        layer: Elastic layer of finite thickness.
        reach_m: Maximum distance from the force, in metres.
    """

    def __init__(self, layer: Layer, reach_m: float) -> None:
        h = layer.thickness_m
        r = np.linspace(0.0, reach_m, max(int(STEPS * reach_m / h), STEPS) + 1)
        panels = math.ceil(DEEPEST * max(reach_m / h, 1.0) / 4.0)
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        edges = np.linspace(0.0, DEEPEST / h, panels + 1)
        width = 0.5 * (edges[1] - edges[0])
        k = (0.5 * (edges[:-1] + edges[1:])[:, None] + width * nodes).ravel()
        step = np.tile(width * weights, panels)
        half = Layer(math.inf, layer.young_pa, layer.poisson)
        normal, along, crossed, across = (
            step * (own - other)
            for own, other in zip(layer.response(k), half.response(np.full_like(k, np.inf)), strict=True)
        )
        tables = np.empty((4, len(r)))
        for start in range(0, len(r), 64):  # in blocks, to limit memory use
            waves = np.outer(r[start : start + 64], k)
            zeroth, first = scipy.special.j0(waves), scipy.special.j1(waves)
            second = np.where(waves > 1e-4, 2.0 * first / np.maximum(waves, 1e-4) - zeroth, 0.0)
            tables[0, start : start + 64] = zeroth @ normal / (2.0 * math.pi)
            tables[1, start : start + 64] = zeroth @ (along + across) / (4.0 * math.pi)
            tables[2, start : start + 64] = second @ (across - along) / (4.0 * math.pi)
            tables[3, start : start + 64] = first @ crossed / (2.0 * math.pi)
        self._splines = tuple(scipy.interpolate.CubicSpline(r, table) for table in tables)

    def __call__(self, distance_m: Float) -> tuple[Float, Float, Float, Float]:
        """Return the coefficients Z, A, B and K (m/N) of the displacement due to a point force f.

        Under a normal force, u_z = Z f_z. At the polar angle θ, the displacement along x is
        u_x = (A + B cos 2θ) f_x + B sin 2θ f_y + K cos θ f_z.
        """
        found = [np.asarray(spline(distance_m)) for spline in self._splines]
        return found[0], found[1], found[2], found[3]


def cell_response(layer: Layer, offset_m: Float, size_m: float, reach_m: float) -> Float:
    """Return the surface displacement under a uniform unit traction on a square cell at the origin.

    The displacement of a half-space has a closed form (Love, Philosophical Transactions A 228, 377, 1929;
    a generalisation of Johnson, eq. 3.25, to all directions). It combines the integrals of 1/R, x²/R³, y²/R³,
    xy/R³, x/R² and y/R² over the cell. The difference between the layer and a half-space is smooth and is
    integrated by Gauss-Legendre quadrature.

    Args:
        layer: Elastic layer.
        offset_m: (…, 2) positions relative to the centre of the cell, in metres.
        size_m: Side length of the cell, in metres.
        reach_m: Maximum distance of any position from the centre of the cell, in metres.

    Returns:
        (…, 3, 3) displacement per unit traction, m/Pa. The last axis is the direction of the traction.
    """
    integrals = np.zeros((6, *offset_m.shape[:-1]))
    for sign_x in (-1.0, 1.0):
        for sign_y in (-1.0, 1.0):
            x, y = offset_m[..., 0] + sign_x * size_m / 2, offset_m[..., 1] + sign_y * size_m / 2
            r = np.hypot(x, y)
            with np.errstate(divide="ignore", invalid="ignore"):
                log_x = np.arctanh(np.clip(x / r, -1.0, 1.0))  # ln(x + R) − ln |y|; |y| cancels in the sum
                log_y = np.arctanh(np.clip(y / r, -1.0, 1.0))
                terms = (
                    _product(x, log_y) + _product(y, log_x),
                    _product(y, log_x),
                    _product(x, log_y),
                    -r,
                    _product(y, np.log(r)) + _product(x, np.arctan(y / x)),
                    _product(x, np.log(r)) + _product(y, np.arctan(x / y)),
                )
            for total, term in zip(integrals, terms, strict=True):
                total += sign_x * sign_y * term
    one, xx, yy, xy, x_r2, y_r2 = integrals
    nu, scale = layer.poisson, 1.0 / (2.0 * math.pi * layer.shear_modulus_pa)
    moved = np.empty((*offset_m.shape[:-1], 3, 3))
    moved[..., 0, 0] = scale * ((1.0 - nu) * one + nu * xx)
    moved[..., 1, 1] = scale * ((1.0 - nu) * one + nu * yy)
    moved[..., 0, 1] = moved[..., 1, 0] = scale * nu * xy
    moved[..., 2, 2] = scale * (1.0 - nu) * one
    moved[..., 0, 2] = scale * (0.5 - nu) * x_r2
    moved[..., 1, 2] = scale * (0.5 - nu) * y_r2
    if math.isfinite(layer.thickness_m):
        point = PointResponse(layer, reach_m + size_m)
        places, weights = np.polynomial.legendre.leggauss(3)
        for at_x, weight_x in zip(places, weights, strict=True):
            for at_y, weight_y in zip(places, weights, strict=True):
                x, y = offset_m[..., 0] + 0.5 * size_m * at_x, offset_m[..., 1] + 0.5 * size_m * at_y
                area = 0.25 * weight_x * weight_y * size_m**2
                normal, mean, twofold, outwards = (area * each for each in point(np.hypot(x, y)))
                angle = np.arctan2(y, x)
                moved[..., 0, 0] += mean + twofold * np.cos(2.0 * angle)
                moved[..., 1, 1] += mean - twofold * np.cos(2.0 * angle)
                moved[..., 0, 1] += twofold * np.sin(2.0 * angle)
                moved[..., 2, 2] += normal
                moved[..., 0, 2] += outwards * np.cos(angle)
                moved[..., 1, 2] += outwards * np.sin(angle)
    moved[..., 1, 0] = moved[..., 0, 1]
    moved[..., 2, :2] = -moved[..., :2, 2]
    return moved


def _product(length: Float, logarithm: Float) -> Float:
    """Return the product of a length and a logarithm, or the limit 0 where the length is 0."""
    return np.where(length == 0.0, 0.0, length * logarithm)
