"""The scene: what its settings promise, asked of the contacts and of the electrodes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from skinnode.config import SimulationConfig
from skinnode.model.layout import PatchLayout
from tests.lanes import some_long
from vcan_sim.default_scene import LEAD_S, Scene

LAYOUT = PatchLayout.preset("staggered", height_m=2e-3)
OPTIONS = SimulationConfig(seed=3, depth=0.15, shear_ratio=0.3, slide_speed_m_per_s=0.008, cycle_s=4.0)


def scene(number: int = 0, options: SimulationConfig = OPTIONS) -> Scene:
    return Scene(LAYOUT, options, number)


def test_rests_before_the_first_touch_and_between_strokes() -> None:
    play = scene()
    for t in (-1.0, 0.0, LEAD_S - 1e-6, play.lead_s + 0.95 * OPTIONS.cycle_s):
        assert play.contacts(t) == ()
        np.testing.assert_array_equal(play.upper_m(t), LAYOUT.upper_m)
    assert play.contacts(play.lead_s + 0.5 * OPTIONS.cycle_s)


def test_a_depth_of_nothing_is_a_hand_at_rest() -> None:
    play = scene(options=OPTIONS.model_copy(update={"depth": 0.0}))
    for t in play.lead_s + np.linspace(0.0, 2 * OPTIONS.cycle_s, 50):
        np.testing.assert_array_equal(play.upper_m(t), LAYOUT.upper_m)


@pytest.mark.long
@pytest.mark.parametrize("number", some_long(range(4), 0))
def test_a_stroke_presses_slides_and_lifts_as_configured(number: int) -> None:
    play = scene(number)
    times = play.lead_s + np.linspace(0, 3 * OPTIONS.cycle_s, 1500)
    touching = [(t, *play.contacts(t)) for t in times if play.contacts(t)]
    depth = np.array([contact.indentation_m for _, contact in touching])
    assert depth.max() == pytest.approx(0.15 * 2e-3, rel=1e-12)
    shear = np.array([math.hypot(*contact.traction_ratio) for _, contact in touching])
    assert shear.max() == pytest.approx(0.3, rel=1e-12)
    assert shear[0] == 0.0  # pressed before it is dragged
    speeds = []
    for (t0, before), (t1, after) in itertools.pairwise(touching):
        if t1 - t0 < 0.02:  # not across a rest, where the next stroke starts elsewhere
            moved = np.subtract(after.center_m, before.center_m)
            speeds.append(np.linalg.norm(moved) / (t1 - t0))
            along = float(moved @ after.traction_ratio)  # the rubber is dragged the way the sphere goes
            assert along == pytest.approx(
                np.linalg.norm(moved) * math.hypot(*after.traction_ratio), abs=1e-12
            )
    assert max(speeds) == pytest.approx(0.008, rel=1e-6)


def test_the_sphere_stays_a_pitch_inside_the_patch() -> None:
    low, high = LAYOUT.upper_m[..., :2].min(axis=(0, 1)), LAYOUT.upper_m[..., :2].max(axis=(0, 1))
    for seed in range(40):
        stroke = scene(1, OPTIONS.model_copy(update={"seed": seed})).stroke(seed % 5)
        start = np.array(stroke.start_m)
        for point in (start, start + stroke.slide_m * np.array(stroke.heading)):
            assert (point >= low + 4e-3 - 1e-12).all()
            assert (point <= high - 4e-3 + 1e-12).all()
        assert stroke.slide_m > 8e-3  # two pitches and more at this speed: far enough to see it slide


@pytest.mark.parametrize("cycles", [1, pytest.param(2, marks=pytest.mark.long)])
def test_motion_is_smooth_enough_to_follow(cycles: int) -> None:
    """Between two instants a millisecond apart no electrode jumps: at most 2 mm/s at this depth and speed."""
    play = scene(2)
    times = np.arange(0.0, cycles * OPTIONS.cycle_s, 1e-3) + play.lead_s
    path = np.array([play.upper_m(t) for t in times])
    assert np.abs(np.diff(path, axis=0)).max() < 2e-6


def test_electrodes_move_as_the_contact_says_and_lean_along_the_slide() -> None:
    play = scene()
    t = play.lead_s + 0.6 * OPTIONS.cycle_s
    (contact,) = play.contacts(t)
    moved = play.upper_m(t) - LAYOUT.upper_m
    flat = LAYOUT.upper_m[..., :2].reshape(-1, 2)
    np.testing.assert_allclose(moved.reshape(-1, 3), contact.displacement_m(flat), atol=1e-17)
    nearest = np.argmin(np.linalg.norm(flat - contact.center_m, axis=1))
    deepest = moved.reshape(-1, 3)[nearest]
    assert deepest[2] < -0.3 * contact.indentation_m
    assert deepest[:2] @ np.array(contact.traction_ratio) > 0


def test_same_seed_same_scene_and_every_patch_its_own() -> None:
    t = LEAD_S + 0.7 * OPTIONS.cycle_s
    again, other_seed = scene(), scene(options=OPTIONS.model_copy(update={"seed": 4}))
    np.testing.assert_array_equal(scene().upper_m(t), again.upper_m(t))
    assert scene().contacts(t)[0].center_m != other_seed.contacts(t)[0].center_m
    leads = [scene(number).lead_s for number in range(8)]
    assert leads[0] == LEAD_S
    assert np.diff(sorted(leads)).min() > 0.02
    assert max(leads) <= LEAD_S + 0.25 * OPTIONS.cycle_s
    centers = {scene(number).stroke(0).start_m for number in range(8)}
    assert len(centers) == 8


@pytest.mark.parametrize(("wires", "electrodes"), [(1, 1), (1, 10), (10, 1), (2, 2)])
def test_a_patch_too_small_to_slide_on_is_still_pressed(wires: int, electrodes: int) -> None:
    layout = PatchLayout.preset("aligned", upper_wires=wires, upper_electrodes=electrodes)
    play = Scene(layout, OPTIONS)
    moved = play.upper_m(play.lead_s + 0.5 * OPTIONS.cycle_s) - layout.upper_m
    assert moved[..., 2].min() < -1e-5
    low, high = layout.upper_m[..., :2].min(axis=(0, 1)), layout.upper_m[..., :2].max(axis=(0, 1))
    for stroke in map(play.stroke, range(5)):
        end = np.array(stroke.start_m) + stroke.slide_m * np.array(stroke.heading)
        assert (np.minimum(stroke.start_m, end) >= low - 1e-12).all()
        assert (np.maximum(stroke.start_m, end) <= high + 1e-12).all()


def test_a_slide_as_long_as_the_patch_has_room_for() -> None:
    """Of a slow cycle: where it may begin is one place, of which rounding must not make none."""
    slow = OPTIONS.model_copy(update={"cycle_s": 20.0})
    layout = PatchLayout.preset("staggered")
    low, high = layout.upper_m[..., :2].min(axis=(0, 1)), layout.upper_m[..., :2].max(axis=(0, 1))
    for seed in range(100):
        stroke = Scene(layout, slow.model_copy(update={"seed": seed})).stroke(0)
        end = np.array(stroke.start_m) + stroke.slide_m * np.array(stroke.heading)
        assert (np.minimum(stroke.start_m, end) >= low).all()
        assert (np.maximum(stroke.start_m, end) <= high).all()
