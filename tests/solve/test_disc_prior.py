"""The prior with discs: its algebra against dense formulas, and its fields on loads that it does not
expect."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.bench import accuracy_families as families
from skinnode.bench import family_scenes
from skinnode.bench.case import preset
from skinnode.bench.truth import Converter, Skin
from skinnode.solve.posterior.local import discs
from skinnode.solve.posterior.local.discs import LOADS, Effects
from tests.lanes import some_long

from .press import frame_ohm, hertz_press

PLACE = np.indices((3, 4)).reshape(2, -1).T.astype(np.float64)
DISCS = np.array([[1.0, 1.5, np.log(2.0), -0.4, -0.5], [0.5, 3.0, np.log(2.5), 0.3, 0.2]])


def problem(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, Effects]:
    """Whitened data and effects of the loads on 12 cells, and the variances of the loads, written out."""
    random = np.random.default_rng(seed)
    rows = random.standard_normal((30, LOADS * len(PLACE)))
    variance = np.zeros((len(PLACE), LOADS))
    for row, column, size, amplitude, layer in DISCS:
        r = np.hypot(*(PLACE - [row, column]).T)
        w = np.exp(2 * amplitude) / (1 + np.exp((r - np.exp(size) - 0.25) / 0.25))
        variance += w[:, None] * np.array([1.0, 1.0, 1.0, np.exp(2 * layer)])
    data = rows @ (
        np.sqrt(variance.ravel()) * random.standard_normal(rows.shape[1])
    ) + random.standard_normal(30)
    return data, rows, variance.ravel(), Effects(PLACE, rows.T @ rows, rows.T @ data)


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_is_the_density_of_the_data_over_that_of_untouched_skin(seed):
    data, rows, variance, effects = problem(seed)
    touched = multivariate_normal(cov=np.eye(30) + (rows * variance) @ rows.T).logpdf(data)
    expected = touched - multivariate_normal(cov=np.eye(30)).logpdf(data)
    found = discs.evidence(DISCS, effects, discs.make_scratch(len(PLACE)))
    assert found == pytest.approx(expected, rel=1e-9)


def test_mean_loads_are_those_of_dense_regression():
    data, rows, variance, effects = problem(5)
    found = np.empty(rows.shape[1])
    discs.mean_loads(DISCS, effects, discs.make_scratch(len(PLACE)), found)
    cross = variance[:, None] * rows.T
    expected = cross @ np.linalg.solve(np.eye(30) + rows @ cross, data)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_effects_given_discs_are_those_of_data_whitened_for_the_discs():
    data, rows, variance, effects = problem(6)
    own, scratch = np.array([2, 5, 11]), discs.make_scratch(len(PLACE))
    size = LOADS * len(own)
    cross, gram, match = np.empty((rows.shape[1], size)), np.empty((size, size)), np.empty(size)
    count = discs.whiten_by_discs(DISCS, effects, own, scratch, cross, gram, match)
    gram -= cross[:count].T @ cross[:count]
    match -= scratch.vector[:count] @ cross[:count]
    own_rows = rows[:, (LOADS * own[:, None] + np.arange(LOADS)).ravel()]
    left = np.linalg.inv(np.eye(30) + (rows * variance) @ rows.T) @ np.column_stack([own_rows, data])
    np.testing.assert_allclose(gram, own_rows.T @ left[:, :-1], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(match, own_rows.T @ left[:, -1], rtol=1e-8, atol=1e-10)


def test_the_search_finds_no_worse_discs_than_those_it_starts_from():
    _, _, _, effects = problem(7)
    scratch, found = discs.make_scratch(len(PLACE)), DISCS + 0.4
    bounds = np.array([[0.0, 0.0, -1.0, -5.0, -3.0], [2.0, 3.0, 1.3, 2.0, 1.5]])
    before = discs.evidence(found, effects, scratch) + discs.log_prior(found, 0.0)
    top = discs.climb(found, effects, 0.0, bounds, np.empty((3, *found.shape)), scratch)
    assert top == pytest.approx(discs.evidence(found, effects, scratch) + discs.log_prior(found, 0.0))
    assert top > before
    assert (found >= bounds[0]).all()
    assert (found[:, 2:] <= bounds[1, 2:]).all()


def solved(skin: Skin, moved: np.ndarray, sigma: float, seed: int, **options) -> sk.FieldFrame:
    random = np.random.default_rng(seed)
    frame = skin.resistance_ohm(moved) * (1 + sigma * random.standard_normal(skin.layout.shape))
    posterior = sk.Posterior(
        skin.layout,
        relative_noise=sigma,
        baseline_ohm=skin.rest_ohm,
        follow_noise=False,
        prior="discs",
        **options,
    )
    return posterior.update(frame)


@pytest.fixture(scope="module")
def skin() -> Skin:
    return Skin(preset("staggered", 0.5))


def test_the_covariance_is_that_of_dense_algebra_with_the_prior_of_the_discs():
    """On a small patch: posterior covariance (C⁻¹ + Jᵀ J / σ²)⁻¹ with C from the loads, both written out."""
    layout = sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=5)
    small, sigma = Skin(layout), 1e-3
    moved = np.zeros(layout.upper_m.shape)
    moved[1:3, 2, 2] = -0.2 * layout.height_m
    posterior = sk.Posterior(
        layout,
        relative_noise=sigma,
        baseline_ohm=small.rest_ohm,
        follow_noise=False,
        hold=False,
        prior="discs",
    )
    field = posterior.update(small.resistance_ohm(moved))
    prior, pitch = posterior._estimator.load_prior, layout.pitch_m
    assert len(posterior._hyper.discs.discs) == 1
    upper = layout.upper_m + field.displacement_m
    measured = layout.resistivity_ohm_per_m / small.resistance_ohm(moved)
    slope = sk.jacobian(layout, upper).reshape(*layout.shape, -1) / (measured * sigma)[..., None]
    size = layout.unknowns
    information = np.linalg.inv(prior.scale2 * prior.covariance * pitch**2)
    for wire in range(layout.shape[0]):
        own = slice(wire * size, (wire + 1) * size)
        information[own, own] += slope[wire].T @ slope[wire]
    found, expected = posterior.covariance_m2(), np.linalg.inv(information)
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.03 * np.abs(expected).max())


@pytest.mark.long
def test_discs_reduce_the_error_of_small_bodies_and_its_claim(skin):
    """Hertz's sphere, punch and ridge at a noise of 1e-3, in closed form: no load of the prior's kind."""
    samples = {prior: [] for prior in ("discs", "cells")}
    for prior, found in samples.items():
        posterior = sk.Posterior(
            skin.layout, relative_noise=1e-3, baseline_ohm=skin.rest_ohm, follow_noise=False, prior=prior
        )
        for seed in range(6):
            for family in ("sphere", "punch", "ridge"):
                scene = family_scenes.draw(family, skin, np.random.default_rng([11, seed]), depth=0.2)
                random = np.random.default_rng(seed)
                noise = 1 + 1e-3 * random.standard_normal(skin.layout.shape)
                posterior.reset()
                field = posterior.update(skin.resistance_ohm(scene.truth_m) * noise)
                case = {"family": family, "layout": ("staggered", 0.5), "sigma": 1e-3, "seconds": 0.0}
                found.append(families.sample(scene, field, converged=field.trusted, **case))
    local, cells = families.row(samples["discs"]), families.row(samples["cells"])
    assert local["converged"] == 1.0
    assert local["error"] < 0.6 * cells["error"]
    assert local["wrong"] == 0.0
    assert 0.92 < local["coverage_moved"] <= 1.0
    claims = {prior: np.sum([each.claim for each in found]) for prior, found in samples.items()}
    assert claims["discs"] < claims["cells"]


@pytest.mark.long
@pytest.mark.parametrize("family", some_long(["sphere", "punch", "ridge", "edge"], "sphere"))
def test_errors_on_a_bonded_layer_are_within_the_claim(skin, family):
    """The simulator solves the contact; its skin moves sideways and much less far than a half-space."""
    for seed in range(4):
        scene = family_scenes.draw(family, skin, np.random.default_rng([3, seed]), bonded=True)
        field = solved(skin, scene.truth_m, 1e-4, seed)
        error = np.abs(field.displacement_m - scene.truth_m)
        assert (error <= 6.0 * field.displacement_std_m).all()
        assert (error <= field.half_width_95_m).mean() > 0.8


@pytest.mark.long
@pytest.mark.parametrize(
    ("family", "number", "name"), [("ridge", 1001, "staggered"), ("two", 1019, "aligned")]
)
def test_a_small_body_on_a_thin_layer_is_found(family, number, name):
    """The simulator solves the contact. A search for loads on a half-space alone finds no such body."""
    skin = Skin(preset(name, 0.5))
    random = np.random.default_rng([number, family_scenes.FAMILIES.index(family)])
    truth = family_scenes.draw(family, skin, random, bonded=True).truth_m
    frame, _, _ = Converter(sigma=1e-3).read(skin.resistance_ohm(truth), skin.rest_ohm, random)
    posterior = sk.Posterior(
        skin.layout, relative_noise=1e-3, baseline_ohm=skin.rest_ohm, follow_noise=False, prior="discs"
    )
    field = posterior.update(frame)
    deep = truth[..., 2] < -0.25 * np.abs(truth).max()
    assert (field.displacement_m[deep, 2] < 0.25 * truth[deep, 2]).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "height"),
    some_long([("staggered", 0.5), ("aligned", 0.5), ("staggered", 1.0)], ("staggered", 0.5)),
)
def test_a_single_electrode_that_the_readings_hardly_show_is_within_the_claim(name, height):
    """At a noise of 3e-3, a body that moves one electrode by a tenth of the clearance may go unnoticed."""
    skin = Skin(preset(name, height))
    random = np.random.default_rng(8)
    for seed in range(6):
        truth = np.zeros(skin.layout.upper_m.shape)
        truth[random.integers(10), random.integers(10), 2] = -0.1 * skin.layout.height_m
        field = solved(skin, truth, 3e-3, seed)
        assert (np.abs(field.displacement_m - truth) <= 5.0 * field.displacement_std_m).all()
        assert field.displacement_std_m.max() < 0.2 * skin.layout.height_m


@pytest.mark.long
@pytest.mark.parametrize("sigma", [1e-5, 1e-3])
def test_a_deep_press_between_two_frames_is_not_taken_for_another_field(skin, sigma):
    for seed in range(4):
        random = np.random.default_rng([50, seed])
        scene = family_scenes.draw("sphere", skin, random, depth=0.5)
        field = solved(skin, scene.truth_m, sigma, seed)
        wrong = (np.abs(field.displacement_m - scene.truth_m) > 5.0 * field.displacement_std_m).any()
        assert not (wrong and field.trusted)


def test_lost_and_impossible_readings_are_not_trusted(skin):
    scene = family_scenes.draw("sphere", skin, np.random.default_rng(1), depth=0.2)
    posterior = sk.Posterior(skin.layout, relative_noise=1e-3, baseline_ohm=skin.rest_ohm, prior="discs")
    first = posterior.update(skin.resistance_ohm(scene.truth_m))
    assert first.trusted
    for lost in (np.full(skin.layout.shape, np.nan), np.zeros(skin.layout.shape)):
        field = posterior.update(lost)
        assert not field.trusted
        assert np.isinf(field.displacement_std_m).all()
    again = posterior.update(skin.resistance_ohm(scene.truth_m))
    assert again.trusted
    np.testing.assert_allclose(
        again.displacement_m, first.displacement_m, atol=3.0 * first.displacement_std_m.max()
    )


def test_a_released_patch_returns_to_rest_and_forgets_the_discs(skin):
    scene = family_scenes.draw("sphere", skin, np.random.default_rng(2), depth=0.2)
    posterior = sk.Posterior(
        skin.layout, relative_noise=1e-3, baseline_ohm=skin.rest_ohm, follow_noise=False, prior="discs"
    )
    random = np.random.default_rng(4)
    for share in (1.0, 1.0, 0.0, 0.0):
        noise = 1 + 1e-3 * random.standard_normal(skin.layout.shape)
        field = posterior.update(skin.resistance_ohm(share * scene.truth_m) * noise)
    assert not field.contacts
    assert (np.abs(field.displacement_m) <= 5.0 * field.displacement_std_m).all()


def stream_posterior(skin: Skin, sigma: float, **options) -> sk.Posterior:
    options = {"prior": "discs"} | options
    return sk.Posterior(
        skin.layout, relative_noise=sigma, baseline_ohm=skin.rest_ohm, follow_noise=False, **options
    )


def relative_error(field: sk.FieldFrame, truth: np.ndarray) -> float:
    return float(np.linalg.norm(field.displacement_m - truth) / np.linalg.norm(truth))


@pytest.mark.long
def test_discs_are_fitted_again_as_earlier_frames_reduce_the_noise_of_a_held_press(skin):
    """The truth is a sphere in closed form; the mean of n frames has the noise of one frame over √n."""
    sigma, frames, inside, count = 1e-3, 24, 0, 0
    auto, off = stream_posterior(skin, sigma, past="auto"), stream_posterior(skin, sigma)
    mean = stream_posterior(skin, sigma / np.sqrt(frames))
    errors = {"auto": [], "off": [], "mean": []}
    for seed in range(6):
        random = np.random.default_rng([21, seed])
        truth = family_scenes.draw("sphere", skin, random, depth=0.2).truth_m
        ohm = skin.resistance_ohm(truth)
        readings = ohm * (1 + sigma * random.standard_normal((frames, *ohm.shape)))
        for posterior in (auto, off, mean):
            posterior.reset()
        for reading in readings:
            held = auto.update(reading)
        errors["auto"].append(relative_error(held, truth))
        errors["off"].append(relative_error(off.update(readings[-1]), truth))
        errors["mean"].append(relative_error(mean.update(readings.mean(axis=0)), truth))
        error = np.abs(held.displacement_m - truth)
        inside += np.count_nonzero(error <= held.half_width_95_m)
        count += truth.size
        assert (error <= 5.0 * held.displacement_std_m).all()
        released = auto.update(skin.rest_ohm * (1 + sigma * random.standard_normal(ohm.shape)))
        assert (np.abs(released.displacement_m) <= 5.0 * released.displacement_std_m).all()
    assert np.mean(errors["auto"]) < 0.7 * np.mean(errors["off"])
    assert np.mean(errors["auto"]) < 1.2 * np.mean(errors["mean"])
    assert inside > 0.92 * count


@pytest.mark.long
def test_discs_are_found_while_a_press_grows_whose_first_frames_did_not_show_them(skin):
    """Flat punches in closed form, pressed slowly: from a quarter of the depth on, discs must pay."""
    sigma, frames = 1e-3, 15
    solvers = {prior: stream_posterior(skin, sigma, prior=prior, past="auto") for prior in ("discs", "cells")}
    errors = {prior: [] for prior in solvers}
    for seed in range(4):
        random = np.random.default_rng([22, seed])
        truth = family_scenes.draw("punch", skin, random, depth=0.2).truth_m
        for posterior in solvers.values():
            posterior.reset()
        for frame in range(10):
            moved = (frame + 1) / frames * truth
            ohm = skin.resistance_ohm(moved)
            reading = ohm * (1 + sigma * random.standard_normal(ohm.shape))
            for prior, posterior in solvers.items():
                error = relative_error(posterior.update(reading), moved)
                if frame > 2:
                    errors[prior].append(error)
    assert np.median(errors["discs"]) < 0.55 * np.median(errors["cells"])


def test_an_unknown_prior_is_refused(skin):
    with pytest.raises(ValueError, match="prior: got 'disc', must be one of auto, cells, discs"):
        sk.Posterior(skin.layout, prior="disc")


def test_auto_selects_discs_where_they_reduce_the_error(staggered: sk.PatchLayout) -> None:
    """At a noise of 1e-4, unless an option that the discs do not support is given."""
    rng = np.random.default_rng(3)
    moved = hertz_press(staggered, 0.2)
    exact = frame_ohm(staggered, moved)
    for noise, options, expected in (
        (1e-5, {}, "cells"),
        (1e-4, {}, "discs"),
        (1e-4, {"model_error": 0.01}, "cells"),
        (1e-4, {"scale_m": 1e-4}, "cells"),
    ):
        frame = exact * (1.0 + noise * rng.standard_normal(exact.shape))
        found, same = (
            sk.Posterior(staggered, relative_noise=noise, **options, **more).update(frame)
            for more in ({}, {"prior": expected})
        )
        np.testing.assert_array_equal(found.displacement_m, same.displacement_m)
        np.testing.assert_array_equal(found.displacement_std_m, same.displacement_std_m)
