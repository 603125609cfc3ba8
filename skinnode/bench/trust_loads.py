"""Loads for ``skinnode bench trust`` that violate the assumptions of the posterior's prior.

The prior assumes independent loads on the cells of a lattice. The loads in this module do not lie on a
lattice: spheres and flat punches in closed form, line loads at any angle, a dent that no load on a half-space
can produce, and a rigid plate over the whole patch. The true force is known for bodies that press on a
half-space or on a layer.

The shear traction is proportional to the pressure. The rubber is incompressible (ν = ½). On a half-space,
pressure therefore causes no tangential displacement, and shear causes no normal displacement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.bench.truth import RUBBER, Load, Press
from skinnode.model.layout import Float, PatchLayout

LOADS: Final = ("sphere", "punch", "ridge", "dent", "edge", "whole patch")
DEPTH: Final = (0.1, 0.3)
"""Minimum and maximum depth of a load, as fractions of the layer height."""
SHEAR: Final = 0.3
"""Maximum coefficient of friction."""
LINES: Final = 16
"""Number of parallel line loads that approximate a ridge; their spacing is at most 0.15 pitches."""

WAVES: Final = 1500
"""Number of wave numbers at which Hankel transforms are sampled."""
WAVE_MAX: Final = 60.0
"""Maximum product of wave number and contact radius. Higher wave numbers contribute only 1e-4 of the Hertz
pressure."""

_UNKNOWN: Final = np.full(3, np.nan)


@dataclass(frozen=True)
class Punch:
    """A rigid flat-ended cylinder pressing on the skin (Johnson, Contact Mechanics, eqs. 3.34 to 3.37)."""

    center_m: tuple[float, float]
    radius_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the displacement due to the pressure p₀/√(1 − r²/a²) and a proportional shear traction.

        Let Φ = ∫ p/|d| and S = ∫₀ʳ Φ s ds / r². Then ∫ p d dᵀ/|d|³ = (Φ − S) I + (2S − Φ) d dᵀ/r².
        """
        offset, a = points_m - self.center_m, self.radius_m
        r = np.maximum(np.hypot(*offset.T), 1e-12)
        angle = np.arcsin(np.minimum(a / r, 1.0))
        phi = 4.0 * angle / math.pi  # 2 at the centre
        inside = np.full_like(r, 1.0)
        ring = 2.0 / math.pi * (angle + a / r * np.sqrt(np.maximum(1.0 - (a / r) ** 2, 0.0)))
        s = np.where(r <= a, inside, ring)
        phi = np.where(r <= a, 2.0, phi)
        along = (offset / r[:, None]) @ np.array(self.traction_ratio)
        moved = np.empty((len(r), 3))
        # Displacement per unit depth: (1 − ν) Φ I + ν ∫ p d dᵀ/|d|³ with ν = ½, because (1 − ν) Φ(0) = 1.
        moved[:, :2] = (0.5 * phi + 0.5 * (phi - s))[:, None] * np.array(self.traction_ratio)
        moved[:, :2] += (0.5 * (2 * s - phi) * along / r)[:, None] * offset
        moved[:, 2] = -0.5 * phi
        return share * self.depth_m * moved

    def force_n(self, share: float) -> Float:
        """Return the normal force 2 a E* δ and the shear force, in newtons."""
        normal = 2.0 * self.radius_m * RUBBER.contact_modulus_pa * share * self.depth_m
        return normal * np.array([*self.traction_ratio, -1.0])


@dataclass(frozen=True)
class Ridge:
    """A straight edge of finite length pressing on the skin, as line loads with elliptic pressure."""

    center_m: tuple[float, float]
    angle: float
    length_m: float
    half_width_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def _lines(self) -> tuple[Float, Float]:
        """Return the (L,) offsets of the lines from the axis in metres, and their (L,) load fractions."""
        step = np.pi * np.arange(1, LINES + 1) / (LINES + 1)
        weight = np.sin(step) ** 2
        return self.half_width_m * np.cos(step), weight / weight.sum()

    def _unit(self, points_m: Float) -> Float:
        """Return the (P, 3, 3) compliances in m/N from Boussinesq's and Cerruti's solutions."""
        turn = np.array([[np.cos(self.angle), np.sin(self.angle)], [-np.sin(self.angle), np.cos(self.angle)]])
        along, across = turn @ (points_m - self.center_m).T
        places, weight = self._lines()
        # To keep the potential finite, each line load is as wide as the spacing between lines.
        blur = self.half_width_m / LINES
        t = across[:, None] - places
        total = np.zeros((len(points_m), 3, 3))
        rho2 = t * t + blur * blur
        one = xx = yy = xy = np.zeros_like(t)
        for sign in (1.0, -1.0):
            end = (0.5 * self.length_m + sign * along)[:, None]
            far = np.sqrt(end * end + rho2)
            log = np.arcsinh(end / np.sqrt(rho2))
            one = one + log
            xx = xx + log - end / far
            yy = yy + end / far
            xy = xy - sign * t / far
        one, xx, yy, xy = ((each * weight).sum(axis=1) for each in (one, xx, yy, xy))
        total[:, 0, 0], total[:, 1, 1] = 0.5 * (one + xx), 0.5 * (one + yy)
        total[:, 0, 1] = total[:, 1, 0] = 0.5 * xy
        total[:, 2, 2] = 0.5 * one
        total /= 2 * math.pi * RUBBER.shear_modulus_pa * self.length_m
        total[:, :2, :2] = turn.T @ total[:, :2, :2] @ turn
        return total

    def force_n(self, share: float) -> Float:
        """Return the (3,) force in newtons that presses the middle of the ridge to the required depth."""
        normal = share * self.depth_m / self._unit(np.array([self.center_m]))[0, 2, 2]
        return np.asarray(normal * np.array([*self.traction_ratio, -1.0]))

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements due to all line loads, in metres."""
        return np.asarray(self._unit(points_m) @ self.force_n(share))


@dataclass(frozen=True)
class Dent:
    """A Gaussian dent with displacements towards its centre, which no load on a half-space can cause."""

    center_m: tuple[float, float]
    spread_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements in metres."""
        offset = (points_m - self.center_m) / self.spread_m
        shape = share * self.depth_m * np.exp(-0.5 * (offset**2).sum(axis=1))
        moved = np.empty((len(points_m), 3))
        moved[:, :2] = shape[:, None] * (np.array(self.traction_ratio) - 0.2 * offset)
        moved[:, 2] = -shape
        return moved

    def force_n(self, share: float) -> Float:
        """Return NaN, because the force cannot be derived from the shape of the dent."""
        return _UNKNOWN


@dataclass(frozen=True)
class Plate:
    """A rigid, slightly tilted plate pressing on the whole patch."""

    center_m: tuple[float, float]
    depth_m: float
    tilt: tuple[float, float]
    """Relative change in the plate's depth along x and along y, per metre."""
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements under the plate, in metres."""
        depth = share * self.depth_m * (1.0 + (points_m - self.center_m) @ np.array(self.tilt))
        return np.asarray(depth[:, None] * np.array([*self.traction_ratio, -1.0]))

    def force_n(self, share: float) -> Float:
        """Return NaN, because the force also depends on skin outside the patch."""
        return _UNKNOWN


@dataclass(frozen=True)
class Bonded:
    """A Hertz pressure distribution on an incompressible rubber layer bonded to a rigid base.

    The displacement is computed with Hankel transforms. For wave number k and layer height h, let x = k h.
    The layer's transformed deflection is the half-space deflection multiplied by
    L(x) = (sinh 2x − 2x)/(cosh 2x + 2x² + 1). The transformed tangential displacement is the deflection
    multiplied by −2x²/(sinh 2x − 2x). Both formulas follow from the biharmonic equation with zero
    displacement at the base and zero shear stress at the surface.
    """

    center_m: tuple[float, float]
    radius_m: float
    """Contact radius."""
    thickness_m: float
    depth_m: float

    def _unit(self, offset_m: Float) -> tuple[Float, Float]:
        """Return the (P,) radial and normal displacements per unit of peak pressure, in m/Pa."""
        from scipy.special import j0, j1

        k = (np.arange(WAVES) + 0.5) * (WAVE_MAX / WAVES) / self.radius_m
        ka, x = k * self.radius_m, k * self.thickness_m
        pressure = self.radius_m**2 * (np.sin(ka) / ka - np.cos(ka)) / ka**2
        x = np.minimum(x, 100.0)  # for larger x, the layer is equivalent to a half-space
        below = np.cosh(2 * x) + 2 * x * x + 1.0
        deflect = pressure * (2.0 / RUBBER.contact_modulus_pa) * (k[1] - k[0])
        r = np.hypot(*offset_m.T)
        waves = np.multiply.outer(r, k)
        up = -(j0(waves) @ (deflect * (np.sinh(2 * x) - 2 * x) / below))
        outwards = j1(waves) @ (deflect * 2 * x * x / below)
        return np.asarray(outwards), np.asarray(up)

    def _peak_pa(self, share: float) -> float:
        return share * self.depth_m / -float(self._unit(np.zeros((1, 2)))[1][0])

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the (P, 3) displacements of the layer's surface, in metres."""
        offset = points_m - self.center_m
        outwards, up = self._unit(offset)
        r = np.maximum(np.hypot(*offset.T), 1e-12)
        moved = np.column_stack([offset * (outwards / r)[:, None], up])
        return np.asarray(moved * self._peak_pa(share))

    def force_n(self, share: float) -> Float:
        """Return the (3,) force in newtons; the normal force is ⅔ π a² p₀ (Hertz)."""
        return np.array([0.0, 0.0, -2.0 / 3.0 * math.pi * self.radius_m**2 * self._peak_pa(share)])


def surface_m(layout: PatchLayout) -> tuple[Float, Float, Float]:
    """Return the upper electrodes' (P, 2) x-y positions, and the minima and maxima of x and y, in metres."""
    points = layout.upper_m[..., :2].reshape(-1, 2)
    return points, points.min(axis=0), points.max(axis=0)


def draw(kind: str, layout: PatchLayout, rng: np.random.Generator, depth: float | None = None) -> Load:
    """Choose a random load.

    Args:
        kind: One of :data:`LOADS`.
        layout: Patch to press.
        rng: Random generator.
        depth: Depth divided by the layer height; default: random within :data:`DEPTH`.
    """
    pitch = layout.pitch_m
    _, low, high = surface_m(layout)
    inset = np.minimum(2.0 * pitch, 0.4 * (high - low))
    x, y = rng.uniform(low + inset, high - inset)
    sunk = float(rng.uniform(*DEPTH) if depth is None else depth) * layout.height_m
    angle, friction = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, SHEAR)
    traction = float(friction * np.cos(angle)), float(friction * np.sin(angle))
    size, tilts, side = rng.uniform(), rng.uniform(-1.0, 1.0, 2), int(rng.integers(4))
    center = float(x), float(y)
    if kind == "punch":
        return Punch(center, (0.8 + 1.2 * size) * pitch, sunk, traction)
    if kind == "ridge":
        return Ridge(center, float(angle), (3.0 + 2.0 * size) * pitch, 0.8 * pitch, sunk, traction)
    if kind == "dent":
        return Dent(center, (0.8 + 1.2 * size) * pitch, sunk, traction)
    if kind == "whole patch":
        middle = 0.5 * (low + high)
        tilt = 0.2 * tilts / (high - low)
        return Plate((float(middle[0]), float(middle[1])), sunk, (float(tilt[0]), float(tilt[1])), traction)
    if kind == "edge":  # the centre is on an outermost column of electrodes or on an outermost wire
        border = (low, high)[side // 2]
        center = (float(border[0]), center[1]) if side % 2 else (center[0], float(border[1]))
    elif kind != "sphere":
        raise ValueError(f"kind: got {kind!r}, must be one of {', '.join(LOADS)}")
    return Press(center, (1.5 + 2.0 * size) * pitch, sunk, traction)
