"""Shapes against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skinnode.model.layout import Float
from skinnode.view.geometry import RING_POINTS, displaced_m, edge_m, force_n, normals, ring_m, triangles

from .conftest import a_contact


def plane(wires: int, electrodes: int, dx: float = 4e-3, dy: float = 3e-3) -> Float:
    x, y = np.meshgrid(dx * np.arange(electrodes), dy * np.arange(wires))
    return np.stack([x, y, np.full_like(x, 2e-3)], axis=-1)


@pytest.mark.parametrize(("wires", "electrodes"), [(2, 2), (4, 7), (10, 10)])
def test_triangles_cover_the_patch_once_and_face_outwards(wires: int, electrodes: int) -> None:
    points = plane(wires, electrodes).reshape(-1, 3)
    a, b, c = (points[corner] for corner in triangles(wires, electrodes).T)
    doubled = np.cross(b - a, c - a)
    assert len(doubled) == 2 * (wires - 1) * (electrodes - 1)
    assert (doubled[:, 2] > 0).all()
    area = 0.5 * doubled[:, 2].sum()
    assert area == pytest.approx(4e-3 * (electrodes - 1) * 3e-3 * (wires - 1), rel=1e-12)
    centres = {tuple(np.round(1e6 * centre).astype(int)) for centre in (a + b + c) / 3}
    assert len(centres) == len(doubled)  # none is drawn twice


@pytest.mark.parametrize(("wires", "electrodes"), [(1, 1), (1, 6), (6, 1)])
def test_a_single_row_of_electrodes_is_no_surface(wires: int, electrodes: int) -> None:
    assert triangles(wires, electrodes).shape == (0, 3)
    assert np.array_equal(
        normals(plane(wires, electrodes)), np.broadcast_to([0, 0, 1], (wires, electrodes, 3))
    )


def test_normals_of_a_paraboloid() -> None:
    """Central differences are exact for polynomials of second degree."""
    surface = plane(9, 8)
    x, y = surface[..., 0], surface[..., 1]
    surface[..., 2] = 7.0 * x**2 - 5.0 * y**2 + 3.0 * x * y
    expected = np.stack([-(14.0 * x + 3.0 * y), -(-10.0 * y + 3.0 * x), np.ones_like(x)], axis=-1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    inside = (slice(1, -1), slice(1, -1))
    assert normals(surface)[inside] == pytest.approx(expected[inside], abs=1e-12)
    assert np.linalg.norm(normals(surface), axis=-1) == pytest.approx(1.0, abs=1e-12)


def test_normals_where_electrodes_coincide_are_finite() -> None:
    assert np.isfinite(normals(np.zeros((3, 3, 3)))).all()


def test_unknown_displacements_are_drawn_at_rest_and_the_others_enlarged() -> None:
    rest, moved = plane(3, 3), np.full((3, 3, 3), 1e-5)
    moved[1, 1] = np.nan
    drawn = displaced_m(rest, moved, 20.0)
    assert drawn[0, 0] == pytest.approx(rest[0, 0] + 2e-4)
    assert np.array_equal(drawn[1, 1], rest[1, 1])


@pytest.mark.parametrize(("wires", "electrodes"), [(2, 2), (3, 5), (1, 4), (4, 1), (1, 1)])
def test_the_edge_is_closed_and_runs_round_the_patch(wires: int, electrodes: int) -> None:
    edge = edge_m(plane(wires, electrodes))
    width, height = 4e-3 * (electrodes - 1), 3e-3 * (wires - 1)
    assert np.array_equal(edge[0], edge[-1])
    assert np.linalg.norm(np.diff(edge, axis=0), axis=1).sum() == pytest.approx(2 * (width + height))
    x, y = edge[:, 0], edge[:, 1]
    assert 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() == pytest.approx(width * height)


def test_the_ring_has_the_area_of_the_contact_and_lies_in_its_plane() -> None:
    axes = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix()
    contact = a_contact(axes=axes)
    ring = ring_m(contact, lift_m=1e-4)
    relative = (ring - contact.centroid_m) @ axes.T
    assert relative[:, 2] == pytest.approx(1e-4)
    x, y = relative[:, 0], relative[:, 1]
    step = 2 * math.pi / (RING_POINTS - 1)
    area = 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum()
    assert area == pytest.approx(contact.area_m2 * math.sin(step) / step, rel=1e-9)
    assert ring[0] == pytest.approx(ring[-1])


def test_a_press_pushes_into_the_skin_along_the_axes_of_the_contact() -> None:
    assert force_n(a_contact(2.0, (0.3, -0.4))) == pytest.approx([0.3, -0.4, -2.0])
    turned = Rotation.from_euler("zyx", [0.7, 0.2, -1.1])
    contact = a_contact(2.0, (0.3, -0.4), axes=turned.as_matrix().T)  # rows are the turned unit vectors
    assert force_n(contact) == pytest.approx(turned.apply([0.3, -0.4, -2.0]))
