"""The statistic of the touch test against dense linear algebra and a simulation of its false alarms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.detect.gain_drift import GainFilter, Growth
from skinnode.solve.detect.gain_kernel import gain_arrays, use_block
from skinnode.solve.detect.touch_odds import log_likelihood_ratio
from skinnode.solve.detect.touch_statistic import (
    DEPTH,
    PATCH_VARIANCES,
    SHALLOWEST,
    WIRE_VARIANCES,
    TouchBasis,
)
from skinnode.solve.detect.touch_test import TouchTests, touch_tests
from skinnode.solve.detect.weighted_chi_squared import upper_quantile

NOISE = 1e-3
LAYOUT = sk.PatchLayout.preset(
    "staggered", upper_wires=5, upper_electrodes=5, lower_wires=15, lower_electrodes=5
)


WIRES, PATCH = 4, 5  # levels of the gains' variances


def made_tests(rate: float = 0.1, ratios: np.ndarray | None = None, coded: float = 0.0) -> TouchTests:
    ratios = np.ones(LAYOUT.shape) if ratios is None else ratios
    return touch_tests(LAYOUT, ratios.tobytes(), coded, 0.08, rate)


def covariances(ratios: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dense covariances of noise, of the gains and of loads at the test's depth."""
    upper, lower = LAYOUT.shape
    effect = np.zeros((upper * lower, upper + lower + 1))
    for u in range(upper):
        for k in range(lower):
            effect[u * lower + k, [u, upper + k, -1]] = 1.0 / ratios[u, k]
    variances = np.append(np.full(upper + lower, WIRE_VARIANCES[WIRES]), PATCH_VARIANCES[PATCH])
    response = ReadingModel.of(LAYOUT).response / ratios.reshape(-1, 1)
    height = LAYOUT.height_m / LAYOUT.pitch_m
    return (
        np.eye(upper * lower),
        (effect * variances) @ effect.T,
        (DEPTH * height) ** 2 * response @ response.T,
    )


def z_of(basis: TouchBasis, y: np.ndarray) -> np.ndarray:
    return basis.statistic(WIRES, PATCH).rows @ basis.features(y)


@pytest.mark.parametrize("several", [False, True], ids=["equal noise", "several noise levels"])
def test_the_statistic_is_the_quadratic_form_of_the_two_hypotheses(several: bool) -> None:
    rng = np.random.default_rng(2)
    ratios = np.exp(rng.uniform(-0.3, 0.3, LAYOUT.shape)) if several else np.ones(LAYOUT.shape)
    basis = TouchBasis.of(LAYOUT, ratios.tobytes())
    noise, gains, loads = covariances(ratios)
    v0 = noise + gains
    for scale in (1.0, 5.0):
        y = scale * rng.standard_normal(v0.shape[0])
        exact = y @ (np.linalg.inv(v0) - np.linalg.inv(v0 + loads)) @ y
        # the test leaves out the weakest responses to loads
        assert float((z_of(basis, y) ** 2).sum()) == pytest.approx(exact, rel=0.05)


@pytest.mark.parametrize("frames", [1, 3])
def test_without_a_touch_the_statistic_of_a_mean_has_the_stated_weights(frames: int) -> None:
    basis = TouchBasis.of(LAYOUT, np.ones(LAYOUT.shape).tobytes())
    noise, gains, _ = covariances(basis.ratios)
    map_z = np.array([z_of(basis, each) for each in np.eye(noise.shape[0])]).T
    exact = np.linalg.eigvalsh(map_z @ (noise + frames * gains) @ map_z.T)
    np.testing.assert_allclose(
        np.sort(basis.statistic(WIRES, PATCH).weights_of_mean(frames)), exact, atol=1e-9
    )


@pytest.mark.parametrize("coded", [0.3, 0.7])
def test_noise_that_is_partly_the_same_in_all_frames_raises_the_thresholds_enough(coded: float) -> None:
    """The thresholds are interpolated, and at most 5 % larger than exact ones."""
    basis = TouchBasis.of(LAYOUT, np.ones(LAYOUT.shape).tobytes())
    noise, gains, _ = covariances(basis.ratios)
    map_z = np.array([z_of(basis, each) for each in np.eye(noise.shape[0])]).T
    mean = map_z @ ((1.0 + 2.0 * coded) * noise + 3.0 * gains) @ map_z.T
    exact = upper_quantile(np.linalg.eigvalsh(mean), 0.08 * 0.1 / 3600.0 / 2.0)
    found = made_tests(coded=coded).test(WIRES, PATCH).thresholds.onset[1]
    assert exact <= found <= 1.05 * exact


def test_the_likelihood_ratio_is_that_of_normal_densities() -> None:
    """Averaged over the octaves of depth, each with its own covariance.

    For larger changes, the weakest responses, which the test leaves out, would also say something.
    """
    basis = TouchBasis.of(LAYOUT, np.ones(LAYOUT.shape).tobytes())
    noise, gains, loads = covariances(basis.ratios)
    v0, octaves = noise + gains, 7
    rng = np.random.default_rng(3)
    for scale in (0.5, 1.0):
        y = scale * rng.multivariate_normal(np.zeros(len(v0)), v0 + loads)
        untouched = multivariate_normal(np.zeros(len(v0)), v0).logpdf(y)
        touched = [
            multivariate_normal(np.zeros(len(v0)), v0 + (SHALLOWEST * 2.0**j) ** 2 * loads).logpdf(y)
            for j in range(octaves)
        ]
        exact = np.logaddexp.reduce(touched) - np.log(octaves) - untouched
        found = log_likelihood_ratio(basis.statistic(WIRES, PATCH), octaves, z_of(basis, y))
        assert found == pytest.approx(exact, abs=1.0 + 0.02 * abs(exact))


@pytest.mark.long
def test_false_alarms_in_a_hundred_patch_hours_agree_with_the_stated_rate() -> None:
    """Simulated in the space of the statistic, at 20 alarms an hour: 2,000 are expected at most."""
    rate, hours = 20.0, 100.0
    test = made_tests(rate).test(0, 0)
    weights, limits = test.statistic.weights, test.thresholds.onset
    rng = np.random.default_rng(4)
    frames = round(hours * 45_000)
    alarms, last = 0, np.zeros((2, weights.size))
    scale = np.sqrt(weights)
    for _ in range(frames // 50_000):
        z = np.concatenate([last, scale * rng.standard_normal((50_000, scale.size))])
        one = (z[2:] ** 2).sum(axis=1) > limits[0]
        three = ((z[2:] + z[1:-1] + z[:-2]) ** 2).sum(axis=1) / 3.0 > limits[1]
        above = one | three
        # alarms within four frames of each other are one touch
        recent = above.copy()
        for back in range(1, 5):
            recent[back:] |= above[:-back]
        alarms += int(np.count_nonzero(above[1:] & ~recent[:-1]))
        last = z[-2:]
    assert 0.4 * rate * hours < alarms < 1.1 * rate * hours


def test_gains_that_drift_longer_are_known_less_well() -> None:
    gains = GainFilter.of(LAYOUT.shape, np.ones(LAYOUT.shape).tobytes())
    growth = Growth(10.0, 20.0, 10.0, 20.0)  # 1 % and 2 % of noise 1e-3

    def variance(seconds: float) -> float:
        wires, patch = growth.after(seconds)
        covariance = wires * gains.by_wires + patch * gains.by_patch
        return float(np.diag(gains.basis_t.T @ covariance @ gains.basis_t).mean())

    variances = [variance(seconds) for seconds in (0.0, 1.0, 60.0, 3600.0)]
    assert np.all(np.diff(variances) > 0)
    # an hour: 1 % each of an upper and a lower wire and 2 % of the patch, each as walk and as steady drift
    assert variances[-1] == pytest.approx(2 * (0.01**2 + 0.01**2 + 0.02**2) / NOISE**2, rel=0.01)


@pytest.mark.parametrize("several", [False, True], ids=["equal noise", "several noise levels"])
def test_the_gain_filter_is_the_kalman_filter_of_all_gains(several: bool) -> None:
    """Against the covariance form in all U + K + 1 gains, of which two combinations are invisible."""
    rng = np.random.default_rng(5)
    ratios = np.exp(rng.uniform(-0.3, 0.3, LAYOUT.shape)) if several else np.ones(LAYOUT.shape)
    gains, frames = GainFilter.of(LAYOUT.shape, ratios.tobytes()), 4
    prior = np.append(np.full(sum(LAYOUT.shape), 0.3), 0.8)
    effect, y = gains.effect, rng.standard_normal(ratios.size)
    innovation = effect @ np.diag(prior) @ effect.T + np.eye(ratios.size) / frames
    kalman = np.diag(prior) @ effect.T @ np.linalg.inv(innovation)
    after = np.diag(prior) - kalman @ effect @ np.diag(prior)

    its = gain_arrays(gains)
    its.mean[:], its.covariance[:] = y, gains.start(prior)
    use_block(its.table, 0.0, 0.0, frames, 0.0)
    np.testing.assert_allclose(its.expected, effect @ kalman @ y, atol=1e-12)
    np.testing.assert_allclose(effect @ (gains.to_gains @ its.v), effect @ kalman @ y, atol=1e-12)
    np.testing.assert_allclose(
        gains.basis_t.T @ its.covariance @ gains.basis_t, effect @ after @ effect.T, atol=1e-12
    )
    upper, lower = LAYOUT.shape
    contrasts = [
        np.trace(block) / (count - 1) - block.sum() / (count * (count - 1))
        for block, count in ((after[:upper, :upper], upper), (after[upper:-1, upper:-1], lower))
    ]
    mean = np.concatenate([np.full(upper, 1 / upper), np.full(lower, 1 / lower), [1.0]])
    np.testing.assert_allclose(its.variances, [max(contrasts), mean @ after @ mean], atol=1e-12)
