"""The statistic of the touch test against dense linear algebra and a simulation of its false alarms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.detect.touch_test import (
    DEPTH,
    SHALLOWEST,
    PatchNoise,
    filter_of,
    log_likelihood_ratio,
    touch_test,
)

NOISE = 1e-3
LAYOUT = sk.PatchLayout.preset(
    "staggered", upper_wires=5, upper_electrodes=5, lower_wires=15, lower_electrodes=5
)


def patch_of(rate: float = 0.1, noise: np.ndarray | None = None) -> PatchNoise:
    sigma = np.full(LAYOUT.shape, NOISE) if noise is None else noise
    return PatchNoise(LAYOUT, sigma.tobytes(), 0.0, 0.08, rate, 4)


def covariances(patch: PatchNoise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """V₀ and the response covariance at the test's depth, dense, and the noise (m,)."""
    sigma = patch.noise.ravel()
    unit = np.median(sigma)
    test = touch_test(patch, 0.01, 0.02, 0.64)
    upper, lower = LAYOUT.shape
    effect = np.zeros((upper * lower, upper + lower + 1))
    for u in range(upper):
        for k in range(lower):
            effect[u * lower + k, [u, upper + k, -1]] = unit / sigma[u * lower + k]
    v0 = np.eye(sigma.size) + effect @ test.covariance @ effect.T
    response = ReadingModel.of(LAYOUT).response * (unit / sigma)[:, None]
    height = LAYOUT.height_m / LAYOUT.pitch_m
    return v0, (DEPTH * height) ** 2 * response @ response.T, sigma


@pytest.mark.parametrize("several", [False, True], ids=["equal noise", "several noise levels"])
def test_the_statistic_is_the_quadratic_form_of_the_two_hypotheses(several: bool) -> None:
    rng = np.random.default_rng(2)
    noise = np.full(LAYOUT.shape, NOISE)
    if several:
        noise = noise * np.exp(rng.uniform(-0.3, 0.3, noise.shape))
    patch = patch_of(noise=noise)
    test = touch_test(patch, 0.01, 0.02, 0.64)
    v0, loads, _ = covariances(patch)
    for scale in (1.0, 5.0):
        y = scale * rng.standard_normal(v0.shape[0])
        exact = y @ (np.linalg.inv(v0) - np.linalg.inv(v0 + loads)) @ y
        # the test leaves out the weakest responses to loads
        assert float(((test.rows @ y) ** 2).sum()) == pytest.approx(exact, rel=0.05)


def test_without_a_touch_the_statistic_has_the_stated_weights() -> None:
    patch = patch_of()
    test = touch_test(patch, 0.01, 0.02, 0.64)
    v0, _, _ = covariances(patch)
    np.testing.assert_allclose(test.rows @ v0 @ test.rows.T, np.diag(test.weights), atol=1e-9)


def test_the_likelihood_ratio_is_that_of_normal_densities() -> None:
    """Averaged over the octaves of depth, each with its own covariance.

    For larger changes, the weakest responses, which the test leaves out, would also say something.
    """
    patch = patch_of()
    test = touch_test(patch, 0.01, 0.02, 0.64)
    v0, loads, _ = covariances(patch)
    rng = np.random.default_rng(3)
    octaves = len(test.log_dets)
    for scale in (0.5, 1.0):
        y = scale * rng.multivariate_normal(np.zeros(len(v0)), v0 + loads)
        untouched = multivariate_normal(np.zeros(len(v0)), v0).logpdf(y)
        touched = [
            multivariate_normal(np.zeros(len(v0)), v0 + (SHALLOWEST * 2.0**j) ** 2 * loads).logpdf(y)
            for j in range(octaves)
        ]
        exact = np.logaddexp.reduce(touched) - np.log(octaves) - untouched
        assert log_likelihood_ratio(test, test.rows @ y) == pytest.approx(exact, abs=1.0 + 0.02 * abs(exact))


def test_false_alarms_in_a_hundred_patch_hours_agree_with_the_stated_rate() -> None:
    """Simulated in the space of the statistic, at 20 alarms an hour: 2,000 are expected at most."""
    rate, hours = 20.0, 100.0
    test = touch_test(patch_of(rate), 0.01 / 64, 0.01 / 64, 0.64)
    rng = np.random.default_rng(4)
    frames = round(hours * 45_000)
    alarms, last = 0, np.zeros((2, test.weights.size))
    scale = np.sqrt(test.weights)
    for _ in range(frames // 50_000):
        z = np.concatenate([last, scale * rng.standard_normal((50_000, scale.size))])
        one = (z[2:] ** 2).sum(axis=1) > test.onset[0]
        three = ((z[2:] + z[1:-1] + z[:-2]) ** 2).sum(axis=1) / 3.0 > test.onset[1]
        above = one | three
        # alarms within four frames of each other are one touch
        recent = above.copy()
        for back in range(1, 5):
            recent[back:] |= above[:-back]
        alarms += int(np.count_nonzero(above[1:] & ~recent[:-1]))
        last = z[-2:]
    assert 0.4 * rate * hours < alarms < 1.1 * rate * hours


def test_gains_that_drift_longer_are_known_less_well() -> None:
    patch = patch_of()
    gains = filter_of(patch, 0.01, 0.02)
    variances = [
        np.diag(gains.effect @ gains.after(s) @ gains.effect.T).mean() for s in (0.0, 1.0, 60.0, 3600.0)
    ]
    assert np.all(np.diff(variances) > 0)
    # an hour: 1 % each of an upper and a lower wire and 2 % of the patch, each as walk and as steady drift
    assert variances[-1] - variances[0] == pytest.approx(
        2 * (0.01**2 + 0.01**2 + 0.02**2) / NOISE**2, rel=0.01
    )
