"""Gain drift of a patch: its prior, and the steady-state Kalman filter that tracks the gains.

The logarithm of each reading contains three gains: those of its upper wire, its lower wire and the patch. The
patch's gain changes with temperature. Each gain is a random walk. The filter estimates the gains from blocks
of untouched frames, so its error is the steady-state error plus the drift since the last block. Over minutes,
a steady drift at an unknown rate dominates the random walk, because its variance grows with the square of
time. All variances are in units of a reading's noise variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float

DRIFT: Final = 0.01
"""Standard deviation of the change in a wire's gain in one hour. It applies to the steady drift, and to the
random walk until the drift of the stream has been measured."""
PATCH_DRIFT: Final = 0.02
"""Standard deviation of the change in the patch's gain in one hour, used like :data:`DRIFT`. The skin's
temperature changes faster than its wires age."""
MEASURED_S: Final = 2.0
"""Interval over which a stream's random walk is measured, s. Over this interval, the measured random walk
includes any steady drift."""
_SETTLED: Final = 1e-4
"""Relative change in the readings' variance from block to block at which the recursion counts as steady."""
_ROUNDS: Final = 2000
"""Maximum number of blocks in the recursion. The slowest drift needs 300."""


@dataclass(frozen=True, eq=False)
class GainFilter:
    """Kalman filter for the gains, with U + K + 1 states: upper wires, lower wires and patch."""

    effect: Float
    """(m, U + K + 1) effect of each gain on the m = U K readings, in units of their noise."""
    walk: Float
    """(U + K + 1,) growth of each gain's random-walk variance per second."""
    rate: Float
    """(U + K + 1,) variance of each gain's steady drift in one second."""
    steady: Float
    """(U + K + 1, U + K + 1) steady-state covariance after each block."""
    frames: int
    """Number of frames in a block."""

    def correction(self, covariance: Float) -> tuple[Float, Float]:
        """Return the Kalman gain (states, m) for a block mean, and the covariance after the update.

        Args:
            covariance: Covariance of the gains before the update.
        """
        measured = self.effect.T @ self.effect * self.frames
        after = np.linalg.inv(np.linalg.inv(covariance) + measured)
        return np.asarray(after @ self.effect.T * self.frames), np.asarray(after)

    def after(self, seconds: float) -> Float:
        """Return the gains' covariance ``seconds`` after the last block, in the steady state."""
        return np.asarray(self.steady + np.diag(self.growth(seconds)))

    def growth(self, seconds: float) -> Float:
        """Return the growth (U + K + 1,) of each gain's variance in ``seconds``."""
        steady_s = max(seconds - MEASURED_S, 0.0)
        return np.asarray(seconds * self.walk + steady_s**2 * self.rate)


def gain_filter(sigma: Float, drift: float, patch_drift: float, frames: int, block_s: float) -> GainFilter:
    """Return the filter for one patch.

    Args:
        sigma: (U, K) relative noise of the readings.
        drift: Standard deviation of the change in a wire's gain in one hour.
        patch_drift: Standard deviation of the change in the patch's gain in one hour.
        frames: Number of frames in a block.
        block_s: Duration of a block, s.
    """
    upper, lower = sigma.shape
    effect = np.zeros((upper, lower, upper + lower + 1))
    effect[np.arange(upper), :, np.arange(upper)] = 1.0
    effect[:, np.arange(lower), upper + np.arange(lower)] = 1.0
    effect[..., -1] = 1.0
    unit = float(np.median(sigma))
    effect = (effect * (unit / sigma)[..., None]).reshape(sigma.size, -1)
    walk = np.full(upper + lower + 1, (drift / unit) ** 2 / 3600.0)
    walk[-1] = (patch_drift / unit) ** 2 / 3600.0
    covariance, measured = np.diag(walk * 60.0), effect.T @ effect * frames
    visible = 0.0  # gains common to all upper or to all lower wires look the same, so variances grow
    for _ in range(_ROUNDS):
        covariance = np.asarray(np.linalg.inv(np.linalg.inv(covariance + np.diag(walk * block_s)) + measured))
        before, visible = visible, float(np.einsum("ij,ji->", covariance, measured))
        if abs(visible - before) <= _SETTLED * visible:
            break
    rate = np.full_like(walk, (DRIFT / unit / 3600.0) ** 2)
    rate[-1] = (PATCH_DRIFT / unit / 3600.0) ** 2
    return GainFilter(effect, walk, rate, covariance, frames)
