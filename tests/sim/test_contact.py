"""Contact mechanics of the simulator against closed forms, and against an elastic solution by other means."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate

from vcan_sim.contact.grid import Grid
from vcan_sim.contact.layer import Layer
from vcan_sim.contact.solve import advance, press, untouched

RADIUS_M, CONTACT_M = 20e-3, 1e-3
"""Radius of the sphere, and of its contact with a half-space."""
DEPTH_M = CONTACT_M**2 / RADIUS_M
CELLS = 48


def square(layer: Layer, cells: int = CELLS, width_m: float = 2.6 * CONTACT_M) -> tuple[Grid, np.ndarray]:
    """A grid and the places of its cells relative to its centre."""
    size = width_m / cells
    grid = Grid.of(layer, (cells, cells), size)
    return grid, grid.centres_m(np.full(2, -0.5 * (cells - 1) * size))


def sphere(places_m: np.ndarray, depth_m: float = DEPTH_M) -> np.ndarray:
    return depth_m - (places_m**2).sum(axis=-1) / (2 * RADIUS_M)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("thickness", [0.3, 1.0, 5.0])
def test_response_of_a_layer_solves_the_equations_of_elasticity(poisson: float, thickness: float) -> None:
    """One wave at a time, as a boundary value problem of ordinary differential equations in the depth.

    With u = (U sin kx, W cos kx), the state (U, W, shear stress, normal stress) has a linear equation."""
    if poisson == 0.5:
        poisson = 0.5 - 1e-9  # the normal stress of an incompressible layer is not a function of its strain
    layer = Layer(thickness, 1.0, poisson)
    g, k = layer.shear_modulus_pa, 1.0
    lam = 2 * g * poisson / (1 - 2 * poisson)
    m = lam + 2 * g
    slope = np.array(
        [
            [0, k, 1 / g, 0],
            [-k * lam / m, 0, 0, 1 / m],
            [k * k * (m - lam * lam / m), 0, 0, k * lam / m],
            [0, 0, -k, 0],
        ]
    )
    columns = (
        scipy.integrate.solve_ivp(
            lambda z, y: (slope @ y.reshape(4, 2)).ravel(),
            (0, thickness),
            np.array([[0, 0], [0, 0], [1, 0], [0, 1]], float).ravel(),
            rtol=1e-12,
            atol=1e-15,
        )
        .y[:, -1]
        .reshape(4, 2)
    )  # at the surface, for unit stresses at the base
    moved = columns[:2] @ np.linalg.inv(columns[2:])  # (U, W) per (shear, normal) stress at the surface
    normal, along, crossed, across = (float(each) / k for each in layer.response(np.array(k)))
    np.testing.assert_allclose(moved, [[along, crossed], [crossed, normal]], rtol=1e-6, atol=1e-7)
    assert across == pytest.approx(math.tanh(k * thickness) / (g * k))


@pytest.mark.parametrize("poisson", [0.2, 0.5])
def test_point_loads_on_a_half_space(poisson: float) -> None:
    """Far from a loaded cell: Boussinesq and Cerruti (Johnson, sections 3.2 and 3.6)."""
    layer = Layer(math.inf, 1e6, poisson)
    grid, places = square(layer, 41, 41e-3)
    g = layer.shear_modulus_pa
    x, y = places[..., 0], places[..., 1]
    r = np.hypot(x, y)
    far = r > 8 * grid.size_m
    for axis in range(3):
        traction = np.zeros((3, *grid.shape))
        traction[axis, 20, 20] = 1.0 / grid.size_m**2
        moved = grid.displacement_m(traction)[:, far] * 4 * math.pi * g
        at, along, across = r[far], x[far], y[far]
        expected = [
            [2 * (1 - poisson) / at + 2 * poisson * along**2 / at**3, 2 * poisson * along * across / at**3,
             -(1 - 2 * poisson) * along / at**2],
            [2 * poisson * along * across / at**3, 2 * (1 - poisson) / at + 2 * poisson * across**2 / at**3,
             -(1 - 2 * poisson) * across / at**2],
            [(1 - 2 * poisson) * along / at**2, (1 - 2 * poisson) * across / at**2, 2 * (1 - poisson) / at],
        ][axis]  # fmt: skip
        np.testing.assert_allclose(moved, expected, atol=0.01 / (8 * grid.size_m))


def test_a_sphere_on_a_half_space_is_hertz() -> None:
    """Force, pressure and depth at every place, from the depth alone (Johnson, section 4.2)."""
    layer = Layer(math.inf, 1e6, 0.5)
    grid, places = square(layer)
    pressure = press(grid, sphere(places))
    modulus = layer.contact_modulus_pa
    force = pressure.sum() * grid.size_m**2
    assert force == pytest.approx(4 / 3 * modulus * math.sqrt(RADIUS_M) * DEPTH_M**1.5, rel=1e-3)
    r = np.hypot(*np.moveaxis(places, -1, 0))
    peak = 2 * modulus * CONTACT_M / (math.pi * RADIUS_M)
    expected = peak * np.sqrt(np.maximum(1 - (r / CONTACT_M) ** 2, 0))
    inner = r < 0.9 * CONTACT_M
    np.testing.assert_allclose(pressure[inner], expected[inner], rtol=0.01)
    outside = np.maximum(r, CONTACT_M)
    sunk = (2 * CONTACT_M**2 - outside**2) * np.arcsin(CONTACT_M / outside)
    sunk = (sunk + outside * CONTACT_M * np.sqrt(1 - (CONTACT_M / outside) ** 2)) / (math.pi * RADIUS_M)
    moved = -grid.displacement_m(np.stack([0 * pressure, 0 * pressure, -pressure]))[2]
    ring = r > CONTACT_M
    np.testing.assert_allclose(moved[ring], sunk[ring], atol=0.005 * DEPTH_M)
    np.testing.assert_allclose(moved[inner], sphere(places)[inner], atol=1e-5 * DEPTH_M)


def test_pressure_does_not_depend_on_where_the_search_starts() -> None:
    """Not even from a press elsewhere, which the body has left altogether."""
    grid, places = square(Layer(1e-3, 1e6, 0.5))
    overlap = sphere(places - 0.5 * CONTACT_M, 0.2 * DEPTH_M)
    expected = press(grid, overlap)
    for start in (sphere(places + 0.6 * CONTACT_M, 0.1 * DEPTH_M), -overlap, np.eye(CELLS)):
        found = press(grid, overlap, 1e9 * np.maximum(start, 0.0))
        np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


def test_a_flat_punch() -> None:
    """The force of a cylinder is 2 a E* δ (Johnson, eq. 3.36); its rim is round only to half a cell."""
    layer = Layer(math.inf, 1e6, 0.5)
    grid, places = square(layer, 96)
    inside = np.hypot(*np.moveaxis(places, -1, 0)) < CONTACT_M
    pressure = press(grid, np.where(inside, DEPTH_M, -1.0))
    radius = math.sqrt(inside.sum() * grid.size_m**2 / math.pi)
    force = pressure.sum() * grid.size_m**2
    assert force == pytest.approx(2 * radius * layer.contact_modulus_pa * DEPTH_M, rel=0.01)
    assert not pressure[~inside].any()


def test_friction_of_a_sphere_is_that_of_cattaneo_and_mindlin() -> None:
    """Shear force and stick radius for a shift of the sphere in three steps (Johnson, section 7.2)."""
    layer, friction = Layer(math.inf, 1e6, 0.5), 0.5
    grid, places = square(layer)
    state = advance(grid, untouched(grid), sphere(places), np.zeros(2), friction)
    assert np.abs(state.force_n(grid)[:2]).max() < 1e-9
    limit = friction * -state.force_n(grid)[2]
    sliding = 3 * limit * (2 - 0.5) / (16 * CONTACT_M * layer.shear_modulus_pa)
    for share in (0.3, 0.6, 0.9):
        state = advance(grid, state, sphere(places), np.array([0.3 * sliding, 0.0]), friction)
        assert state.force_n(grid)[0] == pytest.approx(limit * (1 - (1 - share) ** 1.5), rel=0.005)
        radius = math.sqrt(state.sticks.sum() * grid.size_m**2 / math.pi)
        assert radius == pytest.approx(CONTACT_M * math.sqrt(1 - share), abs=0.6 * grid.size_m)
    state = advance(grid, state, sphere(places), np.array([10 * sliding, 0.0]), friction)
    assert state.force_n(grid)[0] == pytest.approx(limit, rel=1e-4)
    assert not state.sticks.any()


@pytest.mark.long
def test_friction_points_against_the_slide_and_never_exceeds_its_limit() -> None:
    layer, friction = Layer(2e-3, 1e6, 0.45), 0.4
    grid, places = square(layer, 32)
    state = untouched(grid)
    for step in range(6):
        slide = 4e-6 * np.array([math.cos(0.7 * step), math.sin(0.7 * step)])
        state = advance(grid, state, sphere(places), slide, friction)
        shear, pressure = np.hypot(*state.traction_pa[:2]), -state.traction_pa[2]
        assert (pressure >= 0).all()
        assert (shear <= friction * pressure * (1 + 1e-9)).all()
    slide = np.array([3e-3, 4e-3])
    force = advance(grid, state, sphere(places), slide, friction).force_n(grid)
    np.testing.assert_allclose(force[:2], -friction * force[2] * slide / 5e-3, rtol=0.005)


@pytest.mark.long
def test_a_thin_bonded_film_presses_as_its_lubrication_equation() -> None:
    """An incompressible film much thinner than the contact: δ − r²/2R = −t³/(3G) ∇²p (Johnson, section 5.8).

    For a sphere p = 3G (a² − r²)² / (32 R t³) and δ = a²/4R; at t = a/40 it is 0.7 % more."""
    layer = Layer(25e-6, 1e6, 0.5)
    grid, places = square(layer, 160)
    depth = CONTACT_M**2 / (4 * RADIUS_M)
    pressure = press(grid, sphere(places, depth))
    r2 = (places**2).sum(axis=-1)
    peak = 3 * layer.shear_modulus_pa / (32 * RADIUS_M * layer.thickness_m**3)
    expected = peak * np.maximum(CONTACT_M**2 - r2, 0) ** 2
    force = pressure.sum() * grid.size_m**2
    assert force == pytest.approx(expected.sum() * grid.size_m**2, rel=0.01)


def test_a_layer_thicker_than_the_contact_is_nearly_a_half_space() -> None:
    forces = []
    for thickness in (math.inf, 100 * CONTACT_M):
        grid, places = square(Layer(thickness, 1e6, 0.5), 32)
        forces.append(press(grid, sphere(places)).sum())
    assert forces[1] == pytest.approx(forces[0], rel=0.02)
    assert forces[1] > forces[0]


@pytest.mark.parametrize(
    ("options", "what"),
    [((0.0, 1e6, 0.5), "thickness_m"), ((1e-3, -1.0, 0.5), "young_pa"), ((1e-3, 1e6, 0.6), "poisson")],
)
def test_a_layer_out_of_range_is_refused(options: tuple[float, float, float], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        Layer(*options)
