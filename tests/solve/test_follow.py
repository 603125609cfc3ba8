"""Wires that are followed with the inverse of an earlier frame, or held where they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

import skinnode as sk
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.wires.hold import chi2_quantile

from .press import frame_ohm, hertz_press, noisy, quantised, relative_slopes


@pytest.mark.parametrize("probability", [0.95, 0.99, 1 - 1e-4, 1 - 1e-9])
def test_quantiles_of_chi_squared(probability):
    for dof in (2, 3, 9, 20, 30, 60, 200):
        ratio = chi2_quantile(dof, norm.ppf(probability)) / chi2.ppf(probability, dof)
        assert 0.99 < ratio < (1.05 if dof >= 9 else 1.2)


class TestFollow:
    """A wire that moved a little is solved with the inverse of an earlier frame."""

    @pytest.mark.long
    def test_position_and_deviation_are_those_of_an_inverse_made_there(self, staggered):
        """The truth is NumPy's: the position that made the frame, and the inverse of J there."""
        tracker = ExactTracker(staggered, relative_noise=1e-5, hold=False)
        jacobians, ratios = 0, []
        for depth in np.linspace(0.0, 0.3, 60):
            moved = hertz_press(staggered, depth)
            field = tracker.update(frame_ohm(staggered, moved))
            assert field.trusted
            assert np.abs(field.displacement_m - moved).max() < 5e-11  # 1e-9 of the largest coordinate
            std = 1e-5 * np.sqrt((np.linalg.inv(relative_slopes(staggered, moved)) ** 2).sum(axis=2))
            ratios.append(field.displacement_std_m / std.reshape(moved.shape))
            jacobians += field.stats.jacobians
            assert field.stats.evaluations >= field.stats.jacobians
        assert jacobians < 60 * 10 / 2  # less than one for two solves
        np.testing.assert_allclose(ratios, 1.0, atol=0.04)
        assert abs(np.mean(ratios) - 1.0) < 2e-3

    def test_a_jump_is_solved_anew(self, staggered):
        tracker = ExactTracker(staggered, hold=False)
        tracker.update(frame_ohm(staggered, np.zeros_like(staggered.upper_m)))
        field = tracker.update(frame_ohm(staggered, hertz_press(staggered, 0.3)))
        assert field.trusted
        assert field.stats.jacobians >= 10

    def test_cost_is_that_of_simplified_newton_steps(self):
        """A NumPy copy of the method with the inverse at rest, which four wires keep for four frames.

        Every step but the last correction leads to a point where F is evaluated again.
        """
        layout = sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)
        tracker = ExactTracker(layout, hold=False)
        at = np.zeros_like(layout.upper_m)
        before = frame_ohm(layout, at)
        inverse = np.linalg.inv(relative_slopes(layout, at))

        def step(ratio):
            return -np.einsum("ujk,uk->uj", inverse, ratio - 1.0).reshape(at.shape)

        for number in range(1, 6):
            frame = frame_ohm(layout, hertz_press(layout, 0.003 * number, centre_m=(6e-3, 6e-3)))
            field = tracker.update(frame)
            assert field.trusted
            assert field.stats.steps == field.stats.evaluations - 4
            if number == 5:
                break
            assert field.stats.jacobians == 0
            at, before, expected = at + step(frame / before), frame, 0
            todo = np.ones(4, bool)
            while todo.any():
                expected += np.count_nonzero(todo)
                ratio = frame / frame_ohm(layout, at)
                correction = np.where(todo[:, None, None], step(ratio), 0.0)
                at = at + correction
                size = np.abs(correction).max(axis=(1, 2)) / layout.pitch_m
                top = np.abs((layout.upper_m + at) / layout.pitch_m).max(axis=(1, 2))
                todo &= (size > 1e-9 * np.maximum(1.0, top)) | (np.abs(ratio - 1.0).max(axis=1) > 1e-9)
            assert field.stats.evaluations == expected > 4
        assert field.stats.jacobians > 0

    @pytest.mark.parametrize("depth", [0.01, 0.03, 0.1])
    def test_steps_are_counted_whatever_inverse_they_were_taken_with(self, depth):
        """Wires followed to the end, with a new inverse at the root, and with Newton's steps after four
        simplified ones: all evaluate F once at the start and once after each step."""
        layout = sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)
        moved = hertz_press(layout, depth, centre_m=(6e-3, 6e-3))
        stats = ExactTracker(layout, hold=False).update(frame_ohm(layout, moved)).stats
        assert stats.steps == stats.evaluations - 4
        assert (stats.jacobians > 0) == (depth > 0.02)

    def test_every_wire_has_a_new_inverse_after_eight_frames(self, staggered):
        tracker, counts = ExactTracker(staggered, hold=False), []
        for n in range(1, 17):
            frame = frame_ohm(staggered, hertz_press(staggered, 0.1 + 1e-5 * n))
            counts.append(tracker.update(frame).stats.jacobians)
        assert sum(counts[-8:]) == 10  # a wire each, in its turn
        assert max(counts[-8:]) <= 2


class TestHold:
    @pytest.mark.long
    @pytest.mark.parametrize("depth", [0.0, 0.1])
    def test_an_unmoved_skin_is_held(self, staggered, depth):
        moved, rng = hertz_press(staggered, depth), np.random.default_rng(4)
        tracker = ExactTracker(staggered)
        before = tracker.update(noisy(staggered, moved, rng))
        z, shares = [], []
        for _ in range(200):
            frame = noisy(staggered, moved, rng)
            field = tracker.update(frame)
            assert field.trusted
            shares.append(field.held.mean())
            np.testing.assert_array_equal(field.displacement_m[field.held], before.displacement_m[field.held])
            position = frame_ohm(staggered, field.displacement_m)
            off = np.sqrt(np.mean((frame / position - 1) ** 2, axis=1))[field.held]
            np.testing.assert_allclose(field.residual[field.held], off, rtol=1e-4)
            assert (field.stats.evaluations == 0) == field.held.all()
            z.append((field.displacement_m - moved) / field.displacement_std_m)
            before = field
        assert np.mean(shares) > 0.95
        assert np.mean(np.abs(z) < 1.96) > 0.93

    @pytest.mark.parametrize("frames", [60, 300])
    def test_a_slow_press_stays_within_the_deviation(self, staggered, frames):
        tracker, rng = ExactTracker(staggered), np.random.default_rng(6)
        z, shares = [], []
        for n in range(frames):
            moved = hertz_press(staggered, 0.05 + 0.05 * n / frames)
            field = tracker.update(noisy(staggered, moved, rng))
            shares.append(field.held.mean())
            z.append((field.displacement_m - moved) / field.displacement_std_m)
        assert np.mean(shares) > 0.5
        assert np.mean(np.abs(z) < 1.96) > 0.93

    def test_so_does_a_move_along_what_a_wire_knows_least(self, staggered):
        """40 deviations in 200 frames along the last singular vector, where χ² sees a move last."""
        slopes = relative_slopes(staggered, np.zeros_like(staggered.upper_m))
        _, singular, right = np.linalg.svd(slopes)
        way = right[:, -1] * (1e-5 / singular[:, -1:])
        tracker, rng = ExactTracker(staggered), np.random.default_rng(8)
        inside, shares = [], []
        for n in range(200):
            moved = (way * 0.2 * n).reshape(staggered.upper_m.shape)
            field = tracker.update(noisy(staggered, moved, rng))
            shares.append(field.held.mean())
            inside.append(np.abs(field.displacement_m - moved) < 1.96 * field.displacement_std_m)
        assert np.mean(shares) > 0.8
        assert np.mean(inside) > 0.93
        assert np.mean(inside, axis=(0, 2, 3)).min() > 0.88

    @pytest.mark.long
    def test_press_and_release_ends_at_zero_within_noise(self, staggered, stream):
        tracker, rng = ExactTracker(staggered), np.random.default_rng(10)
        ends = []
        for _ in range(6):
            for moved, _ in stream:
                field = tracker.update(noisy(staggered, moved, rng))
            ends.append(field.displacement_m / field.displacement_std_m)
        assert np.abs(ends).max() < 5.5
        assert np.mean(np.abs(ends) < 1.96) > 0.9

    def test_codes_that_repeat_are_held_without_residual(self, staggered, stream, rest):
        tracker = ExactTracker(staggered)
        frame = quantised(stream[12][1], rest)
        solved, again = tracker.update(frame), tracker.update(frame)
        assert not solved.held.all()
        assert again.held.all()
        assert again.stats.evaluations == 0
        assert again.residual.max() < 1e-9
        np.testing.assert_array_equal(again.displacement_m, solved.displacement_m)
        still = ~solved.held
        np.testing.assert_allclose(
            again.displacement_std_m[still], solved.displacement_std_m[still], rtol=1e-3
        )

    def test_a_noisier_frame_says_less_and_a_better_one_is_solved(self, staggered, stream):
        tracker = ExactTracker(staggered, hold=True)
        frame = stream[12][1]
        sure = tracker.update(frame, relative_noise=1e-5)
        unsure = tracker.update(frame, relative_noise=1e-3)
        assert unsure.held.all()
        np.testing.assert_allclose(unsure.displacement_std_m, 100 * sure.displacement_std_m, rtol=1e-3)
        better = tracker.update(frame, relative_noise=1e-7)
        assert not better.held.any()
        np.testing.assert_allclose(better.displacement_std_m, 1e-2 * sure.displacement_std_m, rtol=3e-2)

    def test_tall_patches_hold_and_lost_equations_are_noticed(self):
        layout = sk.PatchLayout.preset(
            "staggered", upper_wires=3, upper_electrodes=3, lower_wires=18, lower_electrodes=4
        )
        tracker, rng = ExactTracker(layout), np.random.default_rng(12)
        moved = hertz_press(layout, 0.1, centre_m=(4e-3, 4e-3))
        shares, z = [], []
        for _ in range(400):
            field = tracker.update(noisy(layout, moved, rng))
            shares.append(field.held.mean())
            z.append((field.displacement_m - moved) / field.displacement_std_m)
        assert np.mean(shares) > 0.95
        assert np.mean(np.abs(z) < 1.96) > 0.9
        valid = np.ones(layout.shape, bool)
        valid[:, :10] = False
        assert not tracker.update(noisy(layout, moved, rng), valid).trusted

    def test_hold_can_be_switched_off(self, staggered, stream):
        tracker = ExactTracker(staggered, hold=False)
        for _ in range(2):
            assert not tracker.update(stream[12][1]).held.any()
