"""The exact tracker: honest deviations, bad frames survived, jumps bridged."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, norm

import skinnode as sk
from skinnode.solve import exact, patch_stream, wires
from skinnode.solve.exact import ExactTracker
from skinnode.solve.follow import chi2_quantile
from skinnode.solve.patch_solver import TAKE, PatchSolver

from .press import frame_ohm, hertz_press

LO, HI, STEPS = 0.25, 1.25, 2**16 - 4
"""Range of R/R0 and number of steps of the 16-bit code on the wire."""


@pytest.fixture(scope="module")
def staggered() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)


@pytest.fixture(scope="module")
def rest(staggered: sk.PatchLayout) -> np.ndarray:
    return frame_ohm(staggered, np.zeros_like(staggered.upper_m))


@pytest.fixture(scope="module")
def stream(staggered: sk.PatchLayout) -> list[tuple[np.ndarray, np.ndarray]]:
    """(displacement, frame) of two presses at different places, with release, without noise."""
    scenes = []
    for centre in ((18.3e-3, 17.1e-3), (9.1e-3, 30.4e-3)):
        for t in range(24):
            depth = 0.12 * np.sin(np.pi * t / 23) ** 2
            moved = hertz_press(staggered, depth if depth > 1e-12 else 0.0, centre_m=centre)
            scenes.append((moved, frame_ohm(staggered, moved)))
    return scenes


def quantised(frame: np.ndarray, rest: np.ndarray) -> np.ndarray:
    code = np.rint((frame / rest - LO) / (HI - LO) * STEPS)
    return (LO + code * (HI - LO) / STEPS) * rest


def test_exact_stream_is_followed_exactly(staggered, stream):
    tracker = ExactTracker(staggered, relative_noise=1e-9)
    for moved, frame in stream:
        field = tracker.update(frame)
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-9 * staggered.height_m)


@pytest.mark.parametrize("operator", ["gauss_newton", "levenberg_marquardt", "dogleg"])
def test_noise_and_codes_stay_within_the_reported_deviation(staggered, stream, rest, operator):
    """z = error / deviation has RMS 1, and 95 % of it lies within 1.96."""
    rng = np.random.default_rng(11)
    code_noise = (HI - LO) / STEPS / np.sqrt(12)
    tracker = ExactTracker(staggered, operator=operator, hold=False)
    z = []
    for _ in range(5):
        for moved, frame in stream:
            noisy = quantised(frame * (1 + 1e-5 * rng.normal(size=frame.shape)), rest)
            sigma = np.hypot(1e-5, code_noise * rest / noisy)
            field = tracker.update(noisy, relative_noise=sigma)
            assert field.trusted
            z.append((field.displacement_m - moved) / field.displacement_std_m)
    z = np.array(z)
    assert 0.95 < np.sqrt(np.mean(z**2)) < 1.05
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.98


def test_deviation_is_the_cramer_rao_bound(staggered, rest):
    """At rest, from NumPy's own inverse: cov = J⁻¹ diag((σ F)²) J⁻ᵀ."""
    field = ExactTracker(staggered, relative_noise=3e-5).update(rest)
    potential = staggered.resistivity_ohm_per_m / rest
    for u, j in enumerate(sk.jacobian(staggered, staggered.upper_m).reshape(10, 30, 30)):
        spread = np.linalg.inv(j) * (3e-5 * potential[u])
        np.testing.assert_allclose(
            field.displacement_std_m[u].ravel(), np.sqrt((spread**2).sum(axis=1)), rtol=1e-6
        )


def test_unequal_noise_is_weighed_in_a_tall_patch():
    """Half of the lower wires a thousand times noisier: the estimate must rest on the other half."""
    layout = sk.PatchLayout.preset(
        "staggered", upper_wires=3, upper_electrodes=3, lower_wires=18, lower_electrodes=4
    )
    sigma = np.where(np.arange(18) % 2, 1e-2, 1e-5) * np.ones((3, 1))
    tracker = ExactTracker(layout)
    rng = np.random.default_rng(5)
    z = []
    for depth in 0.1 * np.sin(np.linspace(0, np.pi, 150)) ** 2 + 1e-6:
        moved = hertz_press(layout, depth, centre_m=(4e-3, 4e-3))
        exact = frame_ohm(layout, moved)
        field = tracker.update(exact * (1 + sigma * rng.normal(size=exact.shape)), relative_noise=sigma)
        assert field.trusted
        z.append((field.displacement_m - moved) / field.displacement_std_m)
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.1


def test_press_and_release_returns_to_zero(staggered, stream):
    tracker = ExactTracker(staggered, hold=False)
    for _ in range(3):
        for _, frame in stream:
            field = tracker.update(frame)
    assert np.abs(field.displacement_m).max() < 1e-9 * staggered.height_m


def spoilt(kind: str, frame: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
    bad, valid = frame.copy(), None
    match kind:
        case "nan":
            bad[3, 4] = np.nan
        case "zero":
            bad[3, :] = 0.0
        case "negative":
            bad[3, 7] *= -1
        case "inf":
            bad[3, 2:5] = np.inf
        case "all nan":
            bad[:] = np.nan
        case "all zero":
            bad[:] = 0.0
        case "missing chunk":
            valid = np.ones(frame.shape, bool)
            valid[3, 6:9] = False
        case "all missing":
            valid = np.zeros(frame.shape, bool)
        case "huge":
            bad *= 1e300
        case "tiny":
            bad *= 1e-300
        case "garbage":
            bad *= rng.uniform(0.2, 3.0, frame.shape)
        case "one wild value":
            bad[3, 11] *= 1.5
    return bad, valid


@pytest.mark.parametrize(
    ("kind", "statuses"),
    [
        ("nan", {sk.Status.NON_FINITE}),
        ("zero", {sk.Status.NON_FINITE}),
        ("negative", {sk.Status.NON_FINITE}),
        ("inf", {sk.Status.NON_FINITE}),
        ("all nan", {sk.Status.NON_FINITE}),
        ("all zero", {sk.Status.NON_FINITE}),
        ("missing chunk", {sk.Status.ILL_CONDITIONED}),
        ("all missing", {sk.Status.ILL_CONDITIONED}),
        ("huge", {sk.Status.NON_FINITE}),
        ("tiny", {sk.Status.NON_FINITE}),
        ("garbage", set(sk.Status) - {sk.Status.CONVERGED}),
        ("one wild value", set(sk.Status) - {sk.Status.CONVERGED}),
    ],
)
def test_bad_frames_get_a_status_and_leave_no_trace(staggered, stream, kind, statuses):
    tracker, witness = (ExactTracker(staggered, hold=False) for _ in range(2))
    rng = np.random.default_rng(2)
    for number, (moved, frame) in enumerate(stream[:12]):
        if number in (0, 4, 5, 9):
            bad, valid = spoilt(kind, frame, rng)
            field = tracker.update(bad, valid)
            hit = range(10) if kind.startswith(("all", "huge", "tiny", "garbage")) else [3]
            assert {field.status[u] for u in hit} <= statuses
            assert np.isfinite(field.displacement_m).all()
            assert np.isinf(field.displacement_std_m[hit]).all()
            assert not np.isnan(field.displacement_std_m).any()
            assert not np.isnan(field.residual).any()
            assert np.abs(field.displacement_m).max() < staggered.height_m
            if list(hit) == [3]:  # the other wires do not suffer
                others = np.arange(10) != 3
                assert all(field.status[u] is sk.Status.CONVERGED for u in np.flatnonzero(others))
                np.testing.assert_allclose(field.displacement_m[others], moved[others], atol=1e-11)
        again, unspoilt = tracker.update(frame), witness.update(frame)
        assert again.trusted
        np.testing.assert_allclose(again.displacement_m, unspoilt.displacement_m, atol=1e-12)
        # the deviation is that of an inverse up to eight frames old, and not of the same frame in both
        np.testing.assert_allclose(again.displacement_std_m, unspoilt.displacement_std_m, rtol=4e-2)


def test_a_wire_with_equations_to_spare_loses_some(staggered):
    layout = sk.PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=16, lower_electrodes=4
    )
    tracker = ExactTracker(layout)
    valid = np.ones(layout.shape, bool)
    valid[:, 3:6] = False
    for depth in np.linspace(0.02, 0.2, 10):
        moved = hertz_press(layout, depth, centre_m=(6e-3, 6e-3))
        frame = frame_ohm(layout, moved)
        complete = tracker.update(frame)
        frame[:, 3:6] = 1e3  # what a missing chunk may hold
        field = tracker.update(frame, valid)
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-9 * layout.height_m)
        assert (field.displacement_std_m >= complete.displacement_std_m * (1 - 1e-6)).all()


@pytest.mark.parametrize("depth", [0.3, 0.5, 0.7])
def test_a_press_between_two_frames_is_bridged(staggered, rest, depth):
    moved = hertz_press(staggered, depth)
    tracker = ExactTracker(staggered)
    for truth, frame in ((np.zeros_like(moved), rest), (moved, frame_ohm(staggered, moved))) * 2:
        field = tracker.update(frame)
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, truth, atol=1e-9 * staggered.height_m)


def test_reset_forgets_the_stream(staggered, stream):
    fresh, used = ExactTracker(staggered), ExactTracker(staggered)
    for _, frame in stream[:10]:
        used.update(frame)
    used.reset()
    frame = stream[30][1]
    np.testing.assert_array_equal(used.update(frame).displacement_m, fresh.update(frame).displacement_m)


def test_baseline_cancels_gain_and_resistivity(staggered, stream, rest):
    gain = np.random.default_rng(9).uniform(0.5, 2.0, rest.shape)
    tracker = ExactTracker(staggered, baseline_ohm=rest * gain)
    moved, frame = stream[12]
    np.testing.assert_allclose(tracker.update(frame * gain).displacement_m, moved, atol=2e-12)


def test_force_is_stiffness_times_displacement(staggered, stream):
    moved, frame = stream[12]
    field = ExactTracker(staggered, stiffness_n_per_m=250.0).update(frame)
    np.testing.assert_allclose(field.force_n, 250.0 * moved, atol=1e-8)
    assert ExactTracker(staggered).update(frame).force_n is None


def test_trackers_on_threads_agree_with_one_alone(staggered, stream):
    alone = ExactTracker(staggered)
    expected = [alone.update(frame).displacement_m for _, frame in stream]
    results: list[list[np.ndarray]] = [[] for _ in range(4)]

    def follow(out: list[np.ndarray]) -> None:
        tracker = ExactTracker(staggered)
        out.extend(tracker.update(frame).displacement_m for _, frame in stream)

    threads = [threading.Thread(target=follow, args=(out,)) for out in results]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for out in results:
        np.testing.assert_array_equal(out, expected)


def test_fields_are_not_overwritten_by_later_frames(staggered, stream):
    tracker = ExactTracker(staggered)
    first = tracker.update(stream[12][1])
    kept = first.displacement_m.copy(), first.displacement_std_m.copy(), first.residual.copy()
    tracker.update(stream[0][1])
    for array, copy in zip(
        (first.displacement_m, first.displacement_std_m, first.residual), kept, strict=True
    ):
        np.testing.assert_array_equal(array, copy)


def test_frames_given_are_not_written_to(staggered, stream):
    frame, valid = stream[3][1].copy(), np.ones(staggered.shape, bool)
    frame[0, 0], valid[1, 1] = np.nan, False
    frame.flags.writeable = valid.flags.writeable = False
    ExactTracker(staggered).update(frame, valid)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"relative_noise": 0.0}, "relative_noise: got 0.0, must be positive and finite"),
        ({"relative_noise": np.ones(7)}, r"relative_noise: got shape \(7,\), must be a number or \(10, 30\)"),
        ({"operator": "simplex"}, "operator: got 'simplex'"),
        ({"stiffness_n_per_m": -1.0}, "stiffness_n_per_m: got -1.0"),
        ({"baseline_ohm": np.ones((3, 3))}, r"baseline_ohm: got shape \(3, 3\), must be \(10, 30\)"),
    ],
)
def test_bad_options_are_named(staggered, options, complaint):
    with pytest.raises(ValueError, match=complaint):
        ExactTracker(staggered, **options)


def test_bad_shapes_are_named(staggered, rest):
    tracker = ExactTracker(staggered)
    with pytest.raises(ValueError, match=r"frame_ohm: got shape \(30, 10\), must be \(10, 30\)"):
        tracker.update(rest.T)
    with pytest.raises(ValueError, match=r"valid: got int64 of shape \(10, 30\), must be bool"):
        tracker.update(rest, np.ones((10, 30), np.int64))
    with pytest.raises(ValueError, match="layout: got 29 lower wires for 30 unknowns"):
        ExactTracker(sk.PatchLayout.preset("staggered", lower_wires=29))


def test_residual_of_a_held_wire_says_how_far_off_it_is(staggered, stream, rest):
    tracker = ExactTracker(staggered)
    frame = stream[12][1]
    valid = np.ones(frame.shape, bool)
    valid[4, :3] = False
    field = tracker.update(frame, valid)  # wire 4 is held at rest, where its F is that of the rest frame
    assert field.residual[4] == pytest.approx(np.sqrt(np.mean((frame / rest - 1)[4, 3:] ** 2)), rel=1e-9)
    assert field.residual[5] < 1e-9
    assert tracker.update(frame, np.zeros(frame.shape, bool)).residual[4] == np.inf


def dent(layout: sk.PatchLayout, depth: float, *, shear: float = 0.3, centre=(4.0, 5.0)) -> np.ndarray:
    """A press felt by the electrodes within 1.2 pitches of (upper wire, electrode) ``centre`` alone."""
    wire, electrode = np.indices(layout.upper_m.shape[:2])
    ratio = ((wire - centre[0]) ** 2 + (electrode - centre[1]) ** 2) / 1.2**2
    sunk = depth * layout.height_m * np.clip(1 - ratio, 0, None) ** 2
    return np.stack([shear * sunk, -0.5 * shear * sunk, -sunk], axis=-1)


def noisy(layout: sk.PatchLayout, moved: np.ndarray, rng: np.random.Generator, sigma: float = 1e-5):
    return frame_ohm(layout, moved) * (1 + sigma * rng.normal(size=layout.shape))


def relative_slopes(layout: sk.PatchLayout, moved: np.ndarray) -> np.ndarray:
    """∂(R F)/∂x at R = 1/F, (U, K, 3N), 1/m."""
    potential = layout.resistivity_ohm_per_m / frame_ohm(layout, moved)
    return sk.jacobian(layout, layout.upper_m + moved).reshape(*layout.shape, -1) / potential[:, :, None]


@pytest.mark.parametrize("probability", [0.95, 0.99, 1 - 1e-4, 1 - 1e-9])
def test_quantiles_of_chi_squared(probability):
    for dof in (2, 3, 9, 20, 30, 60, 200):
        ratio = chi2_quantile(dof, norm.ppf(probability)) / chi2.ppf(probability, dof)
        assert 0.99 < ratio < (1.05 if dof >= 9 else 1.2)


class TestFollow:
    """A wire that moved a little is solved with the inverse of an earlier frame."""

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

    def test_every_wire_has_a_new_inverse_after_eight_frames(self, staggered):
        tracker, counts = ExactTracker(staggered, hold=False), []
        for n in range(1, 17):
            frame = frame_ohm(staggered, hertz_press(staggered, 0.1 + 1e-5 * n))
            counts.append(tracker.update(frame).stats.jacobians)
        assert sum(counts[-8:]) == 10  # a wire each, in its turn
        assert max(counts[-8:]) <= 2


class TestHold:
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


class Clock:
    """Time stands still but for the solver: every wire that has its turn in a call takes ``call_s``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, call_s: float) -> None:
        self.now, self.call_s = 0.0, call_s
        for module in (exact, patch_stream):
            monkeypatch.setattr(module, "perf_counter", lambda: self.now)
        monkeypatch.setattr(PatchSolver, "solve", self._timed(PatchSolver.solve))
        monkeypatch.setattr(PatchSolver, "advance", self._timed(PatchSolver.advance, clears=TAKE))

    def _timed(self, call: Callable[..., Any], clears: int = 0) -> Callable[..., Any]:
        def timed(solver: PatchSolver, *args: Any, **kwargs: Any) -> Any:
            turns = solver.report[:, wires.TURN]
            before = turns.copy()
            turns[:] = 0
            result = call(solver, *args, **kwargs)
            self.now += self.call_s * np.count_nonzero(turns)
            if not (clears and args[0] & clears):
                turns |= before
            return result

        return timed


class TestDeadline:
    def test_wires_take_turns_and_hold_still_between(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=70.0)
        clock = Clock(monkeypatch, 20e-6)
        served, last = [], np.zeros_like(staggered.upper_m)
        for moved, frame in stream[:6]:
            begin = clock.now
            field = tracker.update(frame)
            assert clock.now - begin <= 90e-6
            late = np.array([status is sk.Status.DEADLINE for status in field.status])
            served.append(set(np.flatnonzero(~late).tolist()))
            assert (np.array(field.status)[~late] == sk.Status.CONVERGED).all()
            np.testing.assert_array_equal(field.displacement_m[late], last[late])
            assert np.isinf(field.displacement_std_m[late]).all()
            assert np.isfinite(field.displacement_std_m[~late]).all()
            z = ((field.displacement_m - moved) / field.displacement_std_m)[~late]
            assert np.abs(z).max() < 1
            last = field.displacement_m
        assert served == [
            {0, 1, 2, 3}, {4, 5, 6, 7}, {8, 9, 0, 1}, {2, 3, 4, 5}, {6, 7, 8, 9}, {0, 1, 2, 3},
        ]  # fmt: skip
        clock.call_s = 0.0
        field = tracker.update(stream[6][1])
        assert field.trusted
        assert np.isfinite(field.displacement_std_m).all()

    def test_the_next_frame_goes_on_as_if_nothing_had_happened(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=50.0, hold=False)
        witness = ExactTracker(staggered, hold=False)
        clock = Clock(monkeypatch, 0.0)
        for n, (_, frame) in enumerate(stream[:24]):
            clock.call_s = 20e-6 if n % 3 == 1 else 0.0
            field, expected = tracker.update(frame), witness.update(frame)
            if clock.call_s == 0.0:
                assert field.trusted
                np.testing.assert_allclose(field.displacement_m, expected.displacement_m, atol=1e-12)

    def test_bridges_obey_too_and_every_wire_gets_its_turn(self, staggered, rest, monkeypatch):
        moved = hertz_press(staggered, 0.5)
        frame = frame_ohm(staggered, moved)
        garbage = frame * np.random.default_rng(2).uniform(0.2, 3.0, frame.shape)
        tracker = ExactTracker(staggered, deadline_us=400.0)
        clock = Clock(monkeypatch, 20e-6)
        for bad in (garbage, garbage, frame, garbage):
            begin = clock.now
            field = tracker.update(bad)
            assert clock.now - begin <= 420e-6
            assert np.isfinite(field.displacement_m).all()
            if bad is garbage:
                assert sk.Status.DEADLINE in field.status
        for _ in range(40):
            field = tracker.update(frame)
            if field.trusted:
                break
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-9 * staggered.height_m)

    @pytest.mark.parametrize("deadline_us", [95.0, 105.0, 115.0])
    def test_joining_electrodes_obey(self, staggered, monkeypatch, deadline_us):
        """Wires cut short before, or between, their sets of electrodes: the next frame does without."""
        options = {"active_only": True, "relative_noise": 1e-8}
        tracker = ExactTracker(staggered, deadline_us=deadline_us, **options)
        clock = Clock(monkeypatch, 0.0)
        cut = 0
        for n, depth in enumerate(0.2 * np.sin(np.linspace(0, np.pi, 30)) ** 2):
            moved = dent(staggered, depth, centre=(4.0, 2 + n / 6))
            clock.call_s = 10e-6 if n % 2 else 0.0
            begin = clock.now
            field = tracker.update(frame_ohm(staggered, moved))
            assert clock.now - begin <= deadline_us * 1e-6 + 10e-6
            assert np.isfinite(field.displacement_m).all()
            cut += sk.Status.DEADLINE in field.status
            if clock.call_s == 0.0:
                assert field.trusted
                assert np.abs(field.displacement_m - moved).max() < 1e-4 * staggered.height_m
        assert cut > 0

    def test_an_impossible_deadline_still_serves_a_wire_a_frame(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=1e-3)
        Clock(monkeypatch, 20e-6)
        for n in range(12):
            field = tracker.update(stream[5][1])
            done = [u for u, status in enumerate(field.status) if status is sk.Status.CONVERGED]
            assert done == [n % 10]

    def test_no_deadline_asks_no_clock_for_the_result(self, staggered, stream, monkeypatch):
        free, bound = ExactTracker(staggered), ExactTracker(staggered, deadline_us=1e6)
        Clock(monkeypatch, 20e-6)
        for _, frame in stream[:12]:
            a, b = free.update(frame), bound.update(frame)
            np.testing.assert_array_equal(a.displacement_m, b.displacement_m)
            np.testing.assert_array_equal(a.displacement_std_m, b.displacement_std_m)


def follow(tracker: ExactTracker, layout: sk.PatchLayout, scenes: list[np.ndarray], seed: int):
    """(fields, z) of a noisy stream."""
    rng = np.random.default_rng(seed)
    fields = [tracker.update(noisy(layout, moved, rng)) for moved in scenes]
    z = [(f.displacement_m - moved) / f.displacement_std_m for f, moved in zip(fields, scenes, strict=True)]
    return fields, np.array(z)


PRESSING = 0.15 * np.sin(np.linspace(0, np.pi, 40)) ** 2


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


def test_a_tall_patch_refuses_what_no_position_explains():
    layout = sk.PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=16, lower_electrodes=4
    )
    tracker, rng = ExactTracker(layout), np.random.default_rng(7)
    moved = hertz_press(layout, 0.1, centre_m=(6e-3, 6e-3))
    assert tracker.update(noisy(layout, moved, rng)).trusted
    frame = noisy(layout, moved, rng)
    frame[1, 5] *= 1.01
    field = tracker.update(frame)
    assert [field.status[u] is sk.Status.CONVERGED for u in range(4)] == [True, False, True, True]
    assert field.status[1] is sk.Status.ILL_CONDITIONED
    assert np.isinf(field.displacement_std_m[1]).all()
    valid = np.ones(layout.shape, bool)
    valid[1, 5] = False
    assert tracker.update(frame, valid).trusted


CORRUPTIONS = st.tuples(
    st.sampled_from(
        [0.0, -1.0, np.inf, -np.inf, np.nan, 1e300, 1e-300, 5e-324, 0.3, 0.97, 1.0001, 3.0, 50.0]
    ),
    st.sampled_from(["value", "wire", "column", "all"]),
    st.integers(0, 3),
    st.integers(0, 11),
)
OPTIONS = [{}, {"active_only": True}, {"normal_only": True}, {"hold": False}, {"deadline_us": 1e7}]


@pytest.fixture(scope="module")
def small() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@settings(deadline=None, max_examples=25)
@given(st.dictionaries(st.integers(0, 9), CORRUPTIONS, max_size=6))
def test_corrupt_frames_leave_no_trace(small, options, corruptions):
    """Good frames after bad ones are solved as by a tracker that never saw those, to 1e-6 with exact data."""
    tracker, witness = (ExactTracker(small, relative_noise=1e-9, **options) for _ in range(2))
    shear = 0.0 if "normal_only" in options else 0.3
    for n in range(11):
        depth = 0.02 + 0.15 * np.sin(np.pi * n / 10) ** 2
        moved = hertz_press(small, depth, shear=shear, centre_m=(1.4, 1.6), radius_m=2.0)
        frame = frame_ohm(small, moved)
        if n in corruptions:
            value, what, u, k = corruptions[n]
            where = {"value": (u, k), "wire": (u,), "column": (slice(None), k), "all": ()}[what]
            bad = frame.copy()
            with np.errstate(all="ignore"):
                bad[where] *= value
            field = tracker.update(bad)
            hit = np.array([not np.array_equal(b, f) for b, f in zip(bad, frame, strict=True)])
            assert np.isfinite(field.displacement_m).all()
            assert np.abs(field.displacement_m).max() < 2 * small.height_m
            assert not np.isnan(field.displacement_std_m).any()
            assert not np.isnan(field.residual).any()
            trusted = np.array([status is sk.Status.CONVERGED for status in field.status])
            assert np.isinf(field.displacement_std_m[~trusted]).all()
            assert np.isfinite(field.displacement_std_m[trusted]).all()
            if not 0.5 < value < 2:  # what can still be trusted did without the impossible values
                hit &= ~trusted
            if not hit.all():
                assert np.abs((field.displacement_m - moved)[~hit]).max() < 1e-6 * small.height_m
        else:
            field, expected = tracker.update(frame), witness.update(frame)
            assert field.trusted
            scale = np.abs(moved).max()
            atol = max(1e-6 * scale, patch_stream.TOLERANCE * small.pitch_m)  # a solve is no more exact
            np.testing.assert_allclose(field.displacement_m, expected.displacement_m, atol=atol)
            np.testing.assert_allclose(field.displacement_m, moved, atol=atol)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-12, 0.0])
def test_an_electrode_on_a_lower_one(small, gap):
    tracker = ExactTracker(small)
    rest = frame_ohm(small, np.zeros_like(small.upper_m))
    moved = np.zeros_like(small.upper_m)
    lower = small.lower_m.reshape(-1, 3)
    nearest = lower[np.argmin(np.linalg.norm(lower - small.upper_m[1, 2], axis=1))]
    moved[1, 2] = nearest + np.array([0, 0, gap]) - small.upper_m[1, 2]
    with np.errstate(divide="ignore"):
        touching = frame_ohm(small, moved)
    for _ in range(2):
        field = tracker.update(touching)
        assert np.isfinite(field.displacement_m).all()
        assert not np.isnan(field.displacement_std_m).any()
        if field.status[1] is sk.Status.CONVERGED:
            assert np.abs((field.displacement_m - moved)[1] / field.displacement_std_m[1]).max() < 5
    field = tracker.update(rest)
    assert field.trusted
    assert np.abs(field.displacement_m).max() < 1e-9


def test_noise_of_a_frame_that_is_none_drops_its_resistance(small):
    tracker, rest = ExactTracker(small), frame_ohm(small, np.zeros_like(small.upper_m))
    for bad in (np.nan, 0.0, -1.0, np.inf, 1e300):
        noise = np.full(small.shape, 1e-5)
        noise[2, 3] = bad
        field = tracker.update(rest, relative_noise=noise)
        assert [status is sk.Status.CONVERGED for status in field.status] == [True, True, False, True]
        assert np.isfinite(field.displacement_m).all()
        assert sk.Status.CONVERGED not in tracker.update(rest, relative_noise=bad).status
    assert tracker.update(rest).trusted


def test_same_bits_whatever_else_runs(staggered, stream):
    """With every option on, four at a time, beside trackers of other options fed other frames."""
    rng = np.random.default_rng(13)
    frames = [frame * (1 + 1e-5 * rng.normal(size=frame.shape)) for _, frame in stream[:16]]
    frames[7] = frames[7] * 1.3
    kinds = [{}, {"hold": False}, {"active_only": True}, {"normal_only": True}]
    alone = []
    for options in kinds:
        tracker = ExactTracker(staggered, **options)
        alone.append([tracker.update(frame) for frame in frames])
    results: dict[int, list[sk.FieldFrame]] = {}

    def run(number: int) -> None:
        tracker = ExactTracker(staggered, **kinds[number % 4])
        results[number] = [tracker.update(frame) for frame in frames]

    threads = [threading.Thread(target=run, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number, fields in results.items():
        for field, expected in zip(fields, alone[number % 4], strict=True):
            assert field.displacement_m.tobytes() == expected.displacement_m.tobytes()
            assert field.displacement_std_m.tobytes() == expected.displacement_std_m.tobytes()
            assert field.status == expected.status
