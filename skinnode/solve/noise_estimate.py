"""Estimates the noise factor, the ratio of a stream's actual noise to its stated noise.

The estimator uses only the readings, in blocks of four frames. The four resistances of a crossing yield two
contrasts, in which a constant and a linear trend cancel. If the noise is independent from frame to frame, the
contrasts are independent, and each has the variance of the noise:

quadratic  (r₀ − r₁ − r₂ + r₃) / 2
cubic      (r₀ − 3 r₁ + 3 r₂ − r₃) / √20

If the stated noise differs between the frames, the variance of a contrast is the sum of the frames'
variances, weighted by the squares of the coefficients above. The contrasts are then correlated by up to 0.45,
so the standard error of the estimate is up to 10 % larger than assumed.

A block is rejected if the skin moved. Two tests detect motion:

- Slow motion, a step or a lost scan makes the variances of the two contrasts unequal. Slow motion makes the
  quadratic contrast larger than the cubic.
- With motion, the contrasts of neighbouring crossings have the same sign; with noise, their signs are
  independent.

The variance of a block is a robust mean over its readings (Huber, Robust Statistics, 1981, proposal 2), which
limits the influence of bad readings and of a touch on a few wires. The estimate is the median over the last
blocks, which limits the influence of a single block.

Readings that repeat exactly are left out, because they cannot distinguish a quiet converter from a frozen
one. If many codes repeat and the others change by only one code, the noise is at most half a code, and the
estimator assumes half a code. If the quantization error is known, the factor applies only to the noise before
the converter.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float

BLOCK: Final = 4
"""Number of frames in a block; two contrasts require four frames."""
WINDOW: Final = 11
"""Maximum number of blocks in the estimate (44 frames).

With an odd number, the median is the value of one block.
"""
LEAST_BLOCKS: Final = 5
"""Minimum number of blocks in the estimate (20 frames)."""
PAUSE: Final = 12
"""Number of frames skipped after a block that agrees with a full window.

This is also the maximum number of frames skipped after rejected blocks. Without skipping, the noise estimate
would take 8 % of the computing time for a patch at rest.
"""
REPEATED: Final = 0.15
"""Fraction of exactly repeated readings above which the contrasts of a block do not measure the noise.

With a noise of half a code, a tenth of the readings are equal in all four frames. With less noise, the
variance of the codes is no longer the sum of the noise variance and the quantization variance.
"""
ALIVE: Final = 4
"""Minimum number of changed readings in a block where many readings repeat; with fewer, the block is
rejected."""
SAME: Final = 1e-14
"""Maximum contrast of a repeated reading, relative to the reading. The tolerance covers float64 rounding."""
DEVIATIONS: Final = 4.0
"""Margin of each test, in standard deviations of the tested statistic.

The absolute value of a normal variable exceeds this margin with a probability of 1 in 16,000.
"""
DEPARTED: Final = math.log(1.5)
"""Value of |ln(estimated noise / stated noise)| above which the estimate replaces the stated noise."""
RETURNED: Final = math.log(1.25)
"""Value of |ln(estimated noise / stated noise)| below which the stated noise is used again."""
STEP: Final = math.log(1.05)
"""Minimum change in the logarithm of the noise factor, in addition to the margin, for the factor to be
updated. Each update requires another solve of the frame."""
UNEQUAL: Final = 0.3
"""Maximum mean logarithm of the ratio between the variances of the quadratic and cubic contrasts.

At this limit, motion of the skin raises the noise estimate by 8 %.
"""
LEAST: Final = 1.0 / 30.0
"""Lower limit on the noise factor."""

_CLIP: Final = 1.0
"""Limit at which Huber's proposal 2 clips squared values, in units of the variance.

With a limit of 1, additional noise on one upper and one lower wire (13 % of the readings) raises the noise
estimate by 20 %.
"""
_CLIPPED_MEAN: Final = 0.5160585
"""Mean of min(z², 1) for a standard normal z: 1 − 2 φ(1), with the normal density φ."""
_STD: Final = 2.03
"""Standard deviation of ln v times √n, for the robust mean v of n squared readings; 1.41 for the ordinary
mean."""
_ITERATIONS: Final = 30
"""Maximum number of Newton steps for the robust mean, which converges in 4 to 8 steps."""
_ONE_CODE: Final = 12.5
"""Maximum squared contrast of a reading that changes by one code, in units of the quantization variance."""
_HALF_A_CODE: Final = 4.0
"""Combined variance of the quantization error and a noise of half a code, in units of the quantization
variance."""
_CUBIC: Final = 1.0 / math.sqrt(20.0)


@njit_part
def _variance(squares: Float, count: int) -> float:
    """Return the robust mean v of the first ``count`` values x in ``squares``.

    For squared normal values x, v is their variance; it satisfies mean(min(x, v)) = E[min(z², 1)] v, where z
    is a standard normal variable. Returns 0 if the iteration fails.
    """
    total = 0.0
    for i in range(count):
        total += squares[i]
    v = total / (count * _CLIPPED_MEAN)
    for _ in range(_ITERATIONS):
        within, clipped = 0.0, 0
        limit = _CLIP * v
        for i in range(count):
            if squares[i] < limit:
                within += squares[i]
            else:
                clipped += 1
        slope = count * _CLIPPED_MEAN - clipped
        if not slope > 0.0:
            return 0.0
        found = within / slope
        if abs(found - v) <= 1e-3 * v:
            return found
        v = found
    return v


@njit_part
def _contrasts(
    frames: Float, noise: Float, rounding_ohm: Float, quadratic: Float, cubic: Float
) -> tuple[int, int, int, float, float, float]:
    """Write the squared contrasts of the changed readings, in units of the stated variance.

    The arguments are those of :func:`assess_block`.

    Returns:
        The number of changed readings; the number of repeated readings; the number of pairs of contrasts of
        neighbouring crossings; the sum of the signs of the products of these pairs; the mean fraction of the
        stated variance that is not due to quantization; and the largest squared contrast, in units of the
        quantization variance.
    """
    count, silent, pairs, signs, share, largest = 0, 0, 0, 0.0, 0.0, 0.0
    for u in range(frames.shape[1]):
        q_before, c_before = 0.0, 0.0
        for k in range(frames.shape[2]):
            r0, r1, r2, r3 = frames[0, u, k], frames[1, u, k], frames[2, u, k], frames[3, u, k]
            mean = 0.25 * r0 + 0.25 * r1 + 0.25 * r2 + 0.25 * r3
            outer = (mean * noise[0, u, k]) ** 2 + (mean * noise[3, u, k]) ** 2
            inner = (mean * noise[1, u, k]) ** 2 + (mean * noise[2, u, k]) ** 2
            own, own_cubic = 0.25 * (outer + inner), 0.05 * (outer + 9.0 * inner)
            coded = rounding_ohm[u, k] ** 2
            q, c = 0.0, 0.0
            if min(r0, r1, r2, r3) > 0.0 and 0.0 < own + coded < math.inf:
                q = 0.5 * (r0 - r1 - r2 + r3)
                c = _CUBIC * (r0 - 3.0 * r1 + 3.0 * r2 - r3)
                if max(abs(q), abs(c)) > SAME * mean:
                    quadratic[count], cubic[count] = q * q / (own + coded), c * c / (own_cubic + coded)
                    count += 1
                    share += own / (own + coded)
                    largest = max(largest, max(q * q, c * c) / coded)
                    pairs += (q_before * q != 0.0) + (c_before * c != 0.0)
                    signs += np.sign(q_before * q) + np.sign(c_before * c)
                else:
                    silent, q, c = silent + 1, 0.0, 0.0
            q_before, c_before = q, c
    return count, silent, pairs, signs, share / max(count, 1), largest


@njit
def assess_block(
    frames: Float, noise: Float, rounding_ohm: Float, quadratic: Float, cubic: Float
) -> tuple[int, float, float, float]:
    """Return the noise variances of a block of four frames.

    Args:
        frames: (4, U, K) resistances, in ohms; NaN if invalid.
        noise: (4, U, K) stated relative standard deviation of the resistances, excluding quantization.
        rounding_ohm: (U, K) standard deviation of the quantization error, in ohms; 0 if unknown.
        quadratic: (U K,) work array.
        cubic: (U K,) work array.

    Returns:
        The number of changed readings, or 0 if the block is rejected; the variance of the quadratic contrast
        and the variance of the cubic contrast, both divided by the stated variance; and the mean fraction of
        the stated variance that is not due to quantization.
    """
    none = 0, 0.0, 0.0, 0.0
    count, silent, pairs, signs, share, largest = _contrasts(frames, noise, rounding_ohm, quadratic, cubic)
    if count == 0:
        return none
    if silent > REPEATED * (count + silent):
        most = _HALF_A_CODE * (1.0 - share)
        if largest > _ONE_CODE or count < ALIVE or most >= 1.0:
            return none
        return count, most, most, share
    if abs(signs) > DEVIATIONS * math.sqrt(pairs):
        return none
    slow, fast = _variance(quadratic, count), _variance(cubic, count)
    if not (0.0 < slow < math.inf and 0.0 < fast < math.inf):
        return none
    if abs(math.log(slow / fast)) > DEVIATIONS * _STD * math.sqrt(2.0 / count):
        return none
    return count, slow, fast, share


class NoiseEstimate:
    """Estimator of the ratio of actual to stated noise; each stream needs its own instance.

    Args:
        shape: Shape (U, K) of a frame.

    Attributes:
        factor: Factor by which to multiply the stated noise; exactly 1 while the stream agrees with the
            stated noise. If the quantization error is known, the factor applies to the noise before the
            converter.
        relative_std: Relative standard error of the estimated noise; inf before the first estimate.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._frames = np.full((BLOCK, *shape), np.nan)
        self._noise, self._rounding_ohm = np.ones((BLOCK, *shape)), np.zeros(shape)
        self._work = np.empty((2, shape[0] * shape[1]))
        self.reset()
        self._assess()  # compiles the kernel before a stream starts
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        self.factor, self.relative_std = 1.0, math.inf
        self._next, self._pause, self._rejected = 0, 0, 0
        self._blocks: list[tuple[int, float, float, float]] = []

    def see(
        self,
        ohm: Float,
        noise: Float,
        rounding_ohm: Float | None = None,
        valid: NDArray[np.bool_] | None = None,
    ) -> bool:
        """Process the next frame; return whether :attr:`factor` changed.

        Args:
            ohm: (U, K) resistances, in ohms.
            noise: (U, K) stated relative standard deviation of the resistances; excludes quantization if
                ``rounding_ohm`` is given.
            rounding_ohm: (U, K) standard deviation of the quantization error, in ohms; default: 0.
            valid: (U, K) bool, False for missing readings; default: all True.
        """
        if self._pause:
            self._pause -= 1
            return False
        frame = self._frames[self._next]
        frame[:], self._noise[self._next] = ohm, noise
        if valid is not None:
            frame[~valid] = np.nan
        self._next += 1
        if self._next < BLOCK:
            return False
        self._next = 0
        before = self.factor
        self._rounding_ohm[:] = 0.0 if rounding_ohm is None else rounding_ohm
        self._assess()
        return self.factor != before

    def _assess(self) -> None:
        """Add the current block to the window and update :attr:`factor`, unless the block is rejected."""
        count, slow, fast, share = assess_block(
            self._frames, self._noise, self._rounding_ohm, self._work[0], self._work[1]
        )
        blocks = self._blocks
        if not count:
            self._rejected += 1
            self._pause = min(PAUSE, BLOCK * self._rejected)
            return
        self._rejected = 0
        blocks.append((count, 0.25 * math.log(slow * fast), math.log(slow / fast), share))
        del blocks[:-WINDOW]
        if len(blocks) >= LEAST_BLOCKS:
            self._decide()

    def _decide(self) -> None:
        """Set :attr:`factor` from the blocks in the window."""
        blocks = self._blocks
        values = sum(block[0] for block in blocks)
        levels = sorted(block[1] for block in blocks)
        level = 0.5 * (levels[(len(levels) - 1) // 2] + levels[len(levels) // 2])
        agrees = abs(blocks[-1][1] - level) < RETURNED + DEVIATIONS * _STD / math.sqrt(8.0 * blocks[-1][0])
        self._pause = PAUSE if agrees and len(blocks) == WINDOW else 0
        # The standard error of a median is 1.25 times that of a mean.
        std = 1.25 * 0.5 * _STD / math.sqrt(2.0 * values)
        self.relative_std = std
        unequal = math.fsum(block[2] for block in blocks) / len(blocks)
        if abs(unequal) > UNEQUAL + DEVIATIONS * _STD * math.sqrt(2.0 / values):
            return
        if self.factor == 1.0:
            if abs(level) <= DEPARTED + DEVIATIONS * std:
                return
        elif abs(level) < RETURNED:
            self.factor = 1.0
            return
        share = blocks[-1][3]
        own = (math.exp(2.0 * level) - (1.0 - share)) / share if share > 0.0 else 0.0
        found = max(math.sqrt(max(own, 0.0)), LEAST)
        if self.factor == 1.0 or abs(math.log(found / self.factor)) > STEP + DEVIATIONS * std:
            self.factor = found
