"""Loads for ``skinnode bench trust``: presses that are not of the kind that the elastic prior expects.

The prior of the posterior expects independent loads on the cells of a lattice. The loads here have no
lattice: closed forms for a sphere and a flat punch, line loads at any angle, a dent that is no solution of a
half-space, a rigid plate on the whole patch. Forces are known if the body presses on a half-space or layer.

Frictional shear is proportional to the pressure. The rubber is incompressible (ν = ½), so on a half-space
pressure does not move the surface sideways and shear does not move it up or down.
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
"""Range of the depth of a load, in clearances."""
SHEAR: Final = 0.3
"""Maximum friction."""
LINES: Final = 16
"""Number of line loads across a ridge, at most 0.15 pitches apart."""

WAVES: Final = 1500
"""Number of wave numbers in a Hankel transform."""
WAVE_MAX: Final = 60.0
"""Largest wave number, in inverse contact radii: Hertz's pressure has 1e-4 of its weight beyond."""

_UNKNOWN: Final = np.full(3, np.nan)


@dataclass(frozen=True)
class Punch:
    """A rigid, flat-ended cylinder (Johnson, Contact Mechanics, eqs. 3.34 to 3.37)."""

    center_m: tuple[float, float]
    radius_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the displacement of the pressure p₀/√(1 − r²/a²) and of a shear proportional to it.

        Φ = ∫ p/|d| and S = ∫₀ʳ Φ s ds / r² give ∫ p d dᵀ/|d|³ = (Φ − S) I + (2S − Φ) d dᵀ/r².
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
        # (1 − ν) Φ I + ν ∫ p d dᵀ/|d|³ with ν = ½, in units in which the depth (1 − ν) Φ(0) is 1
        moved[:, :2] = (0.5 * phi + 0.5 * (phi - s))[:, None] * np.array(self.traction_ratio)
        moved[:, :2] += (0.5 * (2 * s - phi) * along / r)[:, None] * offset
        moved[:, 2] = -0.5 * phi
        return share * self.depth_m * moved

    def force_n(self, share: float) -> Float:
        """Return 2 a E* δ and the shear."""
        normal = 2.0 * self.radius_m * RUBBER.contact_modulus_pa * share * self.depth_m
        return normal * np.array([*self.traction_ratio, -1.0])


@dataclass(frozen=True)
class Ridge:
    """An edge of finite length at any angle: line loads side by side under an elliptic pressure."""

    center_m: tuple[float, float]
    angle: float
    length_m: float
    half_width_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def _lines(self) -> tuple[Float, Float]:
        """Return the places (L,) of the lines across the ridge, metres, and their share of the load."""
        step = np.pi * np.arange(1, LINES + 1) / (LINES + 1)
        weight = np.sin(step) ** 2
        return self.half_width_m * np.cos(step), weight / weight.sum()

    def _unit(self, points_m: Float) -> Float:
        """Return the displacement (P, 3, 3) per newton: Boussinesq and Cerruti, integrated along lines."""
        turn = np.array([[np.cos(self.angle), np.sin(self.angle)], [-np.sin(self.angle), np.cos(self.angle)]])
        along, across = turn @ (points_m - self.center_m).T
        places, weight = self._lines()
        # A line is as wide as the distance to the next line, so its potential stays finite.
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
        """Return the load that sinks the middle of the ridge by its depth."""
        normal = share * self.depth_m / self._unit(np.array([self.center_m]))[0, 2, 2]
        return np.asarray(normal * np.array([*self.traction_ratio, -1.0]))

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the displacement of all lines together."""
        return np.asarray(self._unit(points_m) @ self.force_n(share))


@dataclass(frozen=True)
class Dent:
    """A smooth Gaussian dent that drags the skin towards its centre, as no half-space does."""

    center_m: tuple[float, float]
    spread_m: float
    depth_m: float
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the displacement of the dent."""
        offset = (points_m - self.center_m) / self.spread_m
        shape = share * self.depth_m * np.exp(-0.5 * (offset**2).sum(axis=1))
        moved = np.empty((len(points_m), 3))
        moved[:, :2] = shape[:, None] * (np.array(self.traction_ratio) - 0.2 * offset)
        moved[:, 2] = -shape
        return moved

    def force_n(self, share: float) -> Float:
        """Return NaN: the shape does not determine a force."""
        return _UNKNOWN


@dataclass(frozen=True)
class Plate:
    """A rigid plate, slightly tilted, that lies on the whole patch."""

    center_m: tuple[float, float]
    depth_m: float
    tilt: tuple[float, float]
    """Relative change of the depth per metre along x and y."""
    traction_ratio: tuple[float, float] = (0.0, 0.0)

    def displacement_m(self, points_m: Float, share: float) -> Float:
        """Return the displacement of a rigid plate."""
        depth = share * self.depth_m * (1.0 + (points_m - self.center_m) @ np.array(self.tilt))
        return np.asarray(depth[:, None] * np.array([*self.traction_ratio, -1.0]))

    def force_n(self, share: float) -> Float:
        """Return NaN: the force depends on the skin beside the patch."""
        return _UNKNOWN


@dataclass(frozen=True)
class Bonded:
    """Hertz's pressure on a layer of incompressible rubber that is bonded to a rigid base.

    Hankel transforms: with x = k h, the layer's deflection is L(x) times that of a half-space, and its
    surface moves sideways by −2x²/(sinh 2x − 2x) times the deflection (from the biharmonic solution that
    is at rest at the base and free of shear at the surface).
    """

    center_m: tuple[float, float]
    radius_m: float
    """Contact radius."""
    thickness_m: float
    depth_m: float

    def _unit(self, offset_m: Float) -> tuple[Float, Float]:
        """Return the displacement along the surface, outwards, and out of it, per pascal of peak pressure."""
        from scipy.special import j0, j1

        k = (np.arange(WAVES) + 0.5) * (WAVE_MAX / WAVES) / self.radius_m
        ka, x = k * self.radius_m, k * self.thickness_m
        pressure = self.radius_m**2 * (np.sin(ka) / ka - np.cos(ka)) / ka**2
        x = np.minimum(x, 100.0)  # beyond, the layer is a half-space
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
        """Return the displacement of the layer's surface."""
        offset = points_m - self.center_m
        outwards, up = self._unit(offset)
        r = np.maximum(np.hypot(*offset.T), 1e-12)
        moved = np.column_stack([offset * (outwards / r)[:, None], up])
        return np.asarray(moved * self._peak_pa(share))

    def force_n(self, share: float) -> Float:
        """Return Hertz's load, ⅔ π a² p₀."""
        return np.array([0.0, 0.0, -2.0 / 3.0 * math.pi * self.radius_m**2 * self._peak_pa(share)])


def surface_m(layout: PatchLayout) -> tuple[Float, Float, Float]:
    """Return the electrodes (P, 2) along the surface and their lowest and highest coordinates, metres."""
    points = layout.upper_m[..., :2].reshape(-1, 2)
    return points, points.min(axis=0), points.max(axis=0)


def draw(kind: str, layout: PatchLayout, rng: np.random.Generator, depth: float | None = None) -> Load:
    """Return a random load.

    Args:
        kind: One of :data:`LOADS`.
        layout: Patch to press.
        rng: Random generator.
        depth: Depth in clearances; default: random within :data:`DEPTH`.
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
    if kind == "edge":  # the centre is on the outermost electrodes or the outermost wire
        border = (low, high)[side // 2]
        center = (float(border[0]), center[1]) if side % 2 else (center[0], float(border[1]))
    elif kind != "sphere":
        raise ValueError(f"kind: got {kind!r}, must be one of {', '.join(LOADS)}")
    return Press(center, (1.5 + 2.0 * size) * pitch, sunk, traction)
