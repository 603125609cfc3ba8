"""Gain drift of a patch: its prior, and the Kalman filter that tracks the gains.

The logarithm of each reading contains three gains: those of its upper wire, its lower wire and the patch. The
patch's gain changes with temperature. Each gain follows a random walk. The filter estimates the gains from
blocks of untouched frames, so its error is the error after the last block plus the drift since then. Over
minutes, a steady drift at an unknown rate dominates the random walk, because the variance of the drift grows
with the square of time.

A change common to all upper wires looks like a change common to all lower wires, or like a change in the
patch's gain. The filter therefore uses coordinates v in which every change is visible: the readings change by
Q v, and the columns of Q are orthonormal. All variances are in units of a reading's noise variance.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float

DRIFT: Final = 0.01
"""Standard deviation of the change in a wire's gain over one hour. It applies to the steady drift, and to the
random walk until the drift of the stream has been measured."""
PATCH_DRIFT: Final = 0.02
"""Standard deviation of the change in the patch's gain over one hour, used like :data:`DRIFT`. The skin's
temperature changes faster than its wires age."""
MEASURED_S: Final = 2.0
"""Interval over which a stream's random walk is measured, in s. Over this interval, the measured random walk
includes any steady drift."""
_VISIBLE: Final = 1e-9
"""Minimum singular value of a visible combination of gains, relative to the largest."""


@dataclass(frozen=True)
class Growth:
    """Growth of the gains' variances with time, in units of the readings' noise variance."""

    drift: float
    """Standard deviation of the random walk of a wire's gain after one hour, divided by the noise."""
    patch_drift: float
    """Standard deviation of the random walk of the patch's gain after one hour, divided by the noise."""
    steady: float
    """Standard deviation of a wire's steady drift after one hour, divided by the noise."""
    patch_steady: float
    """Standard deviation of the patch's steady drift after one hour, divided by the noise."""

    def after(self, seconds: float) -> tuple[float, float]:
        """Return the growth in variance of a wire's gain and of the patch's gain over ``seconds`` s."""
        hours, steady_h = seconds / 3600.0, max(seconds - MEASURED_S, 0.0) / 3600.0
        return (
            hours * self.drift**2 + (steady_h * self.steady) ** 2,
            hours * self.patch_drift**2 + (steady_h * self.patch_steady) ** 2,
        )


@dataclass(frozen=True, eq=False)
class GainFilter:
    """Constants of the Kalman filter for the gains of one kind of patch.

    The filter uses V = U + K − 1 visible coordinates v.
    :mod:`skinnode.solve.detect.gain_kernel` contains the filter.
    """

    effect: Float
    """(m, U + K + 1) effect of each gain (upper wires, lower wires, patch) on the m = U K readings."""
    basis_t: Float
    """(V, m) matrix Qᵀ with orthonormal rows."""
    to_gains: Float
    """(U + K + 1, V) matrix that converts v to gains. A combination of gains that affects no reading is
    zero."""
    by_wires: Float
    """(V, V) covariance of v if the gains of all wires have a variance of 1."""
    by_patch: Float
    """(V, V) covariance of v if the gain of the patch has a variance of 1."""
    of_uppers: Float
    """(V, V) matrix whose element-wise product with the covariance of v, summed over all elements, is the
    variance of an upper wire's gain about the mean of the upper wires."""
    of_lowers: Float
    """(V, V) matrix like ``of_uppers``, but for the lower wires."""
    of_mean: Float
    """(V,) coefficients of the mean change in all readings."""

    @classmethod
    def of(cls, shape: tuple[int, int], ratios: bytes) -> GainFilter:
        """Return the cached filter of a patch.

        Args:
            shape: Numbers U and K of upper and lower wires.
            ratios: (U, K) noise of each reading divided by the median, as float64.
        """
        return _filter(shape, ratios)

    def start(self, variances: Float) -> Float:
        """Return the covariance (V, V) of v for independent gains with the given ``variances``."""
        seen = self.basis_t @ self.effect
        return np.asarray((seen * variances) @ seen.T)


def effect_of(shape: tuple[int, int], ratios: Float) -> Float:
    """Return the effect (m, U + K + 1) of the gains on the readings, in units of the median noise.

    Args:
        shape: Numbers U and K of upper and lower wires.
        ratios: (U, K) noise of each reading divided by the median.
    """
    upper, lower = shape
    effect = np.zeros((upper, lower, upper + lower + 1))
    effect[np.arange(upper), :, np.arange(upper)] = 1.0
    effect[:, np.arange(lower), upper + np.arange(lower)] = 1.0
    effect[..., -1] = 1.0
    return np.ascontiguousarray((effect / ratios[..., None]).reshape(upper * lower, -1))


@functools.lru_cache(maxsize=8)
def _filter(shape: tuple[int, int], ratios: bytes) -> GainFilter:
    upper, lower = shape
    effect = effect_of(shape, np.frombuffer(ratios).reshape(shape))
    basis, singular, turn = np.linalg.svd(effect, full_matrices=False)
    seen = singular > _VISIBLE * singular[0]
    basis_t, to_v = np.ascontiguousarray(basis[:, seen].T), singular[seen, None] * turn[seen]
    to_gains = np.ascontiguousarray(turn[seen].T / singular[seen])
    wires = to_v[:, :-1]
    mean = np.concatenate([np.full(upper, 1.0 / upper), np.full(lower, 1.0 / lower), [1.0]])

    def contrast(first: int, count: int) -> Float:
        rows = to_gains[first : first + count]
        rows = rows - rows.mean(axis=0)
        return np.ascontiguousarray(rows.T @ rows / max(count - 1, 1))

    return GainFilter(
        effect=effect,
        basis_t=basis_t,
        to_gains=to_gains,
        by_wires=np.ascontiguousarray(wires @ wires.T),
        by_patch=np.outer(to_v[:, -1], to_v[:, -1]),
        of_uppers=contrast(0, upper),
        of_lowers=contrast(upper, lower),
        of_mean=np.ascontiguousarray(to_gains.T @ mean),
    )
