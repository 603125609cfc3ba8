"""Touch detector of one patch: decides, before a frame is solved, whether the patch is touched.

A touch begins when the statistic of a frame, or of the mean of three frames, exceeds its threshold
(:mod:`skinnode.solve.detect.touch_test`). :mod:`skinnode.solve.detect.held_touch` decides when it has ended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.detect.gain_drift import GainFilter
from skinnode.solve.detect.held_touch import HeldTouch, creep_of
from skinnode.solve.detect.slow_state import BLOCK, BLOCK_S, OFFSET_S, SlowState, Stream
from skinnode.solve.detect.touch_kernel import (
    COUNT,
    KEPT,
    LOWER,
    MOTION,
    RATIO,
    UPPER,
    WORST,
    TouchArrays,
    retest,
    see_frame,
)
from skinnode.solve.detect.touch_odds import bounded_exp, log_likelihood_ratio, next_log_odds, octaves_for
from skinnode.solve.detect.touch_statistic import TouchBasis
from skinnode.solve.detect.touch_test import TouchTest, touch_tests

ENOUGH: Final = 0.5
"""Minimum fraction of usable readings. With fewer, the detector makes no decision."""
ODD_READING: Final = 6.0
"""Change in a single reading, in standard deviations, above which a frame is solved and its data are checked.
Noise exceeds this limit in 1 of 1,700,000 frames of 300 readings."""
ODD_WIRE: Final = 8.0
"""Excess of a wire's χ², in standard deviations of χ², above which a frame is solved and its data are
checked. Noise exceeds this limit in at most 1 of 25,000 frames."""
NOISE_FRAMES: Final = 400
"""Number of frames over which the noise is averaged."""
NOISE_START: Final = 30
"""Weight of the stated noise, in frames."""
QUIETER: Final = 0.6
"""Ratio of a touched frame's noise variance to the average noise variance, below which the average is
considered too large."""
NOISE_STEP: Final = 1.25
"""Maximum ratio between the average and a frame's noise variance; larger deviations are clipped."""


@dataclass(frozen=True, slots=True)
class TouchVerdict:
    """Decision for a frame."""

    touched: bool | None
    """Whether the patch is touched; None if too few readings are usable."""
    odds: float
    """Odds of touch versus no touch; see :attr:`skinnode.FieldFrame.touch_odds`."""
    quiet: bool
    """Whether the frame need not be solved, because the patch is untouched and no reading is unusual."""


class TouchDetector:
    """Touch detector of one patch. Each stream needs its own instance. The constructor compiles the kernels.

    Args:
        layout: The patch.
        baseline_ohm: (U, K) resistances at rest, in ohms. Crossings without a positive, finite value are
            ignored.
        noise: (U, K) relative standard deviation of the readings, excluding quantization.
        rounding: (U, K) relative standard deviation of the quantization error.
        period_s: Scan period, in s.
        false_alarms_per_hour: Accepted number of false alarms per hour.
        gain_std: (U + K + 1,) initial standard deviations of the gains; None for a fresh baseline.

    Attributes:
        touched: Whether the patch is touched, as of the last frame with enough readings.
    """

    def __init__(  # noqa: PLR0913 - the facts about a stream
        self,
        layout: PatchLayout,
        baseline_ohm: Float,
        noise: Float,
        rounding: Float,
        *,
        period_s: float,
        false_alarms_per_hour: float,
        gain_std: Float | None = None,
    ) -> None:
        upper, lower = layout.shape
        self._layout, self._own, self._rounding = layout, noise.copy(), rounding.copy()
        self._period_s, self._rate = period_s, false_alarms_per_hour
        self._gain_variance = None if gain_std is None else gain_std**2
        self._known = np.isfinite(baseline_ohm) & (baseline_ohm > 0.0)
        sigma = np.hypot(self._own, self._rounding)
        # rounded, so that patches whose noise differs only by rounding errors share their tests
        ratios = np.where(self._known, sigma / np.median(sigma), 1.0).astype(np.float32).astype(np.float64)
        self._ratios, self._shape_of_noise = ratios, ratios.tobytes()
        self._basis = TouchBasis.of(layout, self._shape_of_noise)
        size, gains = len(self._basis.responses_t), upper + lower + 1
        self._arrays = TouchArrays(
            ohm=np.full((upper, lower), np.nan),
            rest=np.where(self._known, baseline_ohm, 1.0),
            weight=np.zeros((upper, lower)),
            expected=np.zeros((upper, lower)),
            recent=np.zeros((KEPT, upper * lower)),
            responses=self._basis.responses_t,
            ratios=self._basis.ratios,
            features=np.zeros((KEPT, size + gains)),
            shift=np.zeros(upper * lower),
            shift_features=np.zeros(size + gains),
            products=np.zeros((KEPT, size)),
            residual=np.zeros(upper),
            columns=np.zeros(lower),
            counts=np.zeros(lower),
            found=np.zeros(9),
        )
        self._factor = 1.0
        self._configure()
        self._arrays.ohm[:] = self._arrays.rest
        self._at, self._frames = 0, 1
        self._compute(1.0)
        retest(self._arrays.table, self._test.rows, self._slow.expected, 0, 1)  # compile the kernels
        self.reset()

    def _configure(self) -> None:
        """Create the slow state and the tests for the current noise.

        The ratios between the readings' noise levels stay the same as at the start, so the tests remain
        valid.
        """
        sigma = np.hypot(self._factor * self._own, self._rounding)
        # noise of half a code or more makes the quantization errors of successive frames independent
        coded = self._rounding**2 / sigma**2
        undithered = (self._factor * self._own) ** 2 < 3.0 * self._rounding**2
        unit = float(np.median(sigma))
        self._sigma = unit * self._ratios
        self._weight = np.where(self._known, 1.0 / self._sigma, 0.0)
        self._least_noise = min(1.0, max(float(np.median(coded)), 1e-4))
        self._tests = touch_tests(
            self._layout,
            self._shape_of_noise,
            round(float(np.where(undithered, coded, 0.0).mean()), 3),
            self._period_s,
            self._rate,
        )
        self._octaves = octaves_for(unit)
        block = max(BLOCK, round(BLOCK_S / self._period_s))
        gains = GainFilter.of(self._layout.shape, self._shape_of_noise)
        self._slow = SlowState(
            Stream(gains, unit, self._period_s, block, self._gain_variance), self._layout.shape
        )
        self._use_test()

    def prepare(self) -> None:
        """Compute all tests in advance, to avoid delays. Patches with the same layout share the tests."""
        self._tests.prepare()

    def _use_test(self) -> None:
        self._test: TouchTest = self._tests.test(*self._slow.level)

    def reset(self) -> None:
        """Discard the state of the stream; assume an untouched patch and a fresh baseline."""
        self.touched = False
        self._noise, self._noise_frames = 1.0, NOISE_START
        self._at = self._frames = self._clock = 0  # the clock counts frames
        self._log_odds = -math.inf
        self._crept_peak, self._crept_at = 0.0, 0  # last touch that was not itself creep
        self._slow.reset()
        self._use_test()
        self._arrays.expected[:] = 0.0

    def set_noise(self, factor: float, noise: Float | None = None) -> None:
        """Change the noise without losing the state of the stream.

        Args:
            factor: Factor that multiplies the stated noise, excluding quantization.
            noise: (U, K) stated noise; None to keep the current noise.
        """
        if factor == self._factor and noise is None:
            return
        gains, expected, before = self._slow.gains, self._arrays.expected.copy(), self._sigma
        self._factor = factor
        if noise is not None:
            self._own = noise.copy()
        self._configure()
        self._slow.carry_on(gains, expected * before / self._sigma)
        self._crept_peak *= float(np.median(before) / np.median(self._sigma)) ** 2  # in units of noise²
        self._arrays.expected[:] = self._slow.expected
        self._noise, self._noise_frames, self._frames = 1.0, NOISE_START, 0
        if self.touched:
            self._begin_touch()

    @property
    def test(self) -> TouchTest:
        """Current test."""
        return self._test

    @property
    def basis(self) -> TouchBasis:
        """Features of the patch."""
        return self._basis

    @property
    def gains(self) -> Float:
        """(U + K + 1,) relative errors in resistance of the upper wires, the lower wires and the patch."""
        return -self._slow.gains

    @property
    def residual(self) -> Float:
        """(U,) RMS relative change from rest of each upper wire's readings in the last frame."""
        return self._arrays.residual.copy()

    @property
    def used(self) -> NDArray[np.bool_]:
        """(U, K) mask of the readings used in the last frame."""
        its = self._arrays
        with np.errstate(invalid="ignore"):
            return np.asarray((its.ohm > 0.0) & (its.ohm < math.inf) & (its.weight > 0.0))

    @property
    def complete(self) -> bool:
        """Whether all readings of the last frame were used."""
        return float(self._arrays.found[COUNT]) == self._arrays.ohm.size

    def see(
        self,
        ohm: Float,
        valid: NDArray[np.bool_] | None = None,
        noise: Float | None = None,
    ) -> TouchVerdict:
        """Decide whether the patch is touched in the next frame.

        Args:
            ohm: (U, K) resistances, in ohms; values that are not positive and finite are ignored.
            valid: (U, K) bool: False for readings to ignore; None to use all readings.
            noise: (U, K) relative noise of this frame, including quantization; None for the usual noise.
        """
        its, expected = self._arrays, None
        its.ohm[:] = ohm
        weight = self._weight
        if noise is not None:
            usable = self._known & (noise > 0.0) & (noise < math.inf)
            own = np.where(usable, np.maximum(noise, self._sigma), math.inf)
            weight, expected = 1.0 / own, its.expected.copy()
            its.expected *= self._sigma / own  # in units of the noise of this frame
        if valid is not None:
            weight = np.where(valid, weight, 0.0)
        its.weight[:] = weight
        before, self._at = (self._at, self._frames), (self._at + 1) % KEPT
        self._frames = min(self._frames + 1, KEPT)
        self._compute(self._noise * (1.0 + self._slow.offset_share))
        if expected is not None:
            its.expected[:] = expected
        found = its.found.tolist()
        if found[COUNT] < ENOUGH * its.ohm.size:
            self._at, self._frames = before[0], min(before[1], KEPT - 1)  # the oldest frame is overwritten
            self.miss(1)
            return TouchVerdict(None, bounded_exp(self._log_odds), False)
        self._clock += 1
        self._follow_noise(found)
        variance, quiet = self._noise * (1.0 + self._slow.offset_share), False
        if self.touched:
            self._follow_touch(variance)
        else:
            quiet = self._follow_rest([each / variance for each in found[:3]], found)
        return TouchVerdict(self.touched, bounded_exp(self._log_odds), quiet)

    def miss(self, frames: int) -> None:
        """Count frames that were lost or have too few readings; the gains may have drifted in the meantime.

        Args:
            frames: Number of frames.
        """
        self._clock += frames
        if frames >= KEPT:
            self._frames = 0
        if self._slow.miss(frames) and not self.touched:
            self._change_test()

    def _compute(self, variance: float) -> None:
        its = self._test.statistic
        see_frame(
            self._arrays.table, its.rows, its.shares, its.log_dets, self._octaves, variance, self._at,
            self._frames,
        )  # fmt: skip

    def _follow_noise(self, found: list[float]) -> None:
        """Average the noise variance. In touched frames, motion increases the measured variance."""
        now = found[MOTION]
        unsure = self._noise_frames < 2 * NOISE_START or now < QUIETER * self._noise
        if now < 0.0 or (self.touched and not unsure):
            return
        limited = min(max(now, self._noise / NOISE_STEP), self._noise * NOISE_STEP)
        self._noise_frames = min(self._noise_frames + 1, NOISE_FRAMES)
        self._noise = max(self._noise + (limited - self._noise) / self._noise_frames, self._least_noise)

    def _follow_rest(self, scaled: list[float], found: list[float]) -> bool:
        """Process a frame of an untouched patch; return whether it need not be solved."""
        limits, its = self._test.thresholds, self._arrays
        self._log_odds = next_log_odds(self._log_odds, found[RATIO], self._period_s)
        if scaled[0] > limits.onset[0] or scaled[1] > limits.onset[1]:
            self._begin_touch()
            return False
        doubt = scaled[0] > limits.doubt[0] or scaled[1] > limits.doubt[1]
        if doubt:
            changed = self._slow.skip()
        else:
            y = its.recent[self._at].reshape(its.ohm.shape)
            changed = self._slow.collect(y, None if self.complete else self.used, self._noise)
        if changed:
            self._change_test()
        odd = found[WORST] > ODD_READING or max(found[UPPER], found[LOWER]) > ODD_WIRE
        return not (doubt or odd)

    def _change_test(self) -> None:
        """Apply the slow state's current expected changes, and the test for its current level."""
        self._use_test()
        retest(self._arrays.table, self._test.rows, self._slow.expected, self._at, self._frames)

    def _begin_touch(self) -> None:
        self.touched = True
        self._slow.discard()
        since_s = (self._clock - self._crept_at) * self._period_s
        creep = creep_of(self._crept_peak, since_s) if since_s < OFFSET_S else 0.0
        its, at = self._arrays, self._at
        self._touch = HeldTouch(
            self._test, its.recent[at].copy(), its.features[at].copy(), self._period_s, creep
        )

    def _follow_touch(self, variance: float) -> None:
        """Process a frame of a touched patch."""
        its, slow = self._arrays, self._slow
        slow.skip()
        later, ratio = self._tests.test(*slow.level), float(its.found[RATIO])
        if later is not self._test:
            z = later.rows @ its.features[self._at] / math.sqrt(variance)
            ratio = log_likelihood_ratio(later.statistic, self._octaves, z)
        self._log_odds = next_log_odds(self._log_odds, ratio, self._period_s)
        if self._frames < KEPT:
            return
        touch, first = self._touch, (self._at + 1) % KEPT
        ended = touch.follow(its.features, first, its.recent[first], variance, later)
        if ended is False:
            return
        self.touched = False
        slow.released(touch.average.reshape(its.ohm.shape) if ended is None else None)
        if ended or not touch.is_creep:
            self._crept_peak, self._crept_at = touch.peak, self._clock
        if ended is None:
            self._log_odds = -math.inf
        self._change_test()
