"""Touch test of a frame: a quadratic form of the readings, with thresholds from its own distribution.

Let y = ln(R₀/R)/σ be the changes of the readings from rest, in units of their noise, after subtraction of
the estimated gains. Without a touch, y ~ N(0, V₀), where V₀ = I + H P Hᵀ includes the noise and the errors
of the gains (:mod:`skinnode.solve.detect.gain_drift`). Loads change y by B q with q ~ N(0, 1), where B is the
readings' response to loads at a depth that noise almost hides. A touched frame therefore has
y ~ N(0, V₀ + B Bᵀ), and its likelihood ratio depends on

    T = yᵀ (V₀⁻¹ − (V₀ + B Bᵀ)⁻¹) y

With the eigenvectors u_i and eigenvalues μ_i of Bᵀ V₀⁻¹ B, T is the sum of the squares of z = G y; the rows
of G are g_i = (1 + μ_i)^−½ V₀⁻¹ B u_i. Without a touch, the z_i are independent with the variances d_i =
μ_i / (1 + μ_i), so T has the distribution of :mod:`skinnode.solve.detect.weighted_chi_squared`.

The odds of touch allow for depths c times as large, for which c² μ_i replaces μ_i. The log likelihood ratio
is then ½ Σ (c² μ_i / (1 + c² μ_i) z_i² / d_i − ln(1 + c² μ_i)). All octaves of c are equally likely.

In the mean of w successive frames, the squared signal-to-noise ratio of a touch is w times that of one frame,
because noise is independent from frame to frame. The errors of the gains are not independent, so the mean has
its own distribution and threshold.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.detect.gain_drift import GainFilter, gain_filter
from skinnode.solve.detect.weighted_chi_squared import upper_quantile
from skinnode.solve.posterior.load_cells import LoadCells

DEPTH: Final = 5.0
"""RMS normal displacement in the alternative hypothesis, in layer heights times the relative noise. At a
noise of 1e-3, this is 0.5 % of the layer height. Tests for 0.25 % to 1 % detect touches almost equally well;
tests for 2 % and more detect fewer presses of 2 %."""
DEEPEST: Final = 0.16
"""Maximum RMS normal displacement in the odds, layer heights."""
SHALLOWEST: Final = 0.5
"""Minimum RMS normal displacement in the odds, relative to that in the alternative hypothesis."""
LEAST_WEIGHT: Final = 0.02
"""Minimum weight κ² λ of an eigenvector of the elastic prior in the test."""
MOST_VECTORS: Final = 96
"""Maximum number of eigenvectors of the elastic prior in the test. The cost is proportional to it."""
WINDOWS: Final = (1, 3)
"""Numbers of frames in the means that are tested for the onset of a touch."""
RELEASE_FRAMES: Final = 4
"""Number of frames in the mean that is tested for the release of a touch."""
RELEASE_CHANCE: Final = 0.01
"""Probability that noise alone delays the release of a touch by one frame."""
CHANGE_CHANCE: Final = 1e-6
"""Probability per frame that noise alone looks like a change in a held touch."""
DOUBT_CHANCE: Final = 0.003
"""Probability that noise alone opens the gate for a frame."""


@dataclass(frozen=True, eq=False)
class TouchTest:
    """Touch test for one patch, one noise and one covariance of the gains."""

    rows: Float
    """(r, m) matrix G, which multiplies the changes of the readings."""
    weights: Float
    """(r,) variances d of z = G y without a touch."""
    shares: Float
    """(S, r) c² μ / (1 + c² μ) / d for the S octaves of depth."""
    log_dets: Float
    """(S,) Σ ln(1 + c² μ), plus 2 ln S."""
    onset: tuple[float, ...]
    """Thresholds of w ‖mean z‖² for the windows w in :data:`WINDOWS`."""
    doubt: tuple[float, ...]
    """Thresholds of w ‖mean z‖² above which a frame is solved even if no touch is reported."""
    change: float
    """Threshold of ‖z‖², relative to its noise variance, above which a touch has changed."""
    release: float
    """Threshold of w ‖mean z‖² for w = :data:`RELEASE_FRAMES`, below which a touch ends."""
    covariance: Float
    """(U + K + 1, U + K + 1) covariance of the gains for which the test was computed."""


@dataclass(frozen=True)
class PatchNoise:
    """All inputs of a patch's tests, except the errors of the gains."""

    layout: PatchLayout
    sigma: bytes
    """(U, K) relative noise of the readings, as float64."""
    coded: float
    """Fraction of the noise variance that is the same in successive frames: the quantization error, if the
    noise is below half a code."""
    period_s: float
    """Scan period, s."""
    false_alarms_per_hour: float
    """Accepted false alarms per hour."""
    block: int
    """Number of frames in a block of the gain filter."""

    @property
    def noise(self) -> Float:
        """(U, K) relative noise of the readings."""
        return np.frombuffer(self.sigma).reshape(self.layout.shape)


@functools.lru_cache(maxsize=128)
def filter_of(key: PatchNoise, drift: float, patch_drift: float) -> GainFilter:
    """Return the gain filter for the drifts of the wires and the patch, from a cache if possible.

    Both drifts are standard deviations of the change in one hour.
    """
    return gain_filter(key.noise, drift, patch_drift, key.block, key.block * key.period_s)


@functools.lru_cache(maxsize=64)
def touch_test(key: PatchNoise, drift: float, patch_drift: float, seconds: float) -> TouchTest:
    """Return the test for gains that were last estimated ``seconds`` ago, from a cache if possible.

    Computing a new test for the reference patch takes about 10 ms.

    Args:
        key: Patch, noise and accepted false alarms.
        drift: Standard deviation of the change in a wire's gain in one hour.
        patch_drift: Standard deviation of the change in the patch's gain in one hour.
        seconds: Time since the newest frame used to estimate the gains, s.
    """
    gains, sigma = filter_of(key, drift, patch_drift), key.noise.ravel()
    covariance = gains.after(seconds)
    b = _responses(key.layout) * (np.median(sigma) / sigma)[:, None]
    effect = gains.effect
    # V₀⁻¹ x = x − H (P⁻¹ + Hᵀ H)⁻¹ Hᵀ x
    inner = np.linalg.inv(np.linalg.inv(covariance) + effect.T @ effect)
    whitened = b - effect @ (inner @ (effect.T @ b))
    values, vectors = np.linalg.eigh(b.T @ whitened)
    values = np.maximum(values, 1e-12)
    rows = (whitened @ vectors / np.sqrt(1.0 + values)).T
    weights = values / (1.0 + values)
    by_gains = rows @ effect
    by_gains = np.asarray(by_gains @ covariance @ by_gains.T)
    noise = np.diag(weights) - by_gains

    def weights_of(window: int) -> Float:
        if window == 1:
            return np.asarray(weights)
        share = key.coded * (window - 1) + 1.0
        return np.asarray(np.maximum(np.linalg.eigvalsh(share * noise + window * by_gains), 1e-12))

    octaves = np.arange(0.0, max(math.log2(DEEPEST / (DEPTH * np.median(sigma) * SHALLOWEST)), 0.0) + 1.0)
    deeper = (SHALLOWEST * 2.0 ** octaves[:, None]) ** 2 * values
    of_windows = [weights_of(window) for window in WINDOWS]
    frames_per_alarm = 3600.0 / (key.period_s * key.false_alarms_per_hour)
    chance = 1.0 / (frames_per_alarm * len(WINDOWS))
    return TouchTest(
        rows=np.ascontiguousarray(rows),
        weights=weights,
        shares=deeper / (1.0 + deeper) / weights,
        log_dets=np.log1p(deeper).sum(axis=1) + 2.0 * math.log(len(deeper)),
        onset=tuple(upper_quantile(each, min(chance, 0.1)) for each in of_windows),
        doubt=tuple(upper_quantile(each, DOUBT_CHANCE) for each in of_windows),
        change=upper_quantile(weights, CHANGE_CHANCE),
        release=upper_quantile(weights_of(RELEASE_FRAMES), RELEASE_CHANCE),
        covariance=covariance,
    )


@functools.lru_cache(maxsize=8)
def _vectors(layout: PatchLayout) -> tuple[Float, Float]:
    """Return the eigenvectors (m, r) of J C Jᵀ with the largest eigenvalues, and these eigenvalues (r,)."""
    model = ReadingModel.of(layout)
    kappa = float(model.kappa[len(model.kappa) // 2])
    values = np.maximum(1.0 / model.shrink[len(model.kappa) // 2] - 1.0, 0.0) / kappa**2
    best = np.argsort(values)[::-1][:MOST_VECTORS]
    return model.vectors_t[best].T, values[best]


@functools.lru_cache(maxsize=8)
def _responses(layout: PatchLayout) -> Float:
    """Return B (m, r) for readings with equal noise."""
    vectors, values = _vectors(layout)
    kappa = DEPTH * LoadCells.of(layout).height_m / layout.pitch_m  # depth divided by the noise, pitches
    share = kappa * np.sqrt(values)
    kept = share**2 > min(LEAST_WEIGHT, 0.5 * float(share.max()) ** 2)
    return np.asarray(vectors[:, kept] * share[kept])


def log_likelihood_ratio(test: TouchTest, z: Float) -> float:
    """Return the log likelihood ratio of touch to no touch for a frame with z = G y (r,)."""
    terms = 0.5 * (test.shares @ (z * z) - test.log_dets)
    most = float(terms.max())
    return most + math.log(float(np.exp(terms - most).sum()))


def bounded_exp(value: float) -> float:
    """Return exp(value), or inf on overflow."""
    return math.exp(value) if value < 700.0 else math.inf
