"""Surface displacement of the half-space against the closed forms of the literature and plain quadrature."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import dblquad

from skinnode.model.elastic import HertzContact, Rubber, point_compliance, rectangle_compliance

SOFT = Rubber(young_pa=0.5e6, poisson=0.3)  # not incompressible, so that every term of the kernel counts
RADIUS, INDENTATION = 8e-3, 0.4e-3
A = math.sqrt(RADIUS * INDENTATION)
SHEAR = (0.21, -0.34)


def kernel(rubber: Rubber, x: float, y: float) -> NDArray[np.float64]:
    """Johnson eqs. 3.18 and 3.75 at z = 0, term by term in his axes (z into the body), turned into ours."""
    g, nu = rubber.young_pa / 2 / (1 + rubber.poisson), rubber.poisson
    r = math.hypot(x, y)
    tangential_x = [1 / r + x**2 / r**3 + (1 - 2 * nu) * (1 / r - x**2 / r**3)]
    tangential_x += [x * y / r**3 - (1 - 2 * nu) * x * y / r**3, (1 - 2 * nu) * x / r**2]
    tangential_y = [x * y / r**3 - (1 - 2 * nu) * x * y / r**3]
    tangential_y += [1 / r + y**2 / r**3 + (1 - 2 * nu) * (1 / r - y**2 / r**3), (1 - 2 * nu) * y / r**2]
    normal = [-(1 - 2 * nu) * x / r**2, -(1 - 2 * nu) * y / r**2, 2 * (1 - nu) / r]
    flip = np.diag([1.0, 1.0, -1.0])
    return np.asarray(flip @ np.array([tangential_x, tangential_y, normal]).T @ flip / (4 * math.pi * g))


def by_cells(contact: HertzContact, points: NDArray[np.float64], cells: int) -> NDArray[np.float64]:
    """The displacement under the contact's traction, taken as uniform on each of cells × cells squares."""
    a = contact.contact_radius_m
    size = 2 * a / cells
    axis = (np.arange(cells) + 0.5) * size - a
    middles = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2) + contact.center_m
    traction = contact.traction_pa(middles)
    loaded = np.any(traction != 0, axis=1)
    moved = np.zeros((len(points), 3))
    for i, point in enumerate(points):
        matrix = rectangle_compliance(contact.rubber, point - middles[loaded], (size, size))
        moved[i] = np.einsum("cij,cj->i", matrix, traction[loaded])
    return moved


def rays(*distances: float) -> NDArray[np.float64]:
    """Points on eight rays from the origin."""
    angles = 0.3 + np.arange(8) * math.pi / 4
    return np.array([(r * math.cos(t), r * math.sin(t)) for r in distances for t in angles])


def test_point_load_is_boussinesq_and_cerruti() -> None:
    points = rays(0.3e-3, 2e-3, 0.05)
    expected = [kernel(SOFT, x, y) for x, y in points]
    np.testing.assert_allclose(point_compliance(SOFT, points), expected, rtol=1e-13, atol=1e-18)


def test_softening_spreads_the_point_load_and_is_forgotten_far_away() -> None:
    at_load = point_compliance(SOFT, [(0.0, 0.0)], softening_m=1e-3)[0]
    g = SOFT.shear_modulus_pa
    np.testing.assert_allclose(at_load, np.eye(3) * (1 - SOFT.poisson) / (2 * math.pi * g * 1e-3), rtol=1e-14)
    far = rays(0.1)
    np.testing.assert_allclose(
        point_compliance(SOFT, far, softening_m=1e-3), point_compliance(SOFT, far), rtol=3e-4, atol=1e-9
    )


@pytest.mark.parametrize(("x", "y"), [(1.7e-3, 0.4e-3), (-0.9e-3, 1.1e-3), (0.5e-3, -4e-3)])
def test_rectangle_is_the_integral_of_the_point_load(x: float, y: float) -> None:
    a, b = 0.6e-3, 0.35e-3  # half lengths

    def integral(i: int, j: int) -> float:
        def integrand(t: float, s: float) -> float:
            return float(kernel(SOFT, x - s, y - t)[i, j])

        return float(dblquad(integrand, -a, a, -b, b, epsabs=0, epsrel=1e-11)[0])

    expected = [[integral(i, j) for j in range(3)] for i in range(3)]
    got = rectangle_compliance(SOFT, [(x, y)], (2 * a, 2 * b))[0]
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_centre_and_corner_of_a_loaded_square() -> None:
    """Textbook values: centre 4 ln(1 + √2)/π · p L (1 − ν²)/E, corner half of that (Johnson section 3.3)."""
    side = 2e-3
    unit = side * (1 - SOFT.poisson**2) / SOFT.young_pa
    centre, corner, edge = rectangle_compliance(
        SOFT, [(0.0, 0.0), (side / 2, side / 2), (side / 2, 0.0)], (side, side)
    )
    assert centre[2, 2] == pytest.approx(4 * math.log(1 + math.sqrt(2)) / math.pi * unit, rel=1e-13)
    assert corner[2, 2] == pytest.approx(0.5 * centre[2, 2], rel=1e-13)
    assert np.isfinite(edge).all()
    np.testing.assert_allclose(centre[:2, 2], 0, atol=1e-20)  # symmetry


def test_rectangle_on_its_edges_is_the_limit_from_either_side() -> None:
    half, tiny = 1e-3, 1e-12
    for point in [(half, 0.3e-3), (0.2e-3, -half), (half, half), (half, 5e-3)]:
        on = rectangle_compliance(SOFT, [point], (2 * half, 2 * half))[0]
        around = [(point[0] + dx, point[1] + dy) for dx in (-tiny, tiny) for dy in (-tiny, tiny)]
        for beside in rectangle_compliance(SOFT, around, (2 * half, 2 * half)):
            np.testing.assert_allclose(beside, on, rtol=1e-7, atol=1e-7 * on[2, 2])


def test_rectangles_add_up() -> None:
    """Four quarters are the whole, inside, outside and on the seams."""
    points = np.array([(0.1e-3, 0.2e-3), (0.0, 0.0), (0.5e-3, 0.0), (3e-3, -2e-3)])
    whole = rectangle_compliance(SOFT, points, (2e-3, 1e-3))
    quarters = [
        rectangle_compliance(SOFT, points - (sx * 0.5e-3, sy * 0.25e-3), (1e-3, 0.5e-3))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    np.testing.assert_allclose(sum(quarters), whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("compliance", ["point", "rectangle"])
def test_reciprocity(compliance: str) -> None:
    """Betti: what a load j here does to component i there, a load i there does to component j here."""
    points = rays(0.7e-3, 3e-3)

    def at(offset: NDArray[np.float64]) -> NDArray[np.float64]:
        if compliance == "point":
            return point_compliance(SOFT, offset)
        return rectangle_compliance(SOFT, offset, (0.4e-3, 0.4e-3))

    np.testing.assert_allclose(at(points), at(-points).transpose(0, 2, 1), rtol=1e-11, atol=1e-16)


def test_far_from_a_rectangle_only_its_force_counts() -> None:
    size = (0.5e-3, 0.5e-3)
    errors = []
    for distance in (5e-3, 50e-3):
        points = rays(distance)
        force = point_compliance(SOFT, points) * size[0] * size[1]
        errors.append(np.abs(rectangle_compliance(SOFT, points, size) - force).max() / np.abs(force).max())
    assert errors[0] < 2e-3
    assert errors[1] < 2e-5  # the next multipole decays two powers faster


def test_hertz_normal_displacement_is_johnsons() -> None:
    """Johnson eqs. 3.41 and 3.42 (downwards and outwards positive there), inside and outside."""
    contact = HertzContact(SOFT, RADIUS, INDENTATION)
    e, nu, p0 = SOFT.young_pa, SOFT.poisson, contact.peak_pressure_pa
    for r in (0.0, 0.2 * A, 0.99 * A, 1.01 * A, 3 * A, 30 * A):
        if r <= A:
            down = (1 - nu**2) / e * math.pi * p0 / (4 * A) * (2 * A**2 - r**2)
            outward = 0.0
            if r > 0:
                outward = -(1 - 2 * nu) * (1 + nu) / (3 * e) * A**2 / r * p0 * (1 - (1 - (r / A) ** 2) ** 1.5)
        else:
            down = (2 * A**2 - r**2) * math.asin(A / r) + r * A * math.sqrt(1 - (A / r) ** 2)
            down *= (1 - nu**2) / e * p0 / (2 * A)
            outward = -(1 - 2 * nu) * (1 + nu) / (3 * e) * A**2 / r * p0
        got = contact.displacement_m([(0.6 * r, -0.8 * r)])[0]
        np.testing.assert_allclose(got, (0.6 * outward, -0.8 * outward, -down), rtol=1e-10, atol=1e-18)


def test_indentation_is_the_deepest_point_and_fits_the_sphere() -> None:
    contact = HertzContact(Rubber(), RADIUS, INDENTATION, center_m=(2e-3, -1e-3))
    inside = np.array([(r * math.cos(t), r * math.sin(t)) for r in np.linspace(0, A, 9) for t in (0.1, 2.0)])
    down = -contact.displacement_m(inside + np.array([2e-3, -1e-3]))[:, 2]
    assert down[0] == pytest.approx(INDENTATION, rel=1e-13)
    np.testing.assert_allclose(down, INDENTATION - (inside**2).sum(axis=1) / (2 * RADIUS), rtol=1e-12)


def test_hertz_load() -> None:
    """P = 4/3 E* √R δ^{3/2}, and the traction adds up to the force."""
    contact = HertzContact(SOFT, RADIUS, INDENTATION, traction_ratio=SHEAR)
    load = 4 / 3 * SOFT.young_pa / (1 - SOFT.poisson**2) * math.sqrt(RADIUS) * INDENTATION**1.5
    np.testing.assert_allclose(contact.force_n, (SHEAR[0] * load, SHEAR[1] * load, -load), rtol=1e-13)
    step = 2 * A / 800
    axis = (np.arange(800) + 0.5) * step - A
    traction = contact.traction_pa(np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2))
    np.testing.assert_allclose(traction.sum(axis=0) * step**2, contact.force_n, rtol=1e-4)


def test_tangential_traction_inside_is_johnsons() -> None:
    """Johnson eq. 3.91: q = q₀ √(1 − r²/a²) along x, displacement inside the circle."""
    rubber = Rubber(0.5e6, 0.5)  # no coupling: the shear's part is what changes with the traction ratio
    q = 0.4
    dragged = HertzContact(rubber, RADIUS, INDENTATION, traction_ratio=(q, 0))
    q0, g, nu = q * dragged.peak_pressure_pa, rubber.shear_modulus_pa, rubber.poisson
    for x, y in ((0.0, 0.0), (0.5 * A, 0.0), (0.0, -0.5 * A), (0.6 * A, 0.7 * A)):
        scale = math.pi * q0 / (32 * g * A)
        u_x = scale * (4 * (2 - nu) * A**2 - (4 - 3 * nu) * x**2 - (4 - nu) * y**2)
        u_y = scale * 2 * nu * x * y
        np.testing.assert_allclose(
            dragged.displacement_m([(x, y)])[0, :2], (u_x, u_y), rtol=1e-12, atol=1e-18
        )


@pytest.mark.parametrize("poisson", [0.3, 0.5])
def test_hertz_field_is_the_limit_of_loaded_squares(poisson: float) -> None:
    """Every component, with shear in both directions, inside and outside, from an independent summation."""
    contact = HertzContact(Rubber(0.5e6, poisson), RADIUS, INDENTATION, (3e-3, 1e-3), SHEAR)
    points = rays(1e-9, 0.4 * A, 0.9 * A, 1.1 * A, 2 * A, 8 * A) + np.array([3e-3, 1e-3])
    exact = contact.displacement_m(points)
    errors = [np.abs(by_cells(contact, points, cells) - exact).max() / INDENTATION for cells in (20, 40, 80)]
    assert errors[2] < 2e-4
    assert errors[0] / errors[2] > 4  # at least first order, so the limit is this field and not one beside it


def test_far_from_the_contact_only_its_force_counts() -> None:
    contact = HertzContact(SOFT, RADIUS, INDENTATION, traction_ratio=SHEAR)
    for distance, tolerance in ((10 * A, 1e-2), (100 * A, 1e-4)):
        points = rays(distance)
        expected = point_compliance(SOFT, points) @ np.array(contact.force_n)
        got = contact.displacement_m(points)
        np.testing.assert_allclose(got, expected, atol=tolerance * np.abs(expected).max())


def test_field_is_continuous_at_the_edge_of_the_contact() -> None:
    contact = HertzContact(SOFT, RADIUS, INDENTATION, traction_ratio=SHEAR)
    inside, outside = (
        contact.displacement_m(rays(A * (1 - 1e-9))),
        contact.displacement_m(rays(A * (1 + 1e-9))),
    )
    np.testing.assert_allclose(inside, outside, atol=1e-7 * INDENTATION)


def test_turning_the_drag_turns_the_field() -> None:
    angle = 1.1
    turn = np.array([(math.cos(angle), -math.sin(angle)), (math.sin(angle), math.cos(angle))])
    points = rays(0.5 * A, 3 * A)
    straight = HertzContact(SOFT, RADIUS, INDENTATION, traction_ratio=SHEAR).displacement_m(points)
    shear = turn @ SHEAR
    turned = HertzContact(SOFT, RADIUS, INDENTATION, traction_ratio=(shear[0], shear[1]))
    moved = turned.displacement_m(points @ turn.T)
    np.testing.assert_allclose(moved[:, :2], straight[:, :2] @ turn.T, rtol=1e-11, atol=1e-17)
    np.testing.assert_allclose(moved[:, 2], straight[:, 2], rtol=1e-11, atol=1e-17)


def test_no_contact_moves_nothing() -> None:
    contact = HertzContact(Rubber(), RADIUS, 0.0, traction_ratio=SHEAR)
    assert not contact.displacement_m(rays(0.0, 1e-3)).any()
    assert not contact.traction_pa(rays(0.0, 1e-3)).any()
    assert contact.force_n == (0.0, 0.0, -0.0)


def test_the_first_touch_is_smooth() -> None:
    """A contact far smaller than the distance of the points: no cancellation blows the field up."""
    contact = HertzContact(SOFT, RADIUS, 1e-12, traction_ratio=SHEAR)
    points = rays(1e-3, 36e-3)
    expected = point_compliance(SOFT, points) @ np.array(contact.force_n)
    np.testing.assert_allclose(contact.displacement_m(points), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda: Rubber(young_pa=0), "young_pa: got 0"),
        (lambda: Rubber(poisson=0.6), "poisson: got 0.6"),
        (lambda: HertzContact(Rubber(), -1.0, 1e-4), "radius_m: got -1.0"),
        (lambda: HertzContact(Rubber(), 1e-2, math.nan), "indentation_m: got nan"),
        (lambda: HertzContact(Rubber(), 1e-2, 1e-4, (0.0, math.inf)), "center_m: got"),
        (lambda: HertzContact(Rubber(), 1e-2, 1e-4).displacement_m([(0, 0, 0)]), "points_m: got shape"),
        (lambda: point_compliance(Rubber(), [(0.0, math.nan)]), "offset_m: got nan"),
        (lambda: point_compliance(Rubber(), [(0.0, 1.0)], softening_m=-1), "softening_m: got -1"),
        (lambda: rectangle_compliance(Rubber(), [(0.0, 1.0)], (1.0, 0.0)), "size_m: got"),
    ],
)
def test_bad_input_names_the_argument(make: Callable[[], object], names: str) -> None:
    with pytest.raises(ValueError, match=names):
        make()
