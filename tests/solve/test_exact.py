"""The exact tracker: honest deviations, bad frames survived, jumps bridged."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skinnode as sk
from skinnode.solve.exact import stream
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.operators.codes import OPERATORS
from tests.lanes import some_long

from .press import HI, LO, STEPS, frame_ohm, hertz_press, noisy, quantised


def test_exact_stream_is_followed_exactly(staggered, stream):
    tracker = ExactTracker(staggered, relative_noise=1e-9)
    for moved, frame in stream:
        field = tracker.update(frame)
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-9 * staggered.height_m)


@pytest.mark.parametrize("operator", OPERATORS)
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


@pytest.mark.parametrize("options", some_long(OPTIONS, OPTIONS[0]), ids=str)
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
            atol = max(1e-6 * scale, stream.TOLERANCE * small.pitch_m)  # a solve is no more exact
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


@pytest.mark.long
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
