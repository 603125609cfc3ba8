"""Contacts and wrenches on links and on the hand, against SciPy's rotations, virtual work and sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skinnode.bench.cases import fingertip
from skinnode.bench.truth import Press, Skin
from skinnode.model.frames import Contact
from skinnode.model.hand_contact import HAND, HandContact, Mount, wrench_of
from skinnode.model.layout import PatchLayout
from skinnode.model.pose import Pose
from skinnode.solve.posterior.posterior import Posterior

Float = NDArray[np.float64]


def a_pose(rng: np.random.Generator) -> tuple[Pose, Rotation, Float]:
    turn, at_m = Rotation.random(random_state=rng), rng.uniform(-0.2, 0.2, 3)
    return Pose(tuple(at_m), tuple(turn.as_quat())), turn, at_m


def a_contact(rng: np.random.Generator, **changes: object) -> Contact:
    values = {
        "centroid_m": rng.uniform(0.0, 0.04, 3),
        "centroid_std_m": rng.uniform(1e-4, 1e-3, 3),
        "area_m2": 1e-4,
        "area_std_m2": 1e-5,
        "normal_force_n": float(rng.uniform(0.5, 5.0)),
        "normal_force_std_n": float(rng.uniform(0.01, 0.1)),
        "shear_force_n": rng.normal(0.0, 1.0, 2),
        "shear_force_std_n": rng.uniform(0.01, 0.1, 2),
    }
    return Contact(**{**values, **changes})


def pressed_n(contact: Contact) -> Float:
    """The force on the skin in the frame of a flat patch: a press points to −z."""
    return np.array([*contact.shear_force_n, -contact.normal_force_n])


@pytest.mark.parametrize("seed", range(5))
def test_poses_in_a_chain_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (outer, outer_turn, outer_m), (inner, inner_turn, inner_m) = a_pose(rng), a_pose(rng)
    point_m = rng.normal(size=3)
    expected_m = outer_turn.apply(inner_turn.apply(point_m) + inner_m) + outer_m
    np.testing.assert_allclose((outer @ inner).points_m(point_m), expected_m, atol=1e-14)
    np.testing.assert_allclose((outer @ inner).rotation, (outer_turn * inner_turn).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        outer.inverse().points_m(expected_m), outer_turn.inv().apply(expected_m - outer_m)
    )
    for back in (outer @ outer.inverse(), outer.inverse() @ outer):
        np.testing.assert_allclose(back.points_m(point_m), point_m, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_a_contact_in_the_frames_of_link_and_hand(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (patch, patch_turn, patch_m), (link, link_turn, link_m) = a_pose(rng), a_pose(rng)
    contact = a_contact(rng)
    on_link = HandContact.on_link(contact, "tip", Mount("distal", patch), trusted=True)
    in_hand = on_link.moved(link)
    assert (on_link.patch, on_link.link, on_link.frame) == ("tip", "distal", "distal")
    assert (in_hand.patch, in_hand.link, in_hand.frame) == ("tip", "distal", HAND)
    there_m = patch_turn.apply(contact.centroid_m) + patch_m
    np.testing.assert_allclose(on_link.position_m, there_m, atol=1e-15)
    np.testing.assert_allclose(in_hand.position_m, link_turn.apply(there_m) + link_m, atol=1e-15)
    both = link_turn * patch_turn
    np.testing.assert_allclose(in_hand.force_n, both.apply(pressed_n(contact)), atol=1e-14)
    np.testing.assert_allclose(in_hand.normal, both.apply([0.0, 0.0, 1.0]), atol=1e-14)
    assert in_hand.force_n @ in_hand.normal == pytest.approx(-contact.normal_force_n)
    turned = both.as_matrix()
    variance = np.array([*contact.shear_force_std_n, contact.normal_force_std_n]) ** 2
    np.testing.assert_allclose(in_hand.force_std_n**2, turned**2 @ variance)
    np.testing.assert_allclose(in_hand.position_std_m**2, turned**2 @ contact.centroid_std_m**2)


@pytest.mark.parametrize("seed", range(5))
def test_a_wrench_does_the_same_work_in_every_frame(seed: int) -> None:
    """Power of the forces on a link that moves as a rigid body, in the frame of the link and of the hand."""
    rng = np.random.default_rng(seed)
    (patch, _, _), (link, link_turn, link_m) = a_pose(rng), a_pose(rng)
    mount = Mount("distal", patch)
    contacts = [HandContact.on_link(a_contact(rng), "tip", mount, trusted=True) for _ in range(3)]
    wrench = wrench_of(contacts, "distal", trusted=True)
    spin, speed_m_s = rng.normal(size=3), rng.normal(size=3)  # of the link, in its own frame, at its origin
    power_w = sum(c.force_n @ (speed_m_s + np.cross(spin, c.position_m)) for c in contacts)
    assert wrench.force_n @ speed_m_s + wrench.torque_nm @ spin == pytest.approx(power_w)
    in_hand, turned = wrench.moved(link), link_turn.apply(spin)
    at_origin_m_s = link_turn.apply(speed_m_s) - np.cross(turned, link_m)
    assert in_hand.frame == HAND
    assert in_hand.force_n @ at_origin_m_s + in_hand.torque_nm @ turned == pytest.approx(power_w)


def test_the_wrench_of_two_patches_is_the_sum_of_theirs() -> None:
    rng = np.random.default_rng(7)
    contacts = []
    for patch in ("palm", "heel"):
        mount = Mount("palm_link", a_pose(rng)[0])
        contacts.append(HandContact.on_link(a_contact(rng), patch, mount, trusted=True))
    alone = [wrench_of([contact], "palm_link", trusted=True) for contact in contacts]
    both = wrench_of(contacts, "palm_link", trusted=True)
    np.testing.assert_allclose(both.force_n, alone[0].force_n + alone[1].force_n)
    np.testing.assert_allclose(both.torque_nm, alone[0].torque_nm + alone[1].torque_nm)
    np.testing.assert_allclose(both.covariance, alone[0].covariance + alone[1].covariance)
    assert both.contacts == 2


def test_a_press_at_the_end_of_a_lever() -> None:
    """10 N down at 0.1 m along x: 1 N m about +y."""
    contact = a_contact(
        np.random.default_rng(0),
        centroid_m=np.array([0.1, 0.0, 0.0]),
        normal_force_n=10.0,
        shear_force_n=np.zeros(2),
    )
    wrench = wrench_of([HandContact.on_link(contact, "p", Mount(), trusted=True)], HAND, trusted=True)
    np.testing.assert_allclose(wrench.force_n, [0.0, 0.0, -10.0], atol=1e-15)
    np.testing.assert_allclose(wrench.torque_nm, [0.0, 1.0, 0.0], atol=1e-15)


def test_the_covariance_of_a_wrench_is_that_of_samples() -> None:
    rng = np.random.default_rng(11)
    contact = a_contact(rng)
    pose, turn, at_m = a_pose(rng)
    wrench = wrench_of([HandContact.on_link(contact, "p", Mount("l", pose), trusted=True)], "l", trusted=True)
    count = 40_000
    std_n = np.array([*contact.shear_force_std_n, contact.normal_force_std_n])
    force_n = turn.apply(pressed_n(contact) + std_n * rng.standard_normal((count, 3)))
    there = contact.centroid_m + contact.centroid_std_m * rng.standard_normal((count, 3))
    samples = np.hstack([force_n, np.cross(turn.apply(there) + at_m, force_n)])
    expected, std = np.cov(samples.T), samples.std(axis=0)
    np.testing.assert_allclose(
        wrench.covariance / np.outer(std, std), expected / np.outer(std, std), atol=0.03
    )
    np.testing.assert_allclose(wrench.force_std_n, std[:3], rtol=0.02)
    np.testing.assert_allclose(wrench.torque_std_nm, std[3:], rtol=0.02)


def joint(contacts: list[HandContact], rng: np.random.Generator) -> Float:
    """Covariance of the wrench of contacts whose errors are correlated at random."""
    roots = [
        np.linalg.cholesky(wrench_of([c], "l", trusted=True).covariance + 1e-18 * np.eye(6)) for c in contacts
    ]
    turns = [np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in contacts]  # each from the same 6 normals
    total = sum(root @ turn for root, turn in zip(roots, turns, strict=True))
    return total @ total.T


def test_the_covariance_on_one_patch_bounds_every_correlation() -> None:
    rng = np.random.default_rng(13)
    mount = Mount("l", a_pose(rng)[0])
    contacts = [HandContact.on_link(a_contact(rng), "p", mount, trusted=True) for _ in range(3)]
    bound = wrench_of(contacts, "l", trusted=True).covariance
    scale = np.sqrt(np.diag(bound))
    for _ in range(200):
        gap = (bound - joint(contacts, rng)) / np.outer(scale, scale)
        assert np.linalg.eigvalsh(gap).min() > -1e-6


def test_a_common_factor_of_all_forces_on_a_patch_is_not_averaged_away() -> None:
    """A stiffness that is 10 % off makes two equal forces 10 % off together, not 7 %."""
    contact = a_contact(
        np.random.default_rng(0),
        normal_force_n=2.0,
        normal_force_std_n=0.2,
        shear_force_n=np.zeros(2),
        shear_force_std_n=np.full(2, 1e-9),
    )
    there = HandContact.on_link(contact, "p", Mount("l"), trusted=True)
    assert wrench_of([there, there], "l", trusted=True).force_std_n[2] == pytest.approx(0.4)
    assert wrench_of([there], "l", trusted=True).force_std_n[2] == pytest.approx(0.2)


def test_no_contact_is_no_wrench() -> None:
    nothing = wrench_of([], "l", trusted=False)
    assert (nothing.contacts, nothing.trusted, nothing.force_calibrated) == (0, False, True)
    assert not nothing.force_n.any()
    assert not nothing.torque_nm.any()
    assert not nothing.covariance.any()


def test_one_uncalibrated_contact_makes_the_wrench_uncalibrated() -> None:
    rng = np.random.default_rng(1)
    known, unknown = (a_contact(rng, force_calibrated=calibrated) for calibrated in (True, False))
    pair = [HandContact.on_link(each, "p", Mount("l"), trusted=True) for each in (known, unknown)]
    assert not wrench_of(pair, "l", trusted=True).force_calibrated
    assert wrench_of(pair[:1], "l", trusted=True).force_calibrated


def the_contact(skin: Skin, press: Press) -> Contact:
    posterior = Posterior(skin.layout, relative_noise=1e-5, baseline_ohm=skin.rest_ohm, force_calibrated=True)
    rng = np.random.default_rng(3)
    for share in (0.5, 1.0):
        ohm = skin.resistance_ohm(skin.displacement_m((press,), share))
        field = posterior.update(ohm * (1 + 1e-5 * rng.standard_normal(ohm.shape)))
    return field.contacts[0]


def within(value: Float, std: Float, truth: Float, deviations: float = 5.0) -> bool:
    return bool((np.abs(value - truth) <= deviations * std).all())


def test_a_sphere_that_slides_over_a_turned_patch() -> None:
    """The closed-form load of the sphere, not the solver's, turned by SciPy."""
    skin = Skin(PatchLayout.preset("staggered"))
    press = Press((0.018, 0.016), 0.04, 4e-4, (0.4, -0.2))
    pose, turn, at_m = a_pose(np.random.default_rng(5))
    found = HandContact.on_link(the_contact(skin, press), "p", Mount("l", pose), trusted=True)
    force_n = turn.apply(press.force_n(1.0))
    centre_m = turn.apply([0.018, 0.016, skin.layout.height_m]) + at_m
    assert found.normal_force_n > 20 * found.normal_force_std_n
    assert within(found.force_n, found.force_std_n, force_n)
    assert np.abs(found.position_m - centre_m).max() < 0.5e-3
    torque_nm = np.cross(centre_m, force_n)
    assert within(
        wrench_of([found], "l", trusted=True).torque_nm,
        wrench_of([found], "l", trusted=True).torque_std_nm,
        torque_nm,
    )


@pytest.mark.long
def test_on_a_fingertip_the_force_follows_the_normal_at_the_contact() -> None:
    """Off the middle of a cylinder, where the normal is not the z axis of the patch."""
    radius_m = 20e-3
    skin = fingertip(radius_m)
    assert skin.points_m is not None
    across_m = float(skin.points_m[0, 2, 0])  # arc length of the third electrode along the wires
    press = Press((across_m, float(skin.points_m[4, 0, 1])), 0.02, 4e-4, (0.3, 0.0))
    assert skin.axes is not None
    axes = skin.axes[4, 2]
    assert math.degrees(math.acos(axes[2, 2])) > 10.0
    found = HandContact.on_link(the_contact(skin, press), "p", Mount(), trusted=True)
    force_n = np.array(press.force_n(1.0)) @ axes
    assert np.linalg.norm(found.normal - axes[2]) < 0.09  # 5 degrees
    off = np.linalg.norm(found.force_n - force_n) / np.linalg.norm(force_n)
    flat_off = np.linalg.norm(found.force_n - np.array(press.force_n(1.0))) / np.linalg.norm(force_n)
    assert off < 0.1 < flat_off
