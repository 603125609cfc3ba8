"""``normal_only`` and ``active_only``: unknowns left out, and the deviations of those."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

import skinnode as sk
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.wires.hold import chi2_quantile

from .press import dent, frame_ohm, hertz_press, noisy, relative_slopes

PRESSING = 0.15 * np.sin(np.linspace(0, np.pi, 40)) ** 2


def follow(tracker: ExactTracker, layout: sk.PatchLayout, scenes: list[np.ndarray], seed: int):
    """(fields, z) of a noisy stream."""
    rng = np.random.default_rng(seed)
    fields = [tracker.update(noisy(layout, moved, rng)) for moved in scenes]
    z = [(f.displacement_m - moved) / f.displacement_std_m for f, moved in zip(fields, scenes, strict=True)]
    return fields, np.array(z)


class TestNormalOnly:
    def test_same_field_from_a_third_of_the_unknowns(self, staggered):
        scenes = [hertz_press(staggered, depth + 1e-9, shear=0.0) for depth in PRESSING]
        full, _ = follow(ExactTracker(staggered, hold=False), staggered, scenes, 1)
        fields, z = follow(ExactTracker(staggered, hold=False, normal_only=True), staggered, scenes, 1)
        assert all(field.trusted for field in fields)
        assert 0.9 < np.sqrt(np.mean(z[..., 2] ** 2)) < 1.1
        for one, other in zip(fields, full, strict=True):
            assert (one.displacement_m[..., :2] == 0).all()
            deviation = np.hypot(one.displacement_std_m, other.displacement_std_m)
            assert (np.abs(one.displacement_m - other.displacement_m) < 5 * deviation)[..., 2].all()
            assert (one.displacement_std_m < other.displacement_std_m)[..., 2].all()

    def test_deviations_are_those_of_least_squares_and_of_the_test(self, staggered, rest):
        """At rest by NumPy: z from (JᵀJ)⁻¹ σ², x and y from the move that takes χ² to where it refuses."""
        field = ExactTracker(staggered, normal_only=True, hold=False).update(rest)
        limit = chi2_quantile(20, norm.ppf(1 - 1e-9)) - 20
        for u, slopes in enumerate(relative_slopes(staggered, np.zeros_like(staggered.upper_m))):
            z, xy = slopes[:, 2::3], np.delete(slopes, np.s_[2::3], axis=1)
            expected = 1e-5 * np.sqrt(np.diag(np.linalg.inv(z.T @ z)))
            np.testing.assert_allclose(field.displacement_std_m[u, :, 2], expected, rtol=1e-6)
            left = xy - z @ np.linalg.lstsq(z, xy, rcond=None)[0]
            for electrode, pair in enumerate(left.T.reshape(10, 2, 30)):
                noticed = 1e-5 * np.sqrt(limit * np.diag(np.linalg.inv(pair @ pair.T)))
                reported = field.displacement_std_m[u, electrode, :2]
                np.testing.assert_allclose(reported, noticed, rtol=1e-3)

    def test_shear_is_refused_not_misread(self, staggered):
        tracker = ExactTracker(staggered, normal_only=True)
        rng = np.random.default_rng(3)
        for depth in PRESSING:
            moved = hertz_press(staggered, depth, shear=0.3)
            field = tracker.update(noisy(staggered, moved, rng))
            trusted = np.array([status is sk.Status.CONVERGED for status in field.status])
            error = np.abs(field.displacement_m - moved)[trusted]
            assert error.max(initial=0.0) < 0.01 * staggered.height_m
            assert (error < 5 * field.displacement_std_m[trusted])[..., :2].all()
            assert {field.status[u] for u in np.flatnonzero(~trusted)} <= {sk.Status.ILL_CONDITIONED}
            if depth > 0.1:
                assert not trusted[3:6].any()
        assert tracker.update(noisy(staggered, np.zeros_like(moved), rng)).trusted

    def test_fewer_lower_wires_do(self):
        layout = sk.PatchLayout.preset("staggered", lower_wires=12)
        moved = hertz_press(layout, 0.1, shear=0.0, centre_m=(4.5, 4.5), radius_m=2.0)
        field = ExactTracker(layout, normal_only=True, relative_noise=1e-8).update(frame_ohm(layout, moved))
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-5 * layout.height_m)
        with pytest.raises(ValueError, match="layout: got 9 lower wires for 10 unknowns"):
            ExactTracker(sk.PatchLayout.preset("staggered", lower_wires=9), normal_only=True)


class TestActiveOnly:
    def test_same_field_from_the_electrodes_that_move(self, staggered):
        scenes = [dent(staggered, depth) for depth in PRESSING] * 2
        full, _ = follow(ExactTracker(staggered, hold=False), staggered, scenes, 1)
        fields, z = follow(ExactTracker(staggered, hold=False, active_only=True), staggered, scenes, 1)
        assert all(field.trusted for field in fields)
        moving = np.any(scenes, axis=0)
        assert 0.85 < np.sqrt(np.mean(z[:, moving] ** 2)) < 1.1
        assert np.mean(np.abs(z) < 1.96) > 0.93
        far = ~moving.any(axis=-1)
        far[3:6, 3:8] = False
        for one, other in zip(fields, full, strict=True):
            deviation = np.hypot(one.displacement_std_m, other.displacement_std_m)
            assert (np.abs(one.displacement_m - other.displacement_m) < 5.5 * deviation).all()
        left_alone = np.mean([(field.displacement_m[far] == 0).all(axis=-1) for field in fields])
        assert left_alone > 0.9
        narrower = fields[20].displacement_std_m[moving] / full[20].displacement_std_m[moving]
        assert np.median(narrower) < 1

    @pytest.mark.parametrize("hold", [True, False])
    def test_a_press_that_moves_everything_is_followed(self, staggered, hold):
        scenes = [hertz_press(staggered, depth) for depth in PRESSING]
        fields, z = follow(ExactTracker(staggered, hold=hold, active_only=True), staggered, scenes, 2)
        assert all(field.trusted for field in fields)
        assert np.mean(np.abs(z) < 1.96) > 0.93
        assert np.abs(z).max() < 8
        assert (fields[20].displacement_m != 0).all()

    def test_release_puts_all_to_rest(self, staggered):
        scenes = [dent(staggered, depth) for depth in (0.1, 0.15, 0.1)] + [np.zeros((10, 10, 3))] * 100
        fields, _ = follow(ExactTracker(staggered, active_only=True), staggered, scenes, 3)
        at_rest = np.array([(field.displacement_m == 0).all(axis=(1, 2)) for field in fields[3:]])
        assert at_rest.mean() > 0.97
        assert all(np.isfinite(field.displacement_std_m).all() for field in fields)
        assert all((field.displacement_std_m > 0).all() for field in fields)

    def test_a_frame_that_nothing_explains_leaves_no_trace(self, staggered):
        tracker = ExactTracker(staggered, active_only=True)
        moved = dent(staggered, 0.1)
        frame = frame_ohm(staggered, moved)
        before = tracker.update(frame)
        bad = frame * np.random.default_rng(5).uniform(0.2, 3.0, frame.shape)
        assert sk.Status.CONVERGED not in tracker.update(bad).status
        after = tracker.update(frame)
        assert after.trusted
        np.testing.assert_allclose(after.displacement_m, before.displacement_m, atol=1e-12)
        far = np.array([0, 1, 2, 6, 7, 8, 9])
        assert (before.displacement_m[far] == 0).all()
        assert (after.displacement_m[far] == 0).all()

    def test_with_normal_only(self, staggered):
        scenes = [dent(staggered, depth, shear=0.0) for depth in PRESSING]
        tracker = ExactTracker(staggered, active_only=True, normal_only=True)
        fields, z = follow(tracker, staggered, scenes, 4)
        assert all(field.trusted for field in fields)
        assert np.mean(np.abs(z) < 1.96) > 0.93
        assert (fields[20].displacement_m[0] == 0).all()
