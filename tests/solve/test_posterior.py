"""The posterior over streams: right within its own deviations, whatever the frames are like.

Truths are closed forms of spheres on rubber and dents of other shapes, which come from no prior; resistances
are those of the reference model.
"""

from __future__ import annotations

import functools
import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable

import numpy as np
import pytest

import skinnode as sk
from skinnode.model.elastic import HertzContact, Rubber
from skinnode.solve.posterior import load_prior, map_estimate, posterior
from tests.lanes import some_long

from .press import frame_ohm, hertz_press

SIGMA = 1e-5


@pytest.fixture(scope="module")
def staggered() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered")


@pytest.fixture(scope="module")
def small() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=5, upper_electrodes=5, lower_electrodes=6)


@pytest.fixture(scope="module")
def noise_tracker() -> Callable[[int], tuple[sk.PatchLayout, sk.Posterior]]:
    """Layout and tracker for a number of lower wires; setting one up for 150 takes seconds."""

    @functools.cache
    def make(lower_wires: int) -> tuple[sk.PatchLayout, sk.Posterior]:
        layout = sk.PatchLayout.preset("staggered", lower_wires=lower_wires)
        return layout, sk.Posterior(layout, estimate_noise=True)

    return make


def sphere(layout: sk.PatchLayout, rng: np.random.Generator, depth: float) -> np.ndarray:
    """A sphere somewhere on the patch, dragged, in Hertz's closed form."""
    points = layout.upper_m[..., :2].reshape(-1, 2)
    centre = rng.uniform(points.min(axis=0) + 4e-3, points.max(axis=0) - 4e-3)
    angle, friction = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.3)
    traction = (friction * np.cos(angle), friction * np.sin(angle))
    contact = HertzContact(
        Rubber(), rng.uniform(6e-3, 16e-3), depth * layout.height_m, (centre[0], centre[1]), traction
    )
    return contact.displacement_m(points).reshape(layout.upper_m.shape)


def dent(layout: sk.PatchLayout, rng: np.random.Generator, depth: float, kind: str) -> np.ndarray:
    """What no sphere presses: a Gaussian, a ridge across the patch, a plateau; with shear."""
    points = layout.upper_m[..., :2]
    low, high = points.min(axis=(0, 1)) + 8e-3, points.max(axis=(0, 1)) - 8e-3
    offset = (points - rng.uniform(low, high)) / layout.pitch_m
    match kind:
        case "gauss":
            shape = np.exp(-0.5 * (offset**2).sum(axis=-1) / rng.uniform(1, 3) ** 2)
        case "ridge":
            angle = rng.uniform(0, np.pi)
            shape = np.exp(-0.5 * (offset @ [np.cos(angle), np.sin(angle)]) ** 2 / 1.5**2)
        case _:
            shape = 1 / (1 + np.exp((np.linalg.norm(offset, axis=-1) - 2) / 0.5))
    along = np.array([*rng.uniform(-0.3, 0.3, 2), -1.0])
    return np.asarray(depth * layout.height_m * shape[..., None] * along)


def noisy(frame: np.ndarray, rng: np.random.Generator, sigma: float = SIGMA) -> np.ndarray:
    return np.asarray(frame * (1 + sigma * rng.normal(size=frame.shape)))


def deviations(field: sk.FieldFrame, moved: np.ndarray) -> np.ndarray:
    """Errors in reported deviations. A deviation that is not finite claims nothing and fails here."""
    assert np.isfinite(field.displacement_std_m).all()
    assert (field.displacement_std_m > 0).all()
    return np.asarray((field.displacement_m - moved) / field.displacement_std_m)


SETTINGS = [  # layout, noise, least share in 95 % intervals; a ridge under much noise is farthest
    ("staggered", 1e-6, 0.90),
    ("staggered", 1e-5, 0.90),
    ("staggered", 1e-4, 0.90),
    ("staggered", 1e-3, 0.90),
    ("aligned", 1e-5, 0.90),
    ("aligned", 1e-3, 0.87),
]


@pytest.mark.long
@pytest.mark.parametrize("kind", some_long(["sphere", "gauss", "ridge", "plateau"], "sphere", "plateau"))
@pytest.mark.parametrize(("name", "sigma", "least"), some_long(SETTINGS, SETTINGS[1]))
def test_reported_deviations_and_intervals_hold(name, sigma, least, kind):
    """A jump from rest to each of 10 scenes is solved: 95 % in the interval, no error beyond 5 deviations."""
    layout = sk.PatchLayout.preset(name)
    rng = np.random.default_rng(8)
    tracker = sk.Posterior(layout, relative_noise=sigma, prior="cells")
    inside, error2, reported2 = [], [], []
    for depth in rng.uniform(0.05, 0.4, 10):
        moved = sphere(layout, rng, depth) if kind == "sphere" else dent(layout, rng, depth, kind)
        tracker.reset()
        field = tracker.update(noisy(sk.resistance_ohm(layout, layout.upper_m + moved), rng, sigma))
        assert field.trusted
        error = np.abs(field.displacement_m - moved)
        assert (error < 5 * field.displacement_std_m).all()
        assert (field.half_width_95_m <= 1.96 * field.displacement_std_m).all()
        inside.append(np.mean(error < field.half_width_95_m))
        error2.append(np.mean(error**2))
        reported2.append(np.mean(field.displacement_std_m**2))
    assert least <= np.mean(inside) <= 0.985
    assert np.sqrt(np.sum(error2) / np.sum(reported2)) <= 1.15


def test_a_jump_beside_missing_wires_ends_on_the_right_root():
    """Five of ten wires, a layer of one pitch, 70 % between two frames: annealed once only, the wire below
    the press ends on another root, 0.36 mm off."""
    full = sk.PatchLayout.preset("staggered", height_m=4e-3)
    layout = sk.PatchLayout(full.upper_m[[0, 2, 5, 8, 9]], full.lower_m, full.resistivity_ohm_per_m)
    contact = HertzContact(
        Rubber(),
        radius_m=0.014771423810290708,
        indentation_m=2.8e-3,
        center_m=(0.0148668657670782, 0.027077897109609252),
        traction_ratio=(0.1581682575823667, 0.20992435014179808),
    )
    moved = contact.displacement_m(layout.upper_m[..., :2].reshape(-1, 2)).reshape(layout.upper_m.shape)
    field = sk.Posterior(layout).update(sk.resistance_ohm(layout, layout.upper_m + moved))
    assert field.trusted
    assert np.abs(deviations(field, moved)).max() < 5
    assert np.abs(field.displacement_m - moved).max() < 1e-5


def test_deviations_shrink_with_the_noise(staggered):
    """A press of 20 %: a hundredth of the noise leaves less than a twentieth of the error and deviation."""
    rng = np.random.default_rng(2)
    moved = hertz_press(staggered, 0.2)
    exact = frame_ohm(staggered, moved)
    errors, reported = [], []
    for sigma in (1e-4, 1e-6):
        posterior = sk.Posterior(staggered, relative_noise=sigma, prior="cells")
        field = posterior.update(noisy(exact, rng, sigma))
        assert field.trusted
        errors.append(np.sqrt(np.mean((field.displacement_m - moved) ** 2)))
        reported.append(np.sqrt(np.mean(field.displacement_std_m**2)))
    assert errors[1] < errors[0] / 20
    assert reported[1] < reported[0] / 20


@pytest.mark.long
@pytest.mark.parametrize(
    "lost", some_long(["a tenth", "half", "one wire", "three wires", "all but one wire"], "half", "one wire")
)
def test_missing_resistances_cost_certainty_not_truth(staggered, lost):
    rng = np.random.default_rng(4)
    valid = np.ones(staggered.shape, bool)
    match lost:
        case "a tenth":
            valid = rng.random(valid.shape) > 0.1
        case "half":
            valid = rng.random(valid.shape) > 0.5
        case "one wire":
            valid[4] = False
        case "three wires":
            valid[[1, 4, 5]] = False
        case _:
            valid[:4] = valid[5:] = False
    whole, some = sk.Posterior(staggered, hold=False), sk.Posterior(staggered, hold=False)
    for depth in (0.0, 0.1, 0.3):
        moved = hertz_press(staggered, depth)
        frame = noisy(frame_ohm(staggered, moved), rng)
        full, field = whole.update(frame), some.update(np.where(valid, frame, np.nan), valid)
        assert field.trusted == (lost in ("a tenth", "one wire"))  # the rest is too little, and said so
        assert field.trusted or "of the readings are usable" in field.distrust
        assert np.abs(deviations(field, moved)).max() < 5
        few = ~valid.all(axis=1)
        spread = np.sqrt((field.displacement_std_m[few] ** 2).mean(axis=(1, 2)))
        before = np.sqrt((full.displacement_std_m[few] ** 2).mean(axis=(1, 2)))
        assert (spread > before).all()
        assert (np.isinf(field.residual) == ~valid.any(axis=1)).all()


@pytest.mark.long
def test_a_value_that_is_no_resistance_is_the_same_as_a_missing_one(staggered):
    rng = np.random.default_rng(4)
    frame = noisy(frame_ohm(staggered, hertz_press(staggered, 0.2)), rng)
    valid = rng.random(frame.shape) > 0.1
    expected = sk.Posterior(staggered).update(frame, valid)
    for value in (np.nan, np.inf, -np.inf, 0.0, -5.0, 1e300, 1e-300):
        field = sk.Posterior(staggered).update(np.where(valid, frame, value))
        np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)
        np.testing.assert_array_equal(field.displacement_std_m, expected.displacement_std_m)
    field = sk.Posterior(staggered).update(frame, None, np.where(valid, SIGMA, np.inf))
    np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)


BAD = ["nan", "inf", "negative", "zero", "huge", "tiny", "garbage", "not valid", "noise unknown", "shuffled"]


@pytest.mark.long
@pytest.mark.parametrize("kind", some_long(BAD, "nan", "garbage"))
def test_a_bad_frame_is_not_believed_and_the_next_is_solved(staggered, kind):
    rng = np.random.default_rng(6)
    tracker, other = sk.Posterior(staggered), sk.Posterior(staggered)
    for depth in (0.0, 0.1, 0.2):
        frame = noisy(frame_ohm(staggered, hertz_press(staggered, depth)), rng)
        before = tracker.update(frame)
        other.update(frame)
    bad, valid, noise = frame.copy(), None, None
    match kind:
        case "nan" | "inf" | "negative" | "zero":
            bad[:] = {"nan": np.nan, "inf": np.inf, "negative": -1.0, "zero": 0.0}[kind]
        case "huge":
            bad *= 1e200
        case "tiny":
            bad *= 1e-200
        case "garbage":
            bad *= rng.uniform(0.2, 3.0, bad.shape)
        case "not valid":
            valid = np.zeros(bad.shape, bool)
        case "noise unknown":
            noise = np.full(bad.shape, np.nan)
        case _:
            rng.shuffle(bad.ravel())
    field = tracker.update(bad, valid, noise)
    assert not field.trusted
    np.testing.assert_array_equal(field.displacement_m, before.displacement_m)
    assert np.isinf(field.displacement_std_m).all()
    assert field.contacts == ()
    frame = noisy(frame_ohm(staggered, moved := hertz_press(staggered, 0.25)), rng)
    field, expected = tracker.update(frame), other.update(frame)
    assert field.trusted
    assert np.abs(deviations(field, moved)).max() < 5
    gap = (field.displacement_m - expected.displacement_m) / expected.displacement_std_m
    assert np.sqrt(np.mean(gap**2)) < 0.5  # places of loads are learnt over frames


SPOILT_WIRE = {
    "shorted": lambda wire, rng: np.full_like(wire, 0.3 * wire.mean()),
    "all alike": lambda wire, rng: np.full_like(wire, wire.mean()),
    "doubled": lambda wire, rng: 2 * wire,
    "reversed": lambda wire, rng: wire[::-1],
    "noise of 20 %": lambda wire, rng: wire * rng.uniform(0.8, 1.2, wire.shape),
    "noise of 1 %": lambda wire, rng: wire * rng.uniform(0.99, 1.01, wire.shape),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", some_long(SPOILT_WIRE, next(iter(SPOILT_WIRE))))
def test_a_scrambled_wire_is_named_and_the_others_are_solved(staggered, kind):
    """It alone is not CONVERGED, its deviation is its neighbours' knowledge of it, and the next good frame is
    solved as if nothing had happened."""
    rng = np.random.default_rng(9)
    tracker = sk.Posterior(staggered)
    for depth in (0.0, 0.1, 0.2):
        moved = hertz_press(staggered, depth)
        bad = noisy(frame_ohm(staggered, moved), rng)
        bad[6] = SPOILT_WIRE[kind](bad[6], rng)
        field = tracker.update(bad)
        assert [u for u, status in enumerate(field.status) if status is not sk.Status.CONVERGED] == [6]
        assert field.status[6] in (sk.Status.INCONSISTENT, sk.Status.MAX_STEPS)
        assert [(fault.part, fault.upper) for fault in field.faults] == [(sk.FaultyPart.UPPER, 6)]
        assert field.trusted
        assert not field.wires_trusted[6]
        assert np.abs(deviations(field, moved)).max() < 5
        assert field.residual[6] > 100 * np.delete(field.residual, 6).max()
        field = tracker.update(noisy(frame_ohm(staggered, moved), rng))
        assert field.trusted
        z = deviations(field, moved)
        assert np.abs(z).max() < 5
        assert np.sqrt(np.mean(z**2)) < 1.15


@pytest.mark.long
@pytest.mark.parametrize(
    ("height", "sigma", "seed"), some_long([(0.5, 1e-5, 48), (1.0, 1e-6, 40)], (0.5, 1e-5, 48))
)
def test_a_prior_set_anew_that_leads_nowhere_costs_no_wire(height, sigma, seed):
    """Ridges whose solve fails once loads are expected along them: what was found before stays."""
    layout = sk.PatchLayout.preset("aligned", height_m=height * 4e-3)
    rng = np.random.default_rng(seed)
    moved = dent(layout, rng, 0.3, "ridge")
    frame = noisy(sk.resistance_ohm(layout, layout.upper_m + moved), rng, sigma)
    field = sk.Posterior(layout, relative_noise=sigma).update(frame)
    assert field.trusted
    assert np.abs(deviations(field, moved)).max() < 5


def test_scrambled_wires_of_a_first_frame_are_left_out(staggered):
    """Two at once, on one deep in the press, without any frame before."""
    rng = np.random.default_rng(10)
    moved = hertz_press(staggered, 0.3)
    bad = noisy(frame_ohm(staggered, moved), rng)
    bad[4] = bad[4, ::-1]
    bad[8] *= rng.uniform(0.9, 1.1, 30)
    field = sk.Posterior(staggered).update(bad)
    assert [u for u, status in enumerate(field.status) if status is not sk.Status.CONVERGED] == [4, 8]
    assert np.abs(deviations(field, moved)).max() < 5


@pytest.mark.parametrize(
    "sizes",
    [
        {"lower_wires": 12},
        {"lower_wires": 4},
        {"upper_electrodes": 1, "lower_wires": 12},
        {"upper_wires": 1},
        {"lower_wires": 90},
    ],
    ids=str,
)
def test_any_number_of_wires_and_electrodes_will_do(sizes):
    sizes = {"upper_wires": 5, "upper_electrodes": 5, **sizes}
    layout = sk.PatchLayout.preset("staggered", **sizes)
    rng = np.random.default_rng(1)
    z = []
    for _ in range(3):
        tracker = sk.Posterior(layout)
        points = layout.upper_m[..., :2].reshape(-1, 2)
        centre = tuple(rng.uniform(points.min(axis=0), points.max(axis=0) + 1e-9))
        for depth in (0.0, 0.1, 0.2, 0.3, 0.1, 0.0):
            moved = hertz_press(layout, depth, centre_m=centre)
            field = tracker.update(noisy(frame_ohm(layout, moved), rng))
            if field.trusted:
                z.append(deviations(field, moved))
    assert len(z) >= 16  # of 18; a jump too far is said to be one
    assert np.abs(z).max() < 5
    assert np.mean(np.abs(z) < 1.96) > 0.9
    covariance = tracker.covariance_m2()
    assert covariance.shape == (layout.upper_m.size,) * 2


def test_a_single_electrode_among_a_ring_is_found():
    """One electrode above six lower ones around it: 6 equations, 3 unknowns, no neighbour to help."""
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    lower = 3e-3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[:, None]
    layout = sk.PatchLayout(np.array([[[0.2e-3, 0.1e-3, 2e-3]]]), lower)
    rng = np.random.default_rng(1)
    tracker = sk.Posterior(layout)
    z = []
    for _ in range(60):
        moved = rng.uniform([-3e-4, -3e-4, -8e-4], [3e-4, 3e-4, 0.0]).reshape(1, 1, 3)
        field = tracker.update(noisy(frame_ohm(layout, moved), rng))
        assert field.trusted
        z.append(deviations(field, moved))
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.15
    assert np.abs(z).max() < 5


@pytest.mark.parametrize("drift", ["patch", "wire"])
def test_drift_is_told_from_deformation(staggered, drift):
    """A gain error of 1 to 2 %, a thousand times the noise, is found beside a press and at rest."""
    rng = np.random.default_rng(3)
    tracker = sk.Posterior(staggered, drift=drift)
    for depth in (0.0, 0.1, 0.3, 0.0):
        gain = 0.015 * (rng.normal(size=(10, 1)) if drift == "wire" else -np.ones((10, 1)))
        moved = hertz_press(staggered, depth)
        field = tracker.update((1 + gain) * noisy(frame_ohm(staggered, moved), rng))
        assert field.trusted
        assert np.abs(deviations(field, moved)).max() < 5
        assert np.sqrt(np.mean(deviations(field, moved) ** 2)) < 1.15
        assert field.gain is not None
        np.testing.assert_allclose(field.gain, gain[:, 0], atol=1e-4 if drift == "patch" else 2e-3)


@pytest.mark.parametrize("depth", [0.0, 0.3])
def test_drift_of_the_patch_that_is_not_asked_for_is_not_taken_for_a_touch(staggered, depth):
    rng = np.random.default_rng(3)
    moved = hertz_press(staggered, depth)
    field = sk.Posterior(staggered).update(1.013 * noisy(frame_ohm(staggered, moved), rng))
    wrong = np.abs(field.displacement_m - moved) > 10 * field.displacement_std_m
    assert not wrong[np.array(field.status) == sk.Status.CONVERGED].any()
    assert field.gain is None


@pytest.mark.parametrize("thicker", [0.95, 1.05])
def test_model_error_covers_a_layer_of_another_thickness(staggered, thicker):
    """5 % thicker or thinner than the layout says, measured from its own rest: without it 5 times beyond."""
    rng = np.random.default_rng(5)
    real = sk.PatchLayout(staggered.upper_m * [1, 1, thicker], staggered.lower_m)
    rest = frame_ohm(real, np.zeros_like(real.upper_m))
    moved = hertz_press(staggered, 0.3)
    frame = noisy(frame_ohm(real, moved), rng)
    rms = []
    for share in (0.0, 0.05):
        field = sk.Posterior(staggered, baseline_ohm=rest, model_error=share).update(frame)
        assert field.trusted or not share  # a field that claims an exact layer may be distrusted
        rms.append(np.sqrt(np.mean(deviations(field, moved) ** 2)))
    assert rms[1] < 1.15 < 3 < rms[0]


@pytest.mark.long
@pytest.mark.parametrize("factor", [1 / 3, 1.0, 3.0])
@pytest.mark.parametrize("lower_wires", [60, 150])
def test_noise_is_found_where_there_are_equations_to_spare(noise_tracker, factor, lower_wires):
    layout, tracker = noise_tracker(lower_wires)
    tracker.reset()
    rng = np.random.default_rng(7)
    for depth in (0.0, 0.1, 0.2):
        moved = hertz_press(layout, depth)
        field = tracker.update(noisy(frame_ohm(layout, moved), rng, factor * SIGMA))
        assert field.noise_factor == pytest.approx(factor, rel=0.2)
        assert np.abs(deviations(field, moved)).max() < 5
    tracker.reset()
    assert tracker.update(frame_ohm(layout, 0 * moved)).noise_factor < 0.5


def test_normal_only_is_the_sharper_one_where_nothing_shears(staggered):
    rng = np.random.default_rng(7)
    plain, normal = sk.Posterior(staggered), sk.Posterior(staggered, normal_only=True)
    for depth in (0.0, 0.1, 0.3):
        moved = hertz_press(staggered, depth, shear=0.0)
        frame = noisy(frame_ohm(staggered, moved), rng)
        both, one = plain.update(frame), normal.update(frame)
        assert one.trusted
        assert (one.displacement_m[..., :2] == 0).all()
        assert (one.displacement_std_m[..., :2] == 0).all()
        z = (one.displacement_m - moved)[..., 2] / one.displacement_std_m[..., 2]
        assert np.abs(z).max() < 5
        gap = (one.displacement_m - both.displacement_m)[..., 2]
        assert (np.abs(gap) < 5 * both.displacement_std_m[..., 2]).all()
        if depth:
            assert one.displacement_std_m[..., 2].mean() < 0.7 * both.displacement_std_m[..., 2].mean()


@pytest.mark.long
def test_what_is_held_is_as_right_as_what_is_solved(staggered):
    """Two trackers on one stream with pauses; a held frame costs no factorisation."""
    rng = np.random.default_rng(12)
    holding, solving = sk.Posterior(staggered), sk.Posterior(staggered, hold=False)
    held, gaps = 0, []
    for depth in np.repeat([0.0, 0.02, 0.15, 0.3, 0.29, 0.1, 0.0], 5):
        moved = hertz_press(staggered, depth)
        frame = noisy(frame_ohm(staggered, moved), rng)
        one, two = holding.update(frame), solving.update(frame)
        assert one.trusted
        assert two.trusted
        assert one.held is not None
        assert two.held is not None
        assert not two.held.any()
        assert np.abs(deviations(one, moved)).max() < 5
        assert np.sqrt(np.mean(deviations(one, moved) ** 2)) < 1.2
        gaps.append((one.displacement_m - two.displacement_m) / np.hypot(
            one.displacement_std_m, two.displacement_std_m
        ))  # fmt: skip
        if one.held.all():
            held += 1
            assert one.stats.steps == 0
    assert np.abs(gaps).max() < 5
    assert np.sqrt(np.mean(np.square(gaps))) < 1
    assert held >= 20


@pytest.mark.parametrize("depth", [0.0, 0.2])
@pytest.mark.parametrize("lost", [4, slice(None)])
def test_what_drops_out_is_not_held(staggered, lost, depth):
    """A still press: no deviation of a wire without resistances may stay what it was with them."""
    rng = np.random.default_rng(4)
    tracker = sk.Posterior(staggered)
    moved = hertz_press(staggered, depth)
    for _ in range(3):
        before = tracker.update(noisy(frame_ohm(staggered, moved), rng))
    for _ in range(3):
        frame = noisy(frame_ohm(staggered, moved), rng)
        frame[lost] = np.nan
        field = tracker.update(frame)
        grown = (field.displacement_std_m / before.displacement_std_m)[lost]
        assert (grown[..., 2] > 1.3).mean() > 0.9
        assert field.trusted == (lost == 4)
    back = tracker.update(noisy(frame_ohm(staggered, moved), rng))
    assert back.trusted
    assert back.displacement_std_m.mean() < 1.5 * before.displacement_std_m.mean()
    assert np.abs(deviations(back, moved)).max() < 5


@pytest.mark.parametrize("options", [{}, {"estimate_noise": True}], ids=str)
def test_residual_is_that_of_the_reference_model(staggered, options):
    """RMS of F/b − 1 in the position found, from NumPy."""
    rng = np.random.default_rng(4)
    frame = noisy(frame_ohm(staggered, hertz_press(staggered, 0.2)), rng, 1e-4)
    field = sk.Posterior(staggered, relative_noise=1e-4, **options).update(frame)
    found = frame / frame_ohm(staggered, field.displacement_m) - 1
    np.testing.assert_allclose(field.residual, np.sqrt((found**2).mean(axis=1)), rtol=1e-6)


@pytest.mark.long
def test_a_slow_drift_below_the_noise_is_not_held_forever(staggered):
    """A press that grows by less than its deviation a frame: held, it never falls 5 deviations behind."""
    rng = np.random.default_rng(12)
    tracker = sk.Posterior(staggered)
    for depth in np.linspace(0.1, 0.12, 200):
        moved = hertz_press(staggered, depth)
        field = tracker.update(noisy(frame_ohm(staggered, moved), rng))
        assert np.abs(deviations(field, moved)).max() < 5
        assert np.sqrt(np.mean(deviations(field, moved) ** 2)) < 1.3


@pytest.mark.long
def test_thirty_presses_leave_nothing_behind(staggered):
    rng = np.random.default_rng(14)
    tracker = sk.Posterior(staggered)
    for _ in range(30):
        centre = tuple(rng.uniform(6e-3, 30e-3, 2))
        for depth in (0.15, 0.3, 0.0):
            moved = hertz_press(staggered, depth, centre_m=centre)
            field = tracker.update(noisy(frame_ohm(staggered, moved), rng))
            assert field.trusted
        z = deviations(field, moved)
        assert np.sqrt(np.mean(z**2)) < 1.15
        assert np.abs(z).max() < 5
        assert field.contacts == ()
    settled = tracker.update(noisy(frame_ohm(staggered, moved), rng))
    assert np.abs(settled.displacement_m).max() < 3 * settled.displacement_std_m.max()


def test_reset_forgets_the_stream(small):
    rng = np.random.default_rng(15)
    frames = [
        noisy(frame_ohm(small, hertz_press(small, d, centre_m=(8e-3, 8e-3))), rng) for d in (0, 0.1, 0.3)
    ]
    tracker, fresh = sk.Posterior(small), sk.Posterior(small)
    for frame in reversed(frames):
        tracker.update(frame)
    tracker.reset()
    for frame in frames:
        one, two = tracker.update(frame), fresh.update(frame)
        np.testing.assert_array_equal(one.displacement_m, two.displacement_m)
        np.testing.assert_array_equal(one.displacement_std_m, two.displacement_std_m)
        np.testing.assert_array_equal(one.force_n, two.force_n)


def test_deadline_gives_up_in_time_and_recovers(staggered, monkeypatch):
    """A clock that advances by 1 ms a look: a jump has no time, and with a clock at rest it is solved."""
    rng = np.random.default_rng(16)
    now = step = 0.0

    def clock() -> float:
        nonlocal now
        now += step
        return now

    monkeypatch.setattr(map_estimate, "perf_counter", clock)
    monkeypatch.setattr(posterior, "perf_counter", clock)
    tracker = sk.Posterior(staggered, deadline_us=3000.0)
    rest = tracker.update(noisy(frame_ohm(staggered, np.zeros_like(staggered.upper_m)), rng))
    assert rest.trusted
    moved = hertz_press(staggered, 0.3)
    step = 1e-3
    for _ in range(3):
        late = tracker.update(noisy(frame_ohm(staggered, moved), rng))
        assert set(late.status) == {sk.Status.DEADLINE}
        np.testing.assert_array_equal(late.displacement_m, rest.displacement_m)
        assert np.isinf(late.displacement_std_m).all()
        assert np.isfinite(late.residual).all()
        assert late.stats.steps <= 4
    step = 0.0
    field = tracker.update(noisy(frame_ohm(staggered, moved), rng))
    assert field.trusted
    assert np.abs(deviations(field, moved)).max() < 5
    step = 1e-3  # a held frame needs no time
    assert tracker.update(noisy(frame_ohm(staggered, moved), rng)).trusted
    step = 10e-3  # the deadline passes while the frame is compared with the last field
    late = tracker.update(noisy(frame_ohm(staggered, moved), rng))
    assert set(late.status) == {sk.Status.DEADLINE}


def test_covariance_belongs_to_the_field(small):
    """Positive definite; its diagonal is the deviation, which is larger where the prior speaks: on the wire
    in the middle, on a symmetry line of the layout, whatever the noise."""
    rng = np.random.default_rng(17)
    for sigma, loose in ((1e-6, 1.2), (1e-4, np.inf)):
        tracker = sk.Posterior(small, relative_noise=sigma, hold=False, prior="cells")
        field = tracker.update(
            noisy(frame_ohm(small, hertz_press(small, 0.1, centre_m=(8e-3, 8e-3))), rng, sigma)
        )
        covariance = tracker.covariance_m2()
        std = np.sqrt(np.diag(covariance))
        ratio = (field.displacement_std_m.ravel() / std).reshape(5, -1)
        assert (ratio >= 1 - 1e-9).all()
        assert (ratio <= np.sqrt(load_prior.PRIOR_DOUBT)).all()
        assert (ratio[[0, 1, 3, 4]] <= loose).all()
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12 * covariance.max())
        assert np.linalg.eigvalsh(covariance / np.outer(std, std)).min() > 0


@pytest.mark.parametrize("noise", [1e12, np.inf, np.nan, 0.0, -1e-5])
def test_noise_that_is_no_knowledge_makes_a_frame_unused(small, noise):
    field = sk.Posterior(small).update(frame_ohm(small, hertz_press(small, 0.1)), relative_noise=noise)
    assert set(field.status) == {sk.Status.ILL_CONDITIONED}
    assert np.isinf(field.displacement_std_m).all()


def test_noise_of_one_frame_is_that_of_its_deviations(small):
    """The same resistances, said to be a hundred times noisier: deviations as of a tracker that never heard
    otherwise."""
    frame = noisy(frame_ohm(small, hertz_press(small, 0.1, centre_m=(8e-3, 8e-3))), np.random.default_rng(20))
    tracker = sk.Posterior(small, relative_noise=SIGMA, hold=False)
    sharp = tracker.update(frame)
    loose = tracker.update(frame, relative_noise=100 * SIGMA)
    fresh = sk.Posterior(small, relative_noise=100 * SIGMA, hold=False, prior="cells").update(frame)
    assert np.median(loose.displacement_std_m / sharp.displacement_std_m) > 3
    assert np.median(loose.displacement_std_m / fresh.displacement_std_m) == pytest.approx(1.0, abs=0.3)


@pytest.mark.long
def test_covariance_says_how_errors_hang_together(small):
    """Whitened by it, errors of 150 noisy frames of one press are of deviation 1 in all 75 directions, up
    to what the prior takes from the weakest of them."""
    rng = np.random.default_rng(18)
    moved = hertz_press(small, 0.1, centre_m=(8e-3, 8e-3))
    exact = frame_ohm(small, moved)
    tracker = sk.Posterior(small, relative_noise=1e-6, hold=False)
    squares = []
    for _ in range(150):
        field = tracker.update(noisy(exact, rng, 1e-6))
        error = (field.displacement_m - moved).ravel()
        squares.append(error @ np.linalg.solve(tracker.covariance_m2(), error) / error.size)
    assert 0.7 < np.mean(squares) < 1.4


def scenes(layout: sk.PatchLayout) -> list[np.ndarray]:
    """Frames that are solved, annealed, held, adapted, and one bad."""
    rng = np.random.default_rng(19)
    depths = (0.0, 0.0, 0.05, 0.1, 0.4, 0.4, 0.1, 0.0)
    frames = [noisy(frame_ohm(layout, hertz_press(layout, depth)), rng) for depth in depths]
    bad = frames[3].copy()
    bad[2] *= rng.uniform(0.8, 1.2, 30)
    return [*frames, bad, frames[3]]


def digest(fields: list[sk.FieldFrame], covariance: np.ndarray) -> str:
    """Of every number a user sees."""
    whole = hashlib.sha256(covariance.tobytes())
    for field in fields:
        for array in (field.displacement_m, field.displacement_std_m, field.force_n, field.residual):
            whole.update(np.ascontiguousarray(array).tobytes())
        for contact in field.contacts:
            numbers = [
                contact.normal_force_n,
                contact.normal_force_std_n,
                contact.area_m2,
                contact.area_std_m2,
            ]
            whole.update(np.array([*numbers, *contact.centroid_m, *contact.shear_force_n]).tobytes())
        whole.update(repr(field.status).encode())
    return whole.hexdigest()


@pytest.mark.long
def test_threads_do_not_change_a_bit(staggered):
    frames = scenes(staggered)
    found = [""] * 4

    def run(i: int) -> None:
        tracker = sk.Posterior(staggered)
        found[i] = digest([tracker.update(frame) for frame in frames], tracker.covariance_m2())

    run(0)
    threads = [threading.Thread(target=run, args=(i,)) for i in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 1


@pytest.mark.long
def test_number_of_threads_of_the_algebra_does_not_change_a_bit(staggered, tmp_path):
    """In a process with one BLAS thread and in one with two."""
    np.save(tmp_path / "frames.npy", np.array(scenes(staggered)))
    code = """
import sys, hashlib, numpy as np, skinnode as sk
layout = sk.PatchLayout.preset("staggered")
plain = sk.Posterior(layout)
full = sk.Posterior(layout, drift="patch", estimate_noise=True, model_error=0.01)
digest = hashlib.sha256()
for frame in np.load(sys.argv[1]):
    for tracker in plain, full:
        f = tracker.update(frame)
        for array in f.displacement_m, f.displacement_std_m, f.force_n, f.residual:
            digest.update(array.tobytes())
        if np.isfinite(f.displacement_std_m).all():
            digest.update(tracker.covariance_m2().tobytes())
        contacts = [(c.normal_force_n, c.normal_force_std_n, c.area_m2) for c in f.contacts]
        digest.update(repr(contacts).encode())
print(digest.hexdigest())
"""
    found = set()
    for threads in ("1", "2"):
        result = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "frames.npy")],
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        found.add(result.stdout)
    assert len(found) == 1


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"prior": "discs"}, marks=pytest.mark.long),
        pytest.param({"drift": "patch", "estimate_noise": True, "model_error": 0.01}, marks=pytest.mark.long),
        pytest.param({"normal_only": True, "hold": False, "scale_m": 1e-4}, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_the_second_patch_of_a_layout_needs_no_warm_up_and_has_the_same_fields(options):
    preset = sk.PatchLayout.preset("staggered")
    layout = sk.PatchLayout(preset.upper_m, preset.lower_m, preset.resistivity_ohm_per_m)
    first, second = sk.Posterior(layout, **options), sk.Posterior(layout, **options)
    for frame in scenes(layout)[1:4]:
        field, same = first.update(frame), second.update(frame)
        for name in ("displacement_m", "displacement_std_m", "residual", "force_n"):
            np.testing.assert_array_equal(getattr(same, name), getattr(field, name))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"drift": "row"}, "drift: got 'row'"),
        ({"drift": "wire", "drift_std": 0.0}, "drift_std: got 0.0"),
        ({"model_error": -0.1}, "model_error: got -0.1"),
        ({"deadline_us": 0.0}, "deadline_us: got 0.0"),
        ({"scale_m": np.inf}, "scale_m: got inf"),
        ({"relative_noise": 0.0}, "relative_noise: got 0.0"),
        ({"relative_noise": np.ones(7)}, r"relative_noise: got shape \(7,\)"),
        ({"baseline_ohm": np.zeros((5, 15))}, "baseline_ohm: got 0.0"),
    ],
    ids=str,
)
def test_wrong_arguments_are_named(small, options, named):
    with pytest.raises(ValueError, match=named):
        sk.Posterior(small, **options)


def test_wrong_frames_are_named(small):
    tracker = sk.Posterior(small)
    frame = np.ones(small.shape)
    for arguments, named in [
        ((frame[1:],), "frame_ohm: got shape"),
        ((frame, frame), "valid: got float64"),
        ((frame, np.ones(3, bool)), "valid: got bool of shape"),
        ((frame, None, np.ones((2, 2))), "relative_noise: got shape"),
    ]:
        with pytest.raises(ValueError, match=named):
            tracker.update(*arguments)


def test_covariance_of_a_frame_that_was_not_solved_is_refused(staggered):
    tracker = sk.Posterior(staggered)
    assert not tracker.update(np.full(staggered.shape, np.nan)).trusted
    with pytest.raises(RuntimeError, match="covariance_m2: the last frame was not solved"):
        tracker.covariance_m2()


def test_a_bad_frame_is_not_put_down_to_the_model(staggered):
    """A nuisance far beyond its prior explains nothing, and the next good frames are not held at what it made
    of the bad one."""
    rng = np.random.default_rng(21)
    tracker = sk.Posterior(staggered, model_error=0.02)
    moved = hertz_press(staggered, 0.2)
    good = frame_ohm(staggered, moved)
    assert tracker.update(noisy(good, rng)).trusted
    bad = good.copy()
    bad[:, 7] *= 1.3
    field = tracker.update(noisy(bad, rng))
    if field.trusted:  # the lower wire was left out
        assert [fault.lower for fault in field.faults] == [7]
        assert np.abs(deviations(field, moved)).max() < 5
    for _ in range(3):
        field = tracker.update(noisy(good, rng))
        assert field.trusted
        assert np.abs(deviations(field, moved)).max() < 5


@pytest.mark.long
def test_a_slide_under_an_uncertain_model_is_followed(staggered):
    """The common model error stays small, though it could take the place of much of the displacement."""
    rng = np.random.default_rng(22)
    tracker = sk.Posterior(staggered, model_error=0.02, drift="patch")
    for step in range(30):
        moved = hertz_press(staggered, 0.25, centre_m=(8e-3 + 0.45e-3 * step, 17e-3))
        field = tracker.update(noisy(frame_ohm(staggered, moved), rng))
        assert field.trusted
        assert np.abs(deviations(field, moved)).max() < 5
