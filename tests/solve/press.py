"""Independent truths: displacements, among them Hertz's closed form with shear, and what a patch measures."""

from __future__ import annotations

import numpy as np

import skinnode as sk

LO, HI, STEPS = 0.25, 1.25, 2**16 - 4
"""Range of R/R0 and number of steps of the 16-bit code on the wire."""


def hertz_press(
    layout: sk.PatchLayout,
    depth: float,
    *,
    shear: float = 0.3,
    centre_m: tuple[float, float] = (18.3e-3, 17.1e-3),
    radius_m: float = 8e-3,
) -> np.ndarray:
    """Displacement (U, N, 3) of a sphere pressed in by ``depth`` heights of the layer, dragged by ``shear``.

    Johnson, Contact Mechanics, eqs. 3.41 and 3.42a: δ (1 − r²/2a²) within the contact of radius a = √(R δ),
    δ/π ((2 − r²/a²) asin(a/r) + (r/a) √(1 − a²/r²)) outside.
    """
    delta = depth * layout.height_m
    if delta == 0:
        return np.zeros_like(layout.upper_m)
    a = np.sqrt(radius_m * delta)
    ratio = np.linalg.norm(layout.upper_m[..., :2] - np.array(centre_m), axis=-1) / a
    outside = np.maximum(ratio, 1.0)
    tail = (2 - outside**2) * np.arcsin(1 / outside) + outside * np.sqrt(1 - 1 / outside**2)
    sunk = np.where(ratio <= 1, delta * (1 - ratio**2 / 2), delta / np.pi * tail)
    return np.stack([shear * sunk, -0.5 * shear * sunk, -sunk], axis=-1)


def frame_ohm(layout: sk.PatchLayout, displacement_m: np.ndarray) -> np.ndarray:
    """Resistances (U, K) of a displaced patch, written out for each upper wire."""
    frame = np.empty(layout.shape)
    for u, upper in enumerate(layout.upper_m + displacement_m):
        x, y, z = (upper[:, None, axis] - layout.lower_m[:, None, :, axis] for axis in range(3))
        paths = 1 / np.sqrt(x * x + y * y + z * z)
        frame[u] = layout.resistivity_ohm_per_m / paths.reshape(len(paths), -1).sum(axis=1)
    return frame


def quantised(frame: np.ndarray, rest: np.ndarray) -> np.ndarray:
    code = np.rint((frame / rest - LO) / (HI - LO) * STEPS)
    return (LO + code * (HI - LO) / STEPS) * rest


def dent(layout: sk.PatchLayout, depth: float, *, shear: float = 0.3, centre=(4.0, 5.0)) -> np.ndarray:
    """A press felt by the electrodes within 1.2 pitches of (upper wire, electrode) ``centre`` alone."""
    wire, electrode = np.indices(layout.upper_m.shape[:2])
    ratio = ((wire - centre[0]) ** 2 + (electrode - centre[1]) ** 2) / 1.2**2
    sunk = depth * layout.height_m * np.clip(1 - ratio, 0, None) ** 2
    return np.stack([shear * sunk, -0.5 * shear * sunk, -sunk], axis=-1)


def noisy(layout: sk.PatchLayout, moved: np.ndarray, rng: np.random.Generator, sigma: float = 1e-5):
    return frame_ohm(layout, moved) * (1 + sigma * rng.normal(size=layout.shape))


def relative_slopes(layout: sk.PatchLayout, moved: np.ndarray) -> np.ndarray:
    """∂(R F)/∂x at R = 1/F, (U, K, 3N), 1/m."""
    potential = layout.resistivity_ohm_per_m / frame_ohm(layout, moved)
    return sk.jacobian(layout, layout.upper_m + moved).reshape(*layout.shape, -1) / potential[:, :, None]
