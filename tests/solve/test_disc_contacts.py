"""Contacts and changing touches with the prior ``discs``, the default from a noise of 1e-4 on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import skinnode as sk
from tests.lanes import some_long

from .press import frame_ohm, hertz_press

PITCH_M = 4e-3
BODIES = (
    ((5.0, 4.6), (2.1, 7.0)),
    ((2.8, 2.1), (2.5, 5.2)),
    ((6.5, 4.2), (3.4, 4.7)),
    ((2.3, 3.4), (4.2, 6.3)),
)
"""Centres of two bodies, in pitches: 3.1 to 3.8 pitches apart."""


def press(layout: sk.PatchLayout, centre: tuple[float, float], depth: float) -> np.ndarray:
    x, y = PITCH_M * np.array(centre)
    return hertz_press(layout, depth, centre_m=(x, y), shear=0.0)


def noisy_ohm(
    layout: sk.PatchLayout, moved: np.ndarray, noise: float, rng: np.random.Generator
) -> np.ndarray:
    exact = frame_ohm(layout, moved)
    return exact * (1.0 + noise * rng.standard_normal(exact.shape))


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
@pytest.mark.parametrize("pair", some_long(range(len(BODIES)), 0, 1))
def test_two_bodies_close_to_each_other_are_two_contacts(
    staggered: sk.PatchLayout, pair: int, noise: float
) -> None:
    """The sums of the loads over 3 x 3 cells have a single peak; the evidence for two discs is clear."""
    centres = BODIES[pair]
    moved = press(staggered, centres[0], 0.2) + press(staggered, centres[1], 0.2)
    rng = np.random.default_rng(1)
    field = sk.Posterior(staggered, relative_noise=noise).update(noisy_ohm(staggered, moved, noise, rng))
    found = sorted(tuple(contact.centroid_m[:2] / PITCH_M) for contact in field.contacts)
    assert len(found) == 2
    np.testing.assert_allclose(found, sorted(centres), atol=0.6)


def test_a_light_body_is_a_contact(staggered: sk.PatchLayout) -> None:
    """At a noise of 1e-3, the loads of this press are within 5 standard deviations; its evidence is clear."""
    moved, found = press(staggered, (4.3, 5.2), 0.15), 0
    for seed in range(6):
        rng = np.random.default_rng([2, seed])
        posterior = sk.Posterior(staggered, relative_noise=1e-3)
        found += len(posterior.update(noisy_ohm(staggered, moved, 1e-3, rng)).contacts) == 1
    assert found == 6


def test_a_tilted_plate_over_the_whole_patch_is_one_contact(staggered: sk.PatchLayout) -> None:
    """Discs beyond two opposite corners explain such a plate, but the skin does not rise between them."""
    offset = staggered.upper_m[..., :2] - staggered.upper_m[..., :2].mean(axis=(0, 1))
    depth_m = 3e-4 * (1.0 + offset @ [-0.85, -0.25])
    moved = depth_m[..., None] * np.array([0.057, -0.109, -1.0])
    for seed in range(3):
        rng, tracker = np.random.default_rng([3, seed]), sk.Tracker(staggered, relative_noise=1e-4)
        for share in (0.0, 0.0, 0.1, 0.3, 0.6, 0.9, *np.ones(6)):
            field = tracker.update(noisy_ohm(staggered, share * moved, 1e-4, rng))
            if share > 0.5:
                assert len(field.contacts) == 1


def test_discs_are_fitted_again_when_a_light_body_touches_elsewhere(staggered: sk.PatchLayout) -> None:
    """Without a rest between them: the second press moves no coordinate by more than its uncertainty.

    The depth is 200 µm. With the discs of the other press, the error is 175 µm; from rest, 19 to 71 µm.
    """
    posterior = sk.Posterior(staggered, relative_noise=1e-3, past="off")
    rng, places, errors_m = np.random.default_rng(5), ((0.3, 0.2), (5.0, 6.0)), []
    for number in range(12):
        moved = press(staggered, places[number % 2], 0.1)
        field = posterior.update(noisy_ohm(staggered, moved, 1e-3, rng))
        errors_m.append(np.abs(field.displacement_m - moved).max())
    assert np.median(errors_m[1::2]) < 100e-6


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_skin_that_is_pulled_beside_a_press_is_no_contact(staggered: sk.PatchLayout, noise: float) -> None:
    """The loads under the second group of discs do not press."""
    moved = press(staggered, (2.5, 2.5), 0.2) - press(staggered, (6.5, 6.0), 0.15)
    rng = np.random.default_rng(6)
    field = sk.Posterior(staggered, relative_noise=noise).update(noisy_ohm(staggered, moved, noise, rng))
    (contact,) = field.contacts
    np.testing.assert_allclose(contact.centroid_m[:2] / PITCH_M, (2.5, 2.5), atol=0.6)


def test_groups_of_discs_whose_loads_only_pull_are_no_contacts(staggered: sk.PatchLayout) -> None:
    """Their evidence is clear, but no cell around them presses."""
    posterior = sk.Posterior(staggered, relative_noise=1e-3)
    posterior.update(frame_ohm(staggered, press(staggered, (4.0, 4.0), 0.2)))
    finder, loads = posterior._contacts, posterior._hyper.loads.estimate()
    mean = np.zeros_like(loads.mean)
    groups = np.zeros(len(mean), np.int64)
    moved = np.full(staggered.upper_m.shape, -1e-6)
    own = finder._own.reshape(moved.shape[:2])
    for number, place in ((1, (2, 2)), (2, (7, 7))):
        groups[own[place]], mean[own[place], 2], moved[place] = number, 1e-3, -1e-4
    mean[own[4, 5], 2] = -1e-9
    _, contacts = finder.find(
        dataclasses.replace(loads, mean=mean),
        moved,
        np.ones_like(moved),
        groups,
        np.array([50.0, 50.0, 50.0]),
    )
    assert contacts == ()
