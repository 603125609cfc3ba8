"""An independent truth: the surface of a half-space under a rigid sphere, Hertz's closed form, with shear."""

from __future__ import annotations

import numpy as np

import skinnode as sk


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
    """Resistances (U, K) of a displaced patch, written out wire by wire."""
    frame = np.empty(layout.shape)
    for u, upper in enumerate(layout.upper_m + displacement_m):
        for k, lower in enumerate(layout.lower_m):
            paths = 1 / np.linalg.norm(upper[:, None] - lower[None], axis=-1)
            frame[u, k] = layout.resistivity_ohm_per_m / paths.sum()
    return frame
