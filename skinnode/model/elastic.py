"""Surface displacement of an elastic half-space under surface loads.

The rubber fills z ≤ 0, and z points out of it. An object that presses on the surface exerts a load with a
negative z component. A point load f displaces the surface by u (Boussinesq 1885, Cerruti 1882; Johnson,
Contact Mechanics, 1985, eqs. 3.18 and 3.75 at z = 0, with the axes changed to those used here):

    ⎡ u_x ⎤      1   ⎡ (1−ν)/r + ν x²/r³    ν x y/r³              (½−ν) x/r² ⎤ ⎡ f_x ⎤
    ⎢ u_y ⎥  =  ───  ⎢ ν x y/r³             (1−ν)/r + ν y²/r³     (½−ν) y/r² ⎥ ⎢ f_y ⎥
    ⎣ u_z ⎦     2πG  ⎣ −(½−ν) x/r²          −(½−ν) y/r²           (1−ν)/r    ⎦ ⎣ f_z ⎦

Here d = (x, y) is the offset of the surface point from the load, r = |d|, G is the shear modulus, and ν is
Poisson's ratio. :func:`point_compliance` evaluates the matrix. :func:`rectangle_compliance` integrates it
over a uniformly loaded rectangle, and :class:`HertzContact` over the pressure distribution under a sphere.

The model neglects large strains, the curvature of the skin and the finite thickness of the rubber. A thin
layer bonded to a rigid base is stiffer than a half-space, and its displacement decays faster than 1/r.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.layout import Float, require_array


@dataclass(frozen=True, slots=True)
class Rubber:
    """Linear elastic, isotropic material.

    Args:
        young_pa: Young's modulus, in Pa. The default is typical of a soft silicone of about 20 Shore A.
        poisson: Poisson's ratio. The default, 0.5, describes an incompressible material; rubber is nearly
            incompressible. At 0.5, normal and tangential loads do not couple at the surface, and Hertz's
            theory remains exact under friction.

    Raises:
        ValueError: If the modulus is not positive and finite or the ratio is not between 0 and 0.5.
    """

    young_pa: float = 0.7e6
    poisson: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.young_pa) and self.young_pa > 0):
            raise ValueError(f"young_pa: got {self.young_pa}, must be positive and finite")
        if not 0 <= self.poisson <= 0.5:
            raise ValueError(f"poisson: got {self.poisson}, must be from 0 to 0.5")

    @property
    def shear_modulus_pa(self) -> float:
        """Shear modulus G = E / 2(1 + ν), in Pa."""
        return self.young_pa / (2 * (1 + self.poisson))

    @property
    def contact_modulus_pa(self) -> float:
        """Contact modulus E* = E / (1 − ν²), in Pa, for contact with a rigid body (Johnson eq. 4.17)."""
        return self.young_pa / (1 - self.poisson**2)


def point_compliance(rubber: Rubber, offset_m: ArrayLike, *, softening_m: float = 0.0) -> Float:
    """Return the displacement of surface points per unit point load.

    Args:
        rubber: The material.
        offset_m: (P, 2) offset of each point from the load, in metres.
        softening_m: Softening length ε, in metres; r is replaced by √(r² + ε²). This spreads the load over a
            spot with a radius of about ε and keeps the displacement at the load finite. 0 gives an ideal
            point load.

    Returns:
        (P, 3, 3) compliance, in m/N. The last axis is the component of the load; the second-to-last axis is
        the component of the displacement. Values at the load itself are inf or NaN if ``softening_m`` is 0.

    Raises:
        ValueError: If the array has the wrong shape or contains NaN, or the softening is negative.
    """
    offset = require_array("offset_m", offset_m, ("P", 2))
    if not (math.isfinite(softening_m) and softening_m >= 0):
        raise ValueError(f"softening_m: got {softening_m}, must be finite and at least 0")
    x, y = offset.T
    r2 = x * x + y * y + softening_m**2
    r = np.sqrt(r2)
    with np.errstate(divide="ignore", invalid="ignore"):
        r3 = r2 * r
        return _compliance(rubber, 1 / r, x * x / r3, y * y / r3, x * y / r3, x / r2, y / r2)


def rectangle_compliance(rubber: Rubber, offset_m: ArrayLike, size_m: tuple[float, float]) -> Float:
    """Return the displacement of surface points per unit traction on a rectangle.

    Each entry of the compliance matrix has an elementary antiderivative in x and y, which is evaluated at the
    corners of the rectangle. Sources for the normal part: Love, Philosophical Transactions A 228, 1929;
    Johnson eq. 3.25.

    Args:
        rubber: The material.
        offset_m: (P, 2) offset of each point from the centre of the rectangle, in metres.
        size_m: Side lengths of the rectangle in x and y, in metres.

    Returns:
        (P, 3, 3) compliance, in m/Pa, with axes as in :func:`point_compliance`.

    Raises:
        ValueError: If the array has the wrong shape or contains NaN, or a length is not positive.
    """
    offset = require_array("offset_m", offset_m, ("P", 2))
    if not all(math.isfinite(length) and length > 0 for length in size_m):
        raise ValueError(f"size_m: got {size_m}, must be positive and finite")
    total = np.zeros((5, offset.shape[0]))
    for sign_x in (1, -1):
        for sign_y in (1, -1):
            x = offset[:, 0] + sign_x * 0.5 * size_m[0]
            y = offset[:, 1] + sign_y * 0.5 * size_m[1]
            total += sign_x * sign_y * _antiderivatives(x, y)
    return _compliance(rubber, total[0] + total[1], *total)


def _antiderivatives(x: Float, y: Float) -> Float:
    """Return the double antiderivatives (5, P) of x²/r³, y²/r³, xy/r³, x/r² and y/r² over x and y."""
    r = np.hypot(x, y)
    ax, ay = np.abs(x), np.abs(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        # asinh(x/|y|) replaces ln(x + r), which suffers from cancellation for x < 0. The two differ by ln|y|,
        # which drops out of the sum over the corners.
        xx = np.where(ay > 0, y * np.arcsinh(x / ay), 0.0)
        yy = np.where(ax > 0, x * np.arcsinh(y / ax), 0.0)
        log_r = np.where(r > 0, np.log(r), 0.0)
        angle = np.arctan(y / x)
        x_r2 = y * log_r + np.where(ax > 0, x * angle, 0.0)
        y_r2 = x * log_r + np.where(ay > 0, y * np.arctan(x / y), 0.0)
    return np.stack([xx, yy, -r, x_r2, y_r2])


def _compliance(  # noqa: PLR0913 - the six functions in the matrix
    rubber: Rubber, inverse: Float, xx: Float, yy: Float, xy: Float, x_r2: Float, y_r2: Float
) -> Float:
    """Assemble compliance matrices (P, 3, 3) from the values or integrals of 1/r, x²/r³ and so on."""
    nu = rubber.poisson
    matrix = np.empty((*inverse.shape, 3, 3))
    matrix[..., 0, 0] = (1 - nu) * inverse + nu * xx
    matrix[..., 1, 1] = (1 - nu) * inverse + nu * yy
    matrix[..., 2, 2] = (1 - nu) * inverse
    matrix[..., 0, 1] = matrix[..., 1, 0] = nu * xy
    matrix[..., 0, 2] = (0.5 - nu) * x_r2
    matrix[..., 1, 2] = (0.5 - nu) * y_r2
    matrix[..., 2, 0] = -matrix[..., 0, 2]
    matrix[..., 2, 1] = -matrix[..., 1, 2]
    matrix /= 2 * math.pi * rubber.shear_modulus_pa
    return matrix


@dataclass(frozen=True)
class HertzContact:
    """Hertzian contact of a rigid sphere that presses on the rubber and slides over it.

    Inside the contact circle, the pressure is p = p₀ √(1 − r²/a²) and the traction is (t_x p, t_y p, −p). The
    surface displacement has a closed form both inside and outside the circle. Since p is radially symmetric,
    all integrals follow from two functions of r: Φ = ∫ p/|d| (Johnson eqs. 3.41a, 3.42a), and P, the load
    within radius r. The shear traction is assumed not to change the pressure. This is exact for ν = 0.5 and
    an approximation for ν < 0.5 (Johnson 7.1).

    Args:
        rubber: The material.
        radius_m: Radius of the sphere, in metres.
        indentation_m: Approach δ of the sphere, in metres; 0 means no contact. The normal displacement at the
            centre of the contact equals δ if there is no shear or if ν = 0.5.
        center_m: Centre (x, y) of the contact circle, in metres.
        traction_ratio: Ratio (t_x, t_y) of the shear traction on the rubber to the pressure. It points in the
            sliding direction of the sphere, and its length is the coefficient of friction.

    Raises:
        ValueError: If a value is not finite, the radius is not positive, or the indentation is negative.
    """

    rubber: Rubber
    radius_m: float
    indentation_m: float
    center_m: tuple[float, float] = (0.0, 0.0)
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius_m) and self.radius_m > 0):
            raise ValueError(f"radius_m: got {self.radius_m}, must be positive and finite")
        if not (math.isfinite(self.indentation_m) and self.indentation_m >= 0):
            raise ValueError(f"indentation_m: got {self.indentation_m}, must be finite and at least 0")
        for name, pair in (("center_m", self.center_m), ("traction_ratio", self.traction_ratio)):
            if len(pair) != 2 or not all(map(math.isfinite, pair)):
                raise ValueError(f"{name}: got {pair}, must be two finite numbers")

    @property
    def contact_radius_m(self) -> float:
        """Contact radius a = √(R δ), in metres (Johnson eq. 4.23)."""
        return math.sqrt(self.radius_m * self.indentation_m)

    @property
    def peak_pressure_pa(self) -> float:
        """Peak pressure p₀ = 2 E* a / πR, in Pa (Johnson eqs. 4.22 and 4.24)."""
        return 2 * self.rubber.contact_modulus_pa * self.contact_radius_m / (math.pi * self.radius_m)

    @functools.cached_property
    def force_n(self) -> tuple[float, float, float]:
        """Total load (x, y, z) on the rubber, in N; the normal component is −4/3 E* √R δ^{3/2}."""
        normal = 2 / 3 * math.pi * self.peak_pressure_pa * self.contact_radius_m**2
        return self.traction_ratio[0] * normal, self.traction_ratio[1] * normal, -normal

    def traction_pa(self, points_m: ArrayLike) -> Float:
        """Return the traction, (P, 3) in Pa, at surface points, (P, 2) in metres; 0 outside the contact.

        Raises:
            ValueError: If the array has the wrong shape or contains NaN.
        """
        offset = require_array("points_m", points_m, ("P", 2)) - self.center_m
        a = self.contact_radius_m
        if a == 0:
            return np.zeros((offset.shape[0], 3))
        inside = np.clip(1 - np.einsum("pi,pi->p", offset, offset) / (a * a), 0, None)
        pressure = self.peak_pressure_pa * np.sqrt(inside)
        return np.asarray(pressure[:, None] * np.array([*self.traction_ratio, -1.0]))

    def displacement_m(self, points_m: ArrayLike) -> Float:
        """Return the displacement, (P, 3) in metres, of surface points, (P, 2) in metres; 0 without contact.

        Raises:
            ValueError: If the array has the wrong shape or contains NaN.
        """
        offset = require_array("points_m", points_m, ("P", 2)) - self.center_m
        if self.indentation_m == 0:
            return np.zeros((offset.shape[0], 3))
        # ∫ p/|d| = phi, ∫ p d/|d|² = enclosed d, ∫ p d dᵀ/|d|³ = isotropic I + radial d dᵀ
        phi, isotropic, radial, enclosed = _hertz_integrals(
            offset, self.contact_radius_m, self.peak_pressure_pa
        )
        nu, shear = self.rubber.poisson, np.array(self.traction_ratio)
        along = offset @ shear
        moved = np.empty((offset.shape[0], 3))
        moved[:, :2] = ((1 - nu) * phi + nu * isotropic)[:, None] * shear
        moved[:, :2] += (nu * radial * along - (0.5 - nu) * enclosed)[:, None] * offset
        moved[:, 2] = -(1 - nu) * phi - (0.5 - nu) * enclosed * along
        moved /= 2 * math.pi * self.rubber.shear_modulus_pa
        return moved


def _hertz_integrals(offset: Float, a: float, peak: float) -> tuple[Float, Float, Float, Float]:
    """Return Φ, Φ − S, (2S − Φ)/r² and P/r² at offsets (P, 2) from the centre of a Hertzian pressure p.

    Let χ = ∫ p |d|, whose Laplacian is Φ. Its gradient is d S with S = ∫₀ʳ Φ s ds / r², and its second
    derivatives are S I + (Φ − 2S) d dᵀ/r². The tensor ∫ p d dᵀ/|d|³ equals Φ I − ∇∇χ. The vector ∫ p d/|d|²
    is the field of a charge distribution in two dimensions, which is d P/r² by Gauss's law.
    """
    r2 = np.einsum("pi,pi->p", offset, offset)
    near = r2 <= a * a
    c = math.pi**2 * peak / (4 * a)
    s2 = np.minimum(r2, a * a) / (a * a)
    phi = c * a * a * (2 - s2)
    isotropic = c * a * a * (1 - 0.75 * s2)
    radial = np.full_like(r2, 0.5 * c)
    # (1 − (1 − s²)^{3/2}) / s², rearranged to avoid cancellation at the centre
    root = np.sqrt(1 - s2)
    enclosed = 2 / 3 * math.pi * peak * (1 + root + (1 - s2)) / (1 + root)
    far = ~near
    q2 = r2[far]
    w = np.sqrt(q2 - a * a)
    angle = np.arctan2(a, w)  # arcsin(a/r), more accurate near r = a in this form
    c = math.pi * peak / (2 * a)
    outside = c * ((2 * a * a - q2) * angle + a * w)
    mean = c * ((a * a - 0.25 * q2) * angle + (0.75 * a * a + 0.25 * w * w) * a * w / q2)
    phi[far], isotropic[far], radial[far] = outside, outside - mean, (2 * mean - outside) / q2
    enclosed[far] = 2 / 3 * math.pi * peak * a * a / q2
    return phi, isotropic, radial, enclosed
