"""Statistics of the touch test: a quadratic form in the readings for each level of gain uncertainty.

Let y = ln(R₀/R)/σ be the changes in the readings from rest, in units of their noise, after subtraction of the
estimated gains. Without a touch, y ~ N(0, V₀), where V₀ = I + H P Hᵀ includes the noise and the errors in the
gains (:mod:`skinnode.solve.detect.gain_drift`). Loads change y by B q with q ~ N(0, 1), where B is the
readings' response to loads whose displacement is almost hidden by noise. A touched frame therefore has
y ~ N(0, V₀ + B Bᵀ), and its likelihood ratio depends on

    T = yᵀ (V₀⁻¹ − (V₀ + B Bᵀ)⁻¹) y

With the eigenvectors u_i and eigenvalues μ_i of Bᵀ V₀⁻¹ B, T is the sum of the squares of z_i = (1 + μ_i)^−½
u_iᵀ Bᵀ V₀⁻¹ y. Without a touch, the z_i are independent with the variances d_i = μ_i / (1 + μ_i).

Bᵀ V₀⁻¹ y is a combination of Bᵀ y and Hᵀ y, the *features* of the frame, which do not depend on P. A
statistic is therefore a small matrix that multiplies the features. The statistics for all levels of gain
uncertainty are computed before a stream starts; switching to another statistic during a stream takes
microseconds. P is diagonal: the variance of the wires' gains is one of :data:`WIRE_VARIANCES`, and that of
the patch's gain is one of :data:`PATCH_VARIANCES`.

The odds of touch also account for other depths: at a depth c times as large, c² μ_i replaces μ_i. The log
likelihood ratio is then ½ Σ (c² μ_i / (1 + c² μ_i) z_i² / d_i − ln(1 + c² μ_i)).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.detect.gain_drift import effect_of
from skinnode.solve.posterior.load_cells import LoadCells

DEPTH: Final = 5.0
"""RMS normal displacement under the alternative hypothesis, in units of the layer height times the relative
noise. At a noise of 1e-3, this is 0.5 % of the layer height. Values from 0.25 % to 1 % work almost equally
well; with 2 % or more, the test misses more of the presses that are 2 % deep."""
SHALLOWEST: Final = 0.5
"""Minimum RMS normal displacement considered in the odds, relative to the alternative hypothesis."""
MOST_OCTAVES: Final = 24
"""Maximum number of octaves of depth considered in the odds; enough for noise down to 1e-8."""
LEAST_WEIGHT: Final = 0.02
"""Minimum weight κ² λ of the elastic prior's eigenvectors used in the test."""
MOST_VECTORS: Final = 96
"""Maximum number of the elastic prior's eigenvectors used in the test. The cost is proportional to this
number."""
WIRE_VARIANCES: Final = (*(2.0 ** np.arange(-9.0, 2.0)).tolist(), 1e6)
"""Variances of a wire's gain about the mean of its layer, in units of a reading's noise variance. The
smallest hardly affects the test; the largest leaves the gains practically unconstrained."""
PATCH_VARIANCES: Final = (*(2.0 ** np.arange(-12.0, 0.0)).tolist(), 1e6)
"""Variances of the patch's gain, in the same units as :data:`WIRE_VARIANCES`."""


@dataclass(frozen=True, eq=False)
class Statistic:
    """Statistic for one level of gain uncertainty."""

    rows: Float
    """(r, r + U + K + 1) matrix that multiplies the features (Bᵀ y, Hᵀ y) and yields z."""
    weights: Float
    """(r,) variances d of z without a touch."""
    shares: Float
    """(MOST_OCTAVES, r) c² μ / (1 + c² μ) / d for each octave of depth."""
    log_dets: Float
    """(MOST_OCTAVES,) Σ ln(1 + c² μ)."""
    by_gains: Float
    """(r, r) part of the covariance of z that is due to errors in the gains."""

    def weights_of_mean(self, frames: int) -> Float:
        """Return the weights (r,) of w ‖mean z‖² for the mean of w = ``frames`` frames.

        Noise is independent from frame to frame; the errors in the gains are the same in all frames.
        """
        covariance = np.diag(self.weights) + (frames - 1) * self.by_gains
        return np.asarray(np.maximum(np.linalg.eigvalsh(covariance), 1e-12))


class TouchBasis:
    """Features and statistics for patches of one kind.

    Args:
        layout: The patch.
        ratios: (U, K) noise of each reading divided by the median, as float64.

    Attributes:
        responses_t: (r, m) Bᵀ.
        effect: (m, U + K + 1) H, the effect of each gain on the readings.
        ratios: (U, K) noise of each reading divided by the median.
    """

    def __init__(self, layout: PatchLayout, ratios: bytes) -> None:
        self.ratios = np.frombuffer(ratios).reshape(layout.shape)
        self.responses_t = np.ascontiguousarray(_responses(layout).T / self.ratios.ravel())
        self.effect = effect_of(layout.shape, self.ratios)
        self._gram = self.responses_t @ self.responses_t.T
        self._crossed = self.responses_t @ self.effect
        self._squares = self.effect.T @ self.effect
        self._statistics: dict[tuple[int, int], Statistic] = {}

    @classmethod
    def of(cls, layout: PatchLayout, ratios: bytes) -> TouchBasis:
        """Return the cached basis of a patch; see :class:`TouchBasis`."""
        return _basis(layout, ratios)

    def features(self, y: Float) -> Float:
        """Return the features (r + U + K + 1,) of the changes ``y`` (U, K)."""
        return np.concatenate([self.responses_t @ y.ravel(), self.effect.T @ y.ravel()])

    def statistic(self, wires: int, patch: int) -> Statistic:
        """Return the statistic for two levels of the gains' variances, computed on first use.

        Args:
            wires: Index in :data:`WIRE_VARIANCES`.
            patch: Index in :data:`PATCH_VARIANCES`.
        """
        found = self._statistics.get((wires, patch))
        if found is None:
            found = self._statistics[wires, patch] = self._compute(
                WIRE_VARIANCES[wires], PATCH_VARIANCES[patch]
            )
        return found

    def _compute(self, wires: float, patch: float) -> Statistic:
        variances = np.full(len(self._squares), wires)
        variances[-1] = patch
        # V₀⁻¹ x = x − H (P⁻¹ + Hᵀ H)⁻¹ Hᵀ x
        inner = self._crossed @ np.linalg.inv(np.diag(1.0 / variances) + self._squares)
        values, vectors = np.linalg.eigh(self._gram - inner @ self._crossed.T)
        values = np.maximum(values, 1e-12)
        turn = (vectors / np.sqrt(1.0 + values)).T
        rows = np.ascontiguousarray(np.hstack([turn, -turn @ inner]))
        weights = values / (1.0 + values)
        seen = rows @ np.vstack([self._crossed, self._squares])
        deeper = (SHALLOWEST * 2.0 ** np.arange(MOST_OCTAVES)[:, None]) ** 2 * values
        return Statistic(
            rows=rows,
            weights=weights,
            shares=deeper / (1.0 + deeper) / weights,
            log_dets=np.log1p(deeper).sum(axis=1),
            by_gains=(seen * variances) @ seen.T,
        )


@functools.lru_cache(maxsize=8)
def _basis(layout: PatchLayout, ratios: bytes) -> TouchBasis:
    return TouchBasis(layout, ratios)


@functools.lru_cache(maxsize=8)
def _responses(layout: PatchLayout) -> Float:
    """Return B (m, r) for readings with equal noise."""
    model = ReadingModel.of(layout)
    at_kappa = float(model.kappa[len(model.kappa) // 2])
    values = np.maximum(1.0 / model.shrink[len(model.kappa) // 2] - 1.0, 0.0) / at_kappa**2
    best = np.argsort(values)[::-1][:MOST_VECTORS]
    kappa = DEPTH * LoadCells.of(layout).height_m / layout.pitch_m  # depth divided by the noise, in pitches
    share = kappa * np.sqrt(values[best])
    kept = share**2 > min(LEAST_WEIGHT, 0.5 * float(share.max()) ** 2)
    return np.asarray((model.vectors_t[best].T)[:, kept] * share[kept])
