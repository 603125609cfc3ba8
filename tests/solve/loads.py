"""Loads on a flat skin with a known force and number of bodies; none is of the kind that the solver expects.

Half-space: Hertz's sphere and the flat punch in closed form; ridges and large areas as sums of Boussinesq's
point loads on a grid of an eighth of a pitch. A dent moves the skin only where it is. A bonded layer of
incompressible rubber is solved by Hankel transform (Stokes' stream function for each wave number).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import j0, j1

import skinnode as sk
from skinnode.bench.truth import RUBBER, Press, Skin, random_press

from .press import dent


@dataclass(frozen=True, eq=False)
class Load:
    """A load at full depth."""

    moved_m: np.ndarray
    """(U, N, 3) displacement."""
    bodies: int
    force_n: tuple[float, ...] = ()
    """Normal force of each body; empty if it is not known."""
    centre_m: tuple[tuple[float, float], ...] = ()


def _off(layout: sk.PatchLayout, centre: np.ndarray) -> np.ndarray:
    return layout.upper_m[..., :2] - centre


def _normal(depth_m: np.ndarray) -> np.ndarray:
    return np.stack([0 * depth_m, 0 * depth_m, -depth_m], axis=-1)


def spheres(layout: sk.PatchLayout, *presses: Press) -> Load:
    moved = Skin(layout).displacement_m(presses, 1.0)
    force = tuple(float(-press.force_n(1.0)[2]) for press in presses)
    return Load(moved, len(presses), force, tuple(press.center_m for press in presses))


def punch(layout: sk.PatchLayout, centre: np.ndarray, radius_m: float, depth_m: float) -> Load:
    """Flat circular punch (Johnson, Contact Mechanics, eqs. 3.36 to 3.38)."""
    r = np.maximum(np.linalg.norm(_off(layout, centre), axis=-1), radius_m)
    force = 2 * RUBBER.contact_modulus_pa * radius_m * depth_m
    return Load(_normal(depth_m * 2 / np.pi * np.arcsin(radius_m / r)), 1, (force,), (tuple(centre),))


def area(
    layout: sk.PatchLayout, centre: np.ndarray, size_m: np.ndarray, angle: float, depth_m: float
) -> Load:
    """Uniform pressure on a rectangle: point loads (1 − ν²)/πE r; the load at a point itself as a square."""
    step = layout.pitch_m / 8
    n = np.maximum(np.rint(size_m / step).astype(int), 1)
    x, y = ((np.arange(k) - 0.5 * (k - 1)) * step for k in n)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2) @ turn.T + centre
    away = np.linalg.norm(layout.upper_m[..., None, :2] - points, axis=-1)
    inverse = np.where(away < step / 2, 4 * np.arcsinh(1.0) / step, 1 / np.maximum(away, step / 2))
    sunk = inverse.sum(axis=-1) / (np.pi * RUBBER.contact_modulus_pa)  # for a newton on each point
    each = depth_m / sunk.max()
    return Load(_normal(each * sunk), 1, (each * len(points),), (tuple(centre),))


def bonded(
    layout: sk.PatchLayout, centre: np.ndarray, radius_m: float, layer_m: float, depth_m: float
) -> Load:
    """Hertz's pressure on a layer of incompressible rubber bonded to a rigid support."""
    r = np.linspace(0.0, 1.5 * float(np.ptp(layout.upper_m)), 600)
    along, out = bonded_surface(r, radius_m, layer_m)
    scale = depth_m / along[0]
    off = _off(layout, centre)
    distance = np.linalg.norm(off, axis=-1)
    moved = _normal(scale * np.interp(distance, r, along))
    moved[..., :2] = (scale * np.interp(distance, r, out) / np.maximum(distance, 1e-12))[..., None] * off
    return Load(moved, 1, (float(scale),), (tuple(centre),))


def bonded_surface(r: np.ndarray, radius_m: float, layer_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth and outward displacement, m, at distances r under Hertz's pressure of 1 N in all.

    For wave number k, ψ = C (sinh kz − kz cosh kz) + D z sinh kz vanishes with its slope at the support, and
    D/C makes the surface free of shear; u = (ψ', −ikψ), σ_zz = G i (ψ'''/k − 3 k ψ').
    """
    depth, out = np.zeros_like(r), np.zeros_like(r)
    nodes, weights = np.polynomial.legendre.leggauss(48)
    edges = np.linspace(0.0, 120.0 / radius_m, int(120.0 / radius_m * r.max() / 20) + 2)
    for low, high in itertools.pairwise(edges):
        k = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        x = k * layer_m
        fall = np.exp(-2 * x)
        sh, ch = (1 - fall) / 2, (1 + fall) / 2  # times exp(x), which cancels
        c = np.stack([sh - x * ch, -k * x * sh, -k * k * (sh + x * ch), -(k**3) * (2 * ch + x * sh)])
        d = np.stack([layer_m * sh, sh + x * ch, 2 * k * ch + k * x * sh, 3 * k * k * sh + k * k * x * ch])
        psi = c - (c[2] + k * k * c[0]) / (d[2] + k * k * d[0]) * d
        stress = RUBBER.shear_modulus_pa * (psi[3] / k - 3 * k * psi[1])
        a = k * radius_m
        pressure = (
            1.5 / np.pi * np.where(a < 1e-2, 1 / 3, (np.sin(a) - a * np.cos(a)) / np.maximum(a, 1e-2) ** 3)
        )
        step = 0.5 * (high - low) * weights * k * pressure
        depth += j0(np.outer(r, k)) @ (step * -k * psi[0] / stress)
        out += j1(np.outer(r, k)) @ (step * psi[1] / stress)
    return depth, out


def inside(layout: sk.PatchLayout, rng: np.random.Generator, margin: float = 2.0) -> np.ndarray:
    points = layout.upper_m[..., :2].reshape(-1, 2)
    inset = margin * layout.pitch_m
    return rng.uniform(points.min(axis=0) + inset, points.max(axis=0) - inset)


def _two(layout: sk.PatchLayout, rng: np.random.Generator, depth: float) -> Load:
    pitch = layout.pitch_m
    while True:
        places = [inside(layout, rng, 1.0) for _ in range(2)]
        if np.linalg.norm(places[0] - places[1]) > 5.5 * pitch:
            break
    return spheres(
        layout,
        *(
            Press((float(x), float(y)), rng.uniform(1.5, 3) * pitch, rng.uniform(0.6, 1) * depth)
            for x, y in places
        ),
    )


def _family() -> dict[str, Callable[[sk.PatchLayout, np.random.Generator], Load]]:
    def depth(layout: sk.PatchLayout, rng: np.random.Generator) -> float:
        return float(rng.uniform(0.05, 0.4))

    def middle(layout: sk.PatchLayout, rng: np.random.Generator) -> np.ndarray:
        return layout.upper_m[..., :2].mean(axis=(0, 1)) + rng.uniform(-1, 1, 2) * layout.pitch_m

    return {
        "sphere": lambda at, rng: spheres(at, random_press(rng, at, depth(at, rng), radius=(1.5, 6.0))),
        "on the edge": lambda at, rng: spheres(at, random_press(rng, at, depth(at, rng), where="edge")),
        "half off": lambda at, rng: spheres(at, random_press(rng, at, depth(at, rng), where="half off")),
        "two spheres": lambda at, rng: _two(at, rng, rng.uniform(0.1, 0.4) * at.height_m),
        "punch": lambda at, rng: punch(
            at, inside(at, rng), rng.uniform(0.7, 2.5) * at.pitch_m, rng.uniform(0.04, 0.3) * at.height_m
        ),
        "plate": lambda at, rng: punch(
            at, middle(at, rng), rng.uniform(6.5, 12) * at.pitch_m, rng.uniform(0.03, 0.3) * at.height_m
        ),
        "very large sphere": lambda at, rng: spheres(
            at,
            Press(
                (float((place := middle(at, rng))[0]), float(place[1])),
                rng.uniform(60, 400) * at.pitch_m,
                rng.uniform(0.05, 0.4) * at.height_m,
            ),
        ),
        "large area": lambda at, rng: area(
            at, middle(at, rng), rng.uniform(5, 14, 2) * at.pitch_m, 0.0, rng.uniform(0.04, 0.3) * at.height_m
        ),
        "ridge": lambda at, rng: area(
            at,
            inside(at, rng, 3.0),
            np.array([rng.uniform(3, 7), 0.5]) * at.pitch_m,
            rng.uniform(0, np.pi),
            rng.uniform(0.04, 0.3) * at.height_m,
        ),
        "dent": lambda at, rng: Load(
            dent(at, rng.uniform(0.04, 0.3), shear=0.0, centre=tuple(rng.uniform(2, 7, 2))), 1
        ),
    }


FAMILIES = _family()
