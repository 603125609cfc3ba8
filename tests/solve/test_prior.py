"""The elastic prior: the half-space's response, summed load by load, wherever the skin lies in space."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import skinnode as sk
from skinnode.model.elastic import HertzContact, Rubber, rectangle_compliance
from skinnode.solve.posterior.elastic_prior import MARGIN, SHEAR_SHARE, SLACK, ElasticPrior


def flat(wires: int, electrodes: int, name: str = "staggered") -> sk.PatchLayout:
    return sk.PatchLayout.preset(name, upper_wires=wires, upper_electrodes=electrodes, lower_electrodes=5)


def cylinder(
    *, wires: int = 5, electrodes: int = 6, turn: bool = False, inward: bool = False
) -> sk.PatchLayout:
    """Wires around a cylinder of 15 mm, the upper layer 2 mm outside of the lower or inside."""
    height = -2e-3 if inward else 2e-3

    def around(radius: float, angles: np.ndarray, along: np.ndarray) -> np.ndarray:
        angle, y = np.meshgrid(angles, along)
        return np.stack([radius * np.sin(angle), y, radius * np.cos(angle)], axis=-1)

    angles = np.linspace(-0.6, 0.6, electrodes)
    upper = around(15e-3 + height, angles[::-1] if turn else angles, np.arange(wires) * 4e-3)
    lower = around(15e-3, np.linspace(-0.7, 0.7, 3 * electrodes), np.arange(wires) * 4e-3 + 1e-3)
    return sk.PatchLayout(upper, lower.transpose(1, 0, 2))


def moved_by(
    layout: sk.PatchLayout, turn: np.ndarray, shift_m: float = 0.0, stretch: float = 1.0
) -> sk.PatchLayout:
    return sk.PatchLayout(
        stretch * layout.upper_m @ turn.T + shift_m, stretch * layout.lower_m @ turn.T + shift_m
    )


@pytest.mark.parametrize("poisson", [0.5, 0.3])
@pytest.mark.parametrize("name", ["staggered", "aligned"])
def test_covariance_is_the_sum_over_independent_loads(name, poisson):
    """Load by load over a lattice written out here, in metres, scaled to a median normal deviation of 1."""
    rubber, pitch = Rubber(poisson=poisson), 4e-3
    layout = flat(4, 6, name)
    prior = ElasticPrior.of(layout, rubber)
    points = layout.upper_m.reshape(-1, 3)[:, :2]
    total = np.zeros((72, 72))
    for row in range(-MARGIN, 4 + MARGIN):
        for column in range(-MARGIN, 6 + MARGIN):
            offset = points - pitch * np.array([column, row])
            moved = rectangle_compliance(rubber, offset, (pitch, pitch)).reshape(72, 3)
            for component, share in enumerate((SHEAR_SHARE, SHEAR_SHARE, 1.0)):
                total += share**2 * np.outer(moved[:, component], moved[:, component])
    total /= np.median(np.diag(total)[2::3])
    np.testing.assert_allclose(prior.covariance, total + SLACK**2 * np.eye(72), rtol=1e-9, atol=1e-12)


LAYOUTS = {
    "flat": flat(4, 6),
    "cylinder": cylinder(),
    "inside of a cylinder": cylinder(inward=True),
    "one wire": flat(1, 6),
    "one electrode a wire": flat(6, 1),
    "one electrode": flat(1, 1),
    "two": flat(1, 2),
    "one lower electrode": sk.PatchLayout.preset(
        "aligned", upper_wires=1, upper_electrodes=1, lower_wires=1, lower_electrodes=1
    ),
    "curved wire": cylinder(wires=1),
    "curved row": sk.PatchLayout(cylinder().upper_m[:, :1], cylinder().lower_m),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_has_a_regular_prior_of_unit_scale(name):
    layout = LAYOUTS[name]
    prior = ElasticPrior.of(layout)
    c = prior.covariance
    assert np.isfinite(prior.response).all()
    np.testing.assert_allclose(c, c.T, rtol=0, atol=1e-14)
    lowest, *_, highest = np.linalg.eigvalsh(c)
    assert 0.9 * SLACK**2 < lowest <= highest < 3 * layout.upper_m.shape[0] * layout.unknowns
    np.testing.assert_allclose(prior.response @ prior.response.T + SLACK**2 * np.eye(len(c)), c, atol=1e-12)
    own = prior.frame[prior.own_cells()]
    blocks = c.reshape(*own.shape[:2], 3, *own.shape[:2], 3)
    normal = np.einsum("una,unaunb,unb->un", own[..., 2, :], blocks, own[..., 2, :])
    assert np.median(normal) == pytest.approx(1.0 + SLACK**2, rel=1e-9)


@pytest.mark.parametrize("name", LAYOUTS)
def test_frames_are_right_handed_and_lie_on_the_electrodes(name):
    layout = LAYOUTS[name]
    prior = ElasticPrior.of(layout)
    np.testing.assert_allclose(prior.cell_m[prior.own_cells()], layout.upper_m, rtol=0, atol=1e-12)
    eye = np.broadcast_to(np.eye(3), prior.frame.shape)
    np.testing.assert_allclose(prior.frame @ prior.frame.transpose(0, 2, 1), eye, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(prior.frame), 1.0)


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("inward", [False, True])
def test_normals_point_out_of_the_skin(turn, inward):
    """Away from the lower layer, whichever way the wires run. Tangents along the wires."""
    layout = cylinder(turn=turn, inward=inward)
    prior = ElasticPrior.of(layout)
    out = layout.upper_m * [1.0, 0.0, 1.0]
    out /= np.linalg.norm(out, axis=-1, keepdims=True) * (-1 if inward else 1)
    frame = prior.frame[prior.own_cells()]
    assert (np.einsum("uni,uni->un", frame[..., 2, :], out) > np.cos(0.13)).all()  # half a step of the wire
    inner = np.einsum("uni,uni->un", frame[..., 2, :], out)[:, 1:-1]
    np.testing.assert_allclose(inner, 1.0, atol=1e-9)
    chord = layout.upper_m[:, 2:] - layout.upper_m[:, :-2]
    chord /= np.linalg.norm(chord, axis=-1, keepdims=True)
    np.testing.assert_allclose(frame[:, 1:-1, 0], chord, atol=1e-9)


@pytest.mark.parametrize("name", ["flat", "cylinder", "one wire", "one electrode a wire", "curved wire"])
def test_a_patch_may_lie_anywhere_in_space_at_any_size(name):
    """Turned and shifted, displacements turn with it; a scale model has the same prior in pitches."""
    layout = LAYOUTS[name]
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    there = ElasticPrior.of(moved_by(layout, turn, 0.3, 2.5)).covariance
    here = ElasticPrior.of(layout).covariance
    back = np.kron(np.eye(len(here) // 3), turn)
    np.testing.assert_allclose(there, back @ here @ back.T, rtol=0, atol=1e-9)


def test_a_gently_curved_skin_has_almost_the_flat_prior():
    """Unrolled: on a cylinder of 100 pitches, in the frame of each electrode, within 2 %."""
    sheet = flat(4, 6)
    x, y, z = np.moveaxis(sheet.upper_m, -1, 0)
    radius = 0.4
    roll = sk.PatchLayout(
        np.stack([(radius + z) * np.sin(x / radius), y, (radius + z) * np.cos(x / radius) - radius], -1),
        sheet.lower_m,
    )
    prior = ElasticPrior.of(roll)
    own = prior.frame[prior.own_cells()].reshape(-1, 3, 3)
    blocks = prior.covariance.reshape(24, 3, 24, 3)
    unrolled = np.einsum("eai,eifj,fbj->eafb", own, blocks, own).reshape(72, 72)
    np.testing.assert_allclose(unrolled, ElasticPrior.of(sheet).covariance, rtol=0, atol=0.02)


@pytest.mark.parametrize("young_pa", [0.1e6, 0.7e6, 3e6])
def test_modulus_scales_the_forces_alone(young_pa):
    layout = cylinder()
    soft, other = ElasticPrior.of(layout, Rubber(1e6)), ElasticPrior.of(layout, Rubber(young_pa))
    np.testing.assert_allclose(other.load_n, soft.load_n * young_pa / 1e6, rtol=1e-12)
    np.testing.assert_allclose(other.covariance, soft.covariance, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(other.response, soft.response, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("poisson", [0.5, 0.35])
def test_loads_in_newtons_give_the_displacement_of_a_hertz_contact(poisson):
    """A wide contact with shear, cut into the prior's cells: Hertz's closed form within 2 % of its depth."""
    rubber = Rubber(young_pa=0.4e6, poisson=poisson)
    layout = sk.PatchLayout.preset("staggered", pitch_m=1e-3, height_m=1e-3, lower_electrodes=4)
    prior = ElasticPrior.of(layout, rubber)
    sphere = HertzContact(rubber, 40e-3, 0.3e-3, (4.6e-3, 4.3e-3), (0.3, -0.2))  # contact of 3.5 pitches
    sub = (np.arange(10) - 4.5) * 1e-4
    points = (prior.cell_m[:, None, :2] + np.stack(np.meshgrid(sub, sub), -1).reshape(-1, 2)).reshape(-1, 2)
    force = sphere.traction_pa(points).reshape(-1, 100, 3).mean(axis=1) * prior.cell_area_m2
    moved_m = (prior.response @ (force / prior.load_n).ravel()).reshape(-1, 3) * layout.pitch_m
    expected = sphere.displacement_m(layout.upper_m.reshape(-1, 3)[:, :2])
    np.testing.assert_allclose(moved_m, expected, rtol=0, atol=0.02 * 0.3e-3)
    assert force.sum(axis=0) == pytest.approx(sphere.force_n, rel=0.01)
