"""One contact for each body, in every frame, with both methods: inside, on the edge, on the whole patch."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.truth import Press, Skin, random_press
from tests.lanes import some_long

from .loads import FAMILIES, Load, spheres

SIGMA = 1e-5
WHOLE = ("plate", "large area")
"""Bodies that may be larger than the patch; the force beyond the patch cannot be measured."""


@pytest.fixture(scope="module")
def staggered() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered")


def tracker_of(layout: sk.PatchLayout, method: str, **options: object) -> sk.Tracker:
    return sk.Tracker(layout, method=method, relative_noise=SIGMA, force_calibrated=True, **options)


def frames(layout: sk.PatchLayout, load: Load, rng: np.random.Generator, shares: list[float]):
    skin = Skin(layout)
    for share in shares:
        ohm = skin.resistance_ohm(share * load.moved_m)
        yield share, ohm * (1 + SIGMA * rng.standard_normal(ohm.shape))


def deviations(field: sk.FieldFrame, load: Load, share: float) -> list[float]:
    """Errors of force and centre in standard deviations; loads are linear in the displacement."""
    found = []
    for contact in field.contacts:
        away = [np.linalg.norm(contact.centroid_m[:2] - centre) for centre in load.centre_m]
        body = int(np.argmin(away))
        found.append((contact.normal_force_n - share * load.force_n[body]) / contact.normal_force_std_n)
        found += list((contact.centroid_m[:2] - load.centre_m[body]) / contact.centroid_std_m[:2])
    return [abs(float(each)) for each in found]


@pytest.mark.long
@pytest.mark.parametrize("method", ["exact", "posterior"])
@pytest.mark.parametrize("family", some_long(FAMILIES, "sphere", "two spheres"))
def test_each_body_is_one_contact_in_every_frame(staggered, family, method):
    """Three presses each, going down and held; force and centre within five deviations."""
    tracker = tracker_of(staggered, method)
    for seed in range(3):
        rng = np.random.default_rng([seed, 1])
        load = FAMILIES[family](staggered, rng)
        tracker.reset()
        for share, ohm in frames(staggered, load, rng, [0.4, 0.7, 1.0, 1.0]):
            field = tracker.update(ohm)
            assert field.trusted
            assert len(field.contacts) == load.bodies, (seed, share)
            if load.force_n and family not in WHOLE:
                assert max(deviations(field, load, share)) < 5, (seed, share)


@pytest.mark.release
@pytest.mark.parametrize("method", ["exact", "posterior"])
@pytest.mark.parametrize("family", FAMILIES)
def test_two_hundred_presses_of_each_family(staggered, family, method):
    """Right in 99 % of frames, hardly ever another number from frame to frame, deviations that hold."""
    tracker = tracker_of(staggered, method)
    right, changes, z = [], [], []
    for seed in range(200):
        rng = np.random.default_rng([seed, 2])
        load = FAMILIES[family](staggered, rng)
        tracker.reset()
        numbers = []
        for share, ohm in frames(staggered, load, rng, [0.4, 0.7, 1.0, 1.0]):
            field = tracker.update(ohm)
            numbers.append(len(field.contacts))
            if load.force_n and family not in WHOLE and numbers[-1] == load.bodies:
                z += deviations(field, load, share)
        right += [number == load.bodies for number in numbers]
        changes += list(np.diff(numbers) != 0)
    print(f"{method} {family}: right {np.mean(right):.4f}, changes {np.mean(changes):.4f}, beyond 5", end=" ")
    print(f"{int((np.array(z) > 5).sum())} of {len(z)}, largest {max(z, default=0.0):.1f}")
    assert np.mean(right) >= 0.99
    assert np.mean(changes) <= 0.005
    assert (np.array(z) > 5).sum() <= 1e-3 * len(z)


@pytest.mark.long
def test_exact_fields_have_hertzs_force_shear_and_centre(staggered):
    """40 spheres anywhere; RMS of (found − true)/deviation at most 1.2, none beyond 5."""
    rng = np.random.default_rng(4)
    tracker, z, off = tracker_of(staggered, "exact"), [], []
    for _ in range(40):
        press = random_press(rng, staggered, rng.uniform(0.1, 0.35), radius=(2.0, 4.0), shear=0.4)
        load = spheres(staggered, press)
        tracker.reset()
        for _, ohm in frames(staggered, load, rng, [0.5, 1.0]):
            field = tracker.update(ohm)
        (contact,) = field.contacts
        force, normal = press.force_n(1.0), contact.normal_force_n
        z.append([
            (normal + force[2]) / contact.normal_force_std_n,
            *((contact.shear_force_n - force[:2]) / contact.shear_force_std_n),
            *((contact.centroid_m[:2] - press.center_m) / contact.centroid_std_m[:2]),
        ])  # fmt: skip
        off.append(normal / -force[2] - 1)
        assert contact.force_calibrated
    assert (np.sqrt(np.mean(np.square(z), axis=0)) < 1.2).all()
    assert np.abs(z).max() < 5
    assert np.sqrt(np.mean(np.square(off))) < 0.15


@pytest.mark.long
def test_exact_fields_at_rest_have_no_contacts_and_no_forces(staggered):
    rng = np.random.default_rng(5)
    rest = Skin(staggered).rest_ohm
    for hold in (True, False):
        tracker = tracker_of(staggered, "exact", hold=hold)
        for _ in range(150):
            field = tracker.update(rest * (1 + SIGMA * rng.standard_normal(rest.shape)))
            assert field.contacts == ()
            assert np.abs(field.force_n).max() < 0.05


def test_contacts_of_exact_fields_appear_stay_while_held_and_go(staggered):
    rng = np.random.default_rng(6)
    tracker, load = tracker_of(staggered, "exact"), spheres(staggered, Press((0.018, 0.0165), 0.012, 5e-4))
    numbers = []
    for share, ohm in frames(staggered, load, rng, [0, 0.02, 0.5, 1, 1, 1, 1, 0.3, 0, 0]):
        field = tracker.update(ohm)
        numbers.append(len(field.contacts))
        if share == 1:
            assert field.contacts[0].normal_force_n == pytest.approx(load.force_n[0], rel=0.1)
    assert numbers == [0, 1, 1, 1, 1, 1, 1, 1, 0, 0]
    assert np.abs(field.force_n).max() < 0.05


@pytest.mark.parametrize("lost", [[4], [0], [3, 4]])
def test_wires_without_a_position_do_not_spoil_the_contact(staggered, lost):
    """Fields of the exact tracker, with wires that have no position: the neighbours tell the force."""
    rng = np.random.default_rng(7)
    load = spheres(staggered, Press((0.0190, 0.0175), 0.016, 6e-4))
    tracker = tracker_of(staggered, "exact")
    finder = sk.Tracker(staggered, method="exact", relative_noise=SIGMA, force_calibrated=True)._contacts
    assert finder is not None
    for _, ohm in frames(staggered, load, rng, [0.5, 1.0]):
        field = tracker.update(ohm)
        moved, std = field.displacement_m.copy(), field.displacement_std_m.copy()
        moved[lost], std[lost] = 0.0, np.inf
        without = finder.add(dataclasses.replace(field, displacement_m=moved, displacement_std_m=std))
    (contact,), (whole,) = without.contacts, field.contacts
    assert abs(contact.normal_force_n - load.force_n[0]) < 5 * contact.normal_force_std_n
    assert contact.normal_force_n == pytest.approx(load.force_n[0], rel=0.3)
    assert (np.abs(contact.centroid_m - whole.centroid_m)[:2] < 5 * contact.centroid_std_m[:2]).all()
    assert contact.normal_force_std_n >= 0.99 * whole.normal_force_std_n
    nothing = finder.add(dataclasses.replace(field, displacement_std_m=np.full_like(std, np.inf)))
    assert nothing.contacts == ()


def test_a_stiffness_gives_the_forces_of_the_papers_law_and_contacts_can_be_switched_off(staggered):
    rng = np.random.default_rng(8)
    load = spheres(staggered, Press((0.018, 0.0165), 0.012, 5e-4))
    law = sk.Tracker(staggered, method="exact", relative_noise=SIGMA, stiffness_n_per_m=250.0)
    off = sk.Tracker(staggered, method="exact", relative_noise=SIGMA, contacts=False)
    for _, ohm in frames(staggered, load, rng, [0.5, 1.0]):
        field, bare = law.update(ohm), off.update(ohm)
    np.testing.assert_allclose(field.force_n, 250.0 * field.displacement_m)
    assert len(field.contacts) == 1
    assert (bare.force_n, bare.contacts) == (None, ())
    np.testing.assert_array_equal(bare.displacement_m, field.displacement_m)
