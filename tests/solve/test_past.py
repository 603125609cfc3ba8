"""Earlier frames: less noise while the skin rests or moves slowly, and no lag when it jumps.

Truths are spheres on rubber in closed form, and independent noise, whose mean over n frames has the variance
1/n.
"""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve.posterior.observation import Readings
from skinnode.solve.posterior.past.frame_filter import FrameFilter
from skinnode.solve.posterior.past.load_modes import LoadModes

from .press import frame_ohm, hertz_press

SIGMA = 1e-3
HELD = 24


@pytest.fixture(scope="module")
def small() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=5, upper_electrodes=5, lower_electrodes=6)


@pytest.fixture(scope="module")
def pressed(small: sk.PatchLayout) -> np.ndarray:
    return hertz_press(small, 0.2, centre_m=(8e-3, 8e-3))


def noisy(ohm: np.ndarray, rng: np.random.Generator, sigma: float = SIGMA) -> np.ndarray:
    return ohm * (1.0 + sigma * rng.standard_normal(ohm.shape))


def posterior(layout: sk.PatchLayout, past: str = "auto", **options) -> sk.Posterior:
    options = {"relative_noise": SIGMA, "follow_noise": False} | options
    return sk.Posterior(layout, past=past, **options)


def readings(y: np.ndarray, usable: np.ndarray | None = None) -> Readings:
    """The frame whose changes ln(R₀/R) are y, in units of the noise, for a patch with R₀ = 1."""
    every = np.ones(y.shape, bool) if usable is None else usable
    return Readings(np.exp(-SIGMA * y), np.full(y.shape, SIGMA), every)


def changes(found: Readings) -> np.ndarray:
    return -np.log(found.a) / SIGMA


def load_change(layout: sk.PatchLayout, norm: float) -> np.ndarray:
    """A change in the readings that loads cause, with the given norm in units of the noise."""
    return norm * LoadModes.of(layout).modes[-1].reshape(layout.shape)


# -- the filter ---------------------------------------------------------------------------------------------


def test_the_noise_of_readings_at_rest_falls_and_is_not_understated(small):
    rng, square, claimed = np.random.default_rng(1), [], []
    for _ in range(40):
        past = FrameFilter(small, np.ones(small.shape))
        for _ in range(HELD):
            past.next_frame()
            found = past.filtered(readings(rng.standard_normal(small.shape)))
        square.append(np.mean(changes(found) ** 2))
        claimed.append(np.mean((found.noise / SIGMA) ** 2))
    assert np.mean(square) < 2.0 / HELD
    assert np.mean(square) < np.mean(claimed) < 6.0 / HELD


def test_a_jump_of_the_loads_is_returned_as_it_is_in_the_same_frame(small):
    rng = np.random.default_rng(2)
    past = FrameFilter(small, np.ones(small.shape))
    for _ in range(HELD):
        past.next_frame()
        past.filtered(readings(rng.standard_normal(small.shape)))
    y = load_change(small, 15.0) + rng.standard_normal(small.shape)
    past.next_frame()
    found = past.filtered(readings(y))
    np.testing.assert_allclose(changes(found), y, atol=1e-9)
    np.testing.assert_array_equal(found.noise, SIGMA)


def test_a_slow_change_of_the_loads_lags_by_no_more_than_the_noise_of_a_frame_hides(small):
    """Half a standard deviation per frame: after 23 frames, the last value before it is 11 away."""
    rng, way = np.random.default_rng(3), LoadModes.of(small).modes[-1]
    lags = []
    for _ in range(20):
        past = FrameFilter(small, np.ones(small.shape))
        for frame in range(2 * HELD):
            true = load_change(small, 0.5 * max(frame - HELD, 0))
            past.next_frame()
            found = past.filtered(readings(true + rng.standard_normal(small.shape)))
            if frame > HELD:
                lags.append(float(way @ (changes(found) - true).ravel()))
    assert np.sqrt(np.mean(np.square(lags))) < 1.5
    assert np.abs(lags).max() < 4.0


def test_a_frame_repeated_without_wrong_readings_leaves_no_trace_of_them(small):
    """The data check solves a frame again without the readings that it finds to be wrong."""
    rng = np.random.default_rng(6)
    faulty, sound = (FrameFilter(small, np.ones(small.shape)) for _ in range(2))
    without = np.zeros(small.shape, bool)
    without[2, 4] = True
    for frame in range(HELD):
        y = rng.standard_normal(small.shape)
        found = []
        for past in (faulty, sound):
            past.next_frame()
            wrong = y.copy()
            if frame == HELD - 4:
                wrong[2, 4] += 300.0
                if past is faulty:
                    assert changes(past.filtered(readings(wrong)))[2, 4] > 250.0
                found.append(past.filtered(readings(wrong).except_for(without)))
            else:
                found.append(past.filtered(readings(y)))
        np.testing.assert_array_equal(found[0].a, found[1].a)
        np.testing.assert_array_equal(found[0].noise, found[1].noise)
    assert found[0].noise.mean() < 0.6 * SIGMA


def test_a_repeated_frame_of_a_frozen_converter_does_not_reduce_the_noise(small):
    y = np.random.default_rng(4).standard_normal(small.shape)
    past = FrameFilter(small, np.ones(small.shape))
    for _ in range(HELD):
        past.next_frame()
        found = past.filtered(readings(y))
    np.testing.assert_array_equal(found.noise, SIGMA)
    np.testing.assert_allclose(changes(found), y, atol=1e-9)


def test_a_reading_that_returns_is_taken_from_its_own_frames(small):
    rng = np.random.default_rng(5)
    past, usable = FrameFilter(small, np.ones(small.shape)), np.ones(small.shape, bool)
    level = np.zeros(small.shape)
    for frame in range(3 * HELD):
        usable[1] = not HELD <= frame < 2 * HELD
        if frame == 2 * HELD:
            level[1, 3] = 4.0  # while it was missing, the reading changed in a way that no load explains
        past.next_frame()
        y = level + rng.standard_normal(small.shape)
        found = past.filtered(readings(y, usable.copy()))
        np.testing.assert_array_equal(found.usable, usable)
        if frame == 2 * HELD:
            np.testing.assert_allclose(changes(found)[1], y[1], atol=1e-9)
            np.testing.assert_array_equal(found.noise[1], SIGMA)
    assert abs(changes(found)[1, 3] - 4.0) < 1.5
    assert found.noise[0].max() < 0.6 * SIGMA


# -- the posterior ------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_held_press_gains_and_a_sudden_release_does_not_lag(small, pressed):
    rest, held = frame_ohm(small, np.zeros_like(pressed)), frame_ohm(small, pressed)
    own, without, inside, count = [], [], 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        auto, off = posterior(small), posterior(small, "off")
        for _ in range(HELD):
            frame = noisy(held, rng)
            field, single = auto.update(frame), off.update(frame)
        own.append(np.linalg.norm(field.displacement_m - pressed))
        without.append(np.linalg.norm(single.displacement_m - pressed))
        inside += np.count_nonzero(np.abs(field.displacement_m - pressed) <= field.half_width_95_m)
        count += pressed.size
        frame = noisy(rest, rng)
        field, alone = auto.update(frame), posterior(small, "off").update(frame)
        assert (np.abs(field.displacement_m) <= 5.0 * field.displacement_std_m).all()
        assert field.displacement_std_m.mean() > 0.7 * alone.displacement_std_m.mean()
        assert np.abs(field.displacement_m).max() < 0.3 * np.abs(pressed).max()
    assert np.mean(own) < 0.75 * np.mean(without)
    assert inside > 0.9 * count


def test_a_wrong_reading_is_named_and_does_not_spoil_the_fields(small, pressed):
    held, rng = frame_ohm(small, pressed), np.random.default_rng(7)
    tracker = posterior(small)
    for number in range(HELD):
        frame = noisy(held, rng)
        if number == HELD - 4:
            frame[2, 4] *= 1.3
        field = tracker.update(frame)
        if number == HELD - 4:
            assert {fault.upper for fault in field.faults} == {2}
        if number >= HELD - 4:
            assert (np.abs(field.displacement_m - pressed) <= 5.0 * field.displacement_std_m).all()


def test_little_noise_is_solved_frame_by_frame(small, pressed):
    held, rng = frame_ohm(small, pressed), np.random.default_rng(8)
    auto, off = (posterior(small, past, relative_noise=1e-5) for past in ("auto", "off"))
    for _ in range(5):
        frame = noisy(held, rng, 1e-5)
        one, two = auto.update(frame), off.update(frame)
        np.testing.assert_array_equal(one.displacement_m, two.displacement_m)
        np.testing.assert_array_equal(one.displacement_std_m, two.displacement_std_m)


def test_frames_before_a_gap_or_a_reset_are_not_used(small, pressed):
    held, rng = frame_ohm(small, pressed), np.random.default_rng(9)
    tracker = sk.Tracker(
        small, method="posterior", relative_noise=SIGMA, follow_noise=False, detect=False, past="auto"
    )
    stds, period_ns = [], 80_000_000
    for number in range(HELD + 1):
        tracker.t_ns = number * period_ns + (10**10 if number == HELD else 0)
        stds.append(tracker.update(noisy(held, rng)).displacement_std_m.mean())
    assert stds[HELD - 1] < 0.7 * stds[0]
    assert stds[HELD] > 0.8 * stds[0]
    for _ in range(HELD):
        tracker.t_ns += period_ns
        last = tracker.update(noisy(held, rng)).displacement_std_m.mean()
    tracker.reset()
    assert tracker.update(noisy(held, rng)).displacement_std_m.mean() > last / 0.7
