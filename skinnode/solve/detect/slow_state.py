"""Slow state of an untouched patch: the wires' gains, the readings' offsets, and the measured drift.

The state is estimated from blocks of untouched frames. A block is used only after the next block is complete,
so that the frames just before a touch is detected do not enter the estimate. Each reading also has an offset,
which follows errors in R₀, rounding and creep over minutes.

The prior of the drift is a random walk with a standard deviation of
:data:`skinnode.solve.detect.gain_drift.DRIFT` after one hour. The drift of the stream is then measured by
comparing the wires' means over two blocks a few seconds apart. The less a stream drifts, the more slowly its
gains follow the readings, and the slower the presses that can still be detected.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.solve.detect.gain_drift import DRIFT, MEASURED_S, PATCH_DRIFT, GainFilter, Growth
from skinnode.solve.detect.gain_kernel import MEAN, WIRES, find_variances, gain_arrays, use_block
from skinnode.solve.detect.touch_statistic import PATCH_VARIANCES, WIRE_VARIANCES

BLOCK_S: Final = 0.25
"""Minimum duration of a block, in s."""
BLOCK: Final = 4
"""Minimum number of frames in a block."""
HELD_BACK: Final = 2.0
"""Maximum age of the newest frame in the estimate while the patch is untouched, in blocks."""
FINER: Final = math.sqrt(2.0)
"""Ratio between successive drift levels distinguished by the detector."""
PRIOR: Final = 8.0
"""Number of independent drift measurements after which the stated drift is ignored."""
WITHIN_S: Final = 120.0
"""Averaging time for a stream's drift, in s."""
MOST_DRIFT: Final = 2.0
"""Maximum drift, relative to the stated drift."""
OFFSET_S: Final = 600.0
"""Averaging time for the readings' offsets, in s."""
OFFSET_FRAMES: Final = 100
"""Weight of an offset of zero in the average, in frames."""
CREEP: Final = 6.0
"""Ratio of the time since the last release to the averaging time of the offsets, which is at most
:data:`OFFSET_S`. The averaging time increases because rubber creeps back ever more slowly."""
START_S: Final = 60.0
"""Assumed time from the measurement of the baseline to the first frame, in s."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Stream parameters that the slow state requires."""

    filter: GainFilter
    """Filter for the gains."""
    unit: float
    """Median relative noise of the readings."""
    period_s: float
    """Scan period, in s."""
    block: int
    """Number of frames in a block."""
    start: Float | None
    """(U + K + 1,) initial variances of the gains, as squares of relative errors; None to assume the drift
    over :data:`START_S`."""


class SlowState:
    """Slow state of one stream.

    Args:
        stream: Parameters of the stream.
        shape: Numbers U and K of upper and lower wires.

    Attributes:
        expected: (U, K) expected changes in an untouched patch's readings, in units of their noise.
        age: Number of frames since the newest frame in the estimate.
        offset_share: Error variance of the offsets, relative to the noise variance.
        level: Indices in ``WIRE_VARIANCES`` and ``PATCH_VARIANCES`` of the variances that cover the current
            uncertainty of the gains. They select the test.
    """

    def __init__(self, stream: Stream, shape: tuple[int, int]) -> None:
        self._stream, self._filter, self._shape = stream, stream.filter, shape
        self._arrays = gain_arrays(stream.filter)
        self.expected = self._arrays.expected.reshape(shape)
        self._block_s = stream.block * stream.period_s
        self._base = int(HELD_BACK * stream.block)
        self._blocks_apart = max(1, round(MEASURED_S / self._block_s))
        self._sum, self._seen, self._missing = np.zeros(shape), np.zeros(shape), False
        self._mean_share = 1.0 / shape[0] + 1.0 / shape[1]
        self._unit = stream.unit
        use_block(self._arrays.table, 0.0, 0.0, 1, 0.0)  # compile the kernel
        self._floor = stream.unit * math.sqrt(3600.0) / 64.0  # a smaller drift does not matter
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        gains = sum(self._shape) + 1
        its = self._arrays
        its.v[:], its.offset[:], its.expected[:] = 0.0, 0.0, 0.0
        self._clear_block()
        self._waiting = False
        self._waiting_mean = np.zeros(self._shape)
        self._measured, self._weight = 0.0, 0.0  # drift: mean of the measurements, and their number
        self._patch_measured = 0.0
        self._means: list[tuple[Float, Float]] = []
        self._frames = 0  # number of frames in the offsets
        self._released: int | None = None  # number of frames since the last release
        self._set_drift(DRIFT, PATCH_DRIFT)
        wires, patch = self._growth.after(START_S)
        variances = np.append(np.full(gains - 1, wires), patch)
        if self._stream.start is not None:
            variances = self._stream.start / self._unit**2
        self.offset_share = 0.0
        its.covariance[:] = self._filter.start(variances)
        find_variances(its.table)
        self._set_age(0)

    def _set_drift(self, drift: float, patch_drift: float) -> None:
        self._drift, self._patch_drift = drift, patch_drift
        unit = self._unit
        self._growth = Growth(drift / unit, patch_drift / unit, DRIFT / unit, PATCH_DRIFT / unit)

    def _set_age(self, age: int) -> None:
        """Set the age of the newest frame in the estimate."""
        self.age = age
        self._variances = self._arrays.variances.tolist()
        self.level = self._level_at(self._base)

    def _level_at(self, age: int) -> tuple[int, int]:
        """Return the level that covers the gains' uncertainty when the newest frame is ``age`` frames old."""
        wires, patch = self._growth.after(age * self._stream.period_s)
        wire_level = _least(WIRE_VARIANCES, self._variances[WIRES] + wires)
        mean = self._variances[MEAN] + wires * self._mean_share + patch
        return wire_level, _least(PATCH_VARIANCES, mean - WIRE_VARIANCES[wire_level] * self._mean_share)

    @property
    def drift(self) -> float:
        """Currently assumed standard deviation of the change in a wire's gain over one hour."""
        return self._drift

    @property
    def gains(self) -> Float:
        """(U + K + 1,) relative changes in conductance of the upper wires, the lower wires and the patch."""
        return np.asarray(self._filter.to_gains @ self._arrays.v) * self._unit

    def collect(self, y: Float, present: NDArray[np.bool_] | None, noise: float) -> bool:
        """Add an untouched frame; return whether :attr:`expected` or :attr:`level` changed.

        Args:
            y: (U, K) unexpected changes in the readings, in units of their noise.
            present: (U, K) mask of the available readings; None if all are available.
            noise: Noise variance of the stream, relative to the stated variance.
        """
        self._pass(1)
        self._sum += y
        if present is not None:
            if not self._missing:
                self._seen[:], self._missing = self._filled, True
            self._seen += present
        elif self._missing:
            self._seen += 1.0
        self._filled += 1
        if self._filled < self._stream.block:
            return self._grow()
        if self._missing:
            beyond = np.divide(self._sum, self._seen, out=np.zeros(self._shape), where=self._seen > 0.0)
        else:
            beyond = self._sum / self._filled
        mean = self.expected + beyond
        self._clear_block()
        if self._waiting:
            self._use(self._waiting_mean, noise)
        self._waiting_mean, self._waiting = mean, True
        return True

    def _clear_block(self) -> None:
        self._sum[:], self._filled, self._missing = 0.0, 0, False

    def skip(self) -> bool:
        """Count a frame without using it; return whether :attr:`level` changed."""
        self._pass(1)
        return self._grow()

    def miss(self, frames: int) -> bool:
        """Count frames that were lost or have too few readings; return whether :attr:`level` changed.

        After a long gap, the frames that have not been used yet are discarded, because the gains may have
        drifted since.
        """
        self._pass(frames)
        if self.age > self._base:
            self.discard()
        return self._grow()

    def _pass(self, frames: int) -> None:
        self.age += frames
        if self._released is not None:
            self._released += frames

    def _grow(self) -> bool:
        """Adapt the level to the age of the gains; return whether the level changed."""
        if self.age <= self._base:
            return False
        before, self.level = self.level, self._level_at(self.age)
        return self.level != before

    def discard(self) -> None:
        """Discard the frames not yet used, after a touch or a gap."""
        self._clear_block()
        self._waiting = False
        self._means.clear()

    def released(self, residue: Float | None = None) -> None:
        """Record the end of a touch.

        Args:
            residue: (U, K) unexpected changes that remain after the touch and become offsets; None if there
                are none.
        """
        self._released = 0
        if residue is not None:
            self._arrays.offset += residue.ravel()
            self._arrays.expected += residue.ravel()
            self._set_age(0)

    def carry_on(self, gains: Float, expected: Float) -> None:
        """Continue with the gains and expected changes of the same stream at a different noise level.

        Args:
            gains: (U + K + 1,) relative changes in conductance; see :attr:`gains`.
            expected: (U, K) expected changes, in units of the noise.
        """
        its = self._arrays
        its.v[:] = self._filter.basis_t @ (self._filter.effect @ (gains / self._unit))
        its.expected[:] = expected.ravel()
        its.offset[:] = its.expected - its.v @ its.basis_t

    def _use(self, mean: Float, noise: float) -> None:
        """Estimate the gains and offsets from the mean of a block."""
        block, its = self._stream.block, self._arrays
        self._measure_drift(mean, noise)
        since = max(self.age - 2 * block, 0)  # frames since the last block that was used
        wires, patch = self._growth.after((since + block) * self._stream.period_s)
        share = self._offset_weight()
        its.mean[:] = mean.ravel()
        use_block(its.table, wires, patch, block, share)
        self.offset_share = 0.5 * share / block
        self._set_age(block)

    def _offset_weight(self) -> float:
        """Return the weight of a block in the offsets."""
        block = self._stream.block
        self._frames += block
        longest = OFFSET_S / self._stream.period_s
        frames = min(self._frames + OFFSET_FRAMES, longest)
        if self._released is not None:
            since = self._released / CREEP
            if since >= longest:
                self._released = None
            else:
                frames = min(frames, since)
        return min(block / max(frames, 1.0), 0.3)

    def _measure_drift(self, mean: Float, noise: float) -> None:
        """Measure the drift of the stream between this block and an earlier one."""
        upper, lower = mean.shape
        means = self._means
        means.append((np.add.reduce(mean, 1) / lower, np.add.reduce(mean, 0) / upper))
        if len(means) <= self._blocks_apart:
            return
        rows, columns = means.pop(0)
        by_rows, by_columns = means[-1][0] - rows, means[-1][1] - columns
        seconds = self._blocks_apart * self._block_s
        of_noise = 2.0 * noise / self._stream.block
        common = float(by_rows.sum()) / upper
        sums = 0.0
        for moved, count, other in ((by_rows, upper, lower), (by_columns, lower, upper)):
            if count > 1:
                about = moved - common  # the row means, or column means, average to the mean of all readings
                variance = float(about @ about) / (count - 1) - of_noise / other
                sums += variance * other / (upper + lower)
        found = sums / seconds
        most = max(1.0, WITHIN_S / self._block_s)
        self._weight = min(self._weight + 1.0, most)
        self._measured += (found - self._measured) / self._weight
        patch = (common**2 - of_noise / (upper * lower)) / seconds - max(found, 0.0) * (1 / upper + 1 / lower)
        self._patch_measured += (patch - self._patch_measured) / self._weight
        std = of_noise / lower * math.sqrt(2.0 / max(upper - 1, 1)) / seconds
        patch_std = of_noise / (upper * lower) * math.sqrt(2.0) / seconds
        drift = self._chosen(self._drift, DRIFT, self._measured, std)
        patch_drift = self._chosen(self._patch_drift, PATCH_DRIFT, self._patch_measured, patch_std)
        if (drift, patch_drift) != (self._drift, self._patch_drift):
            self._set_drift(drift, patch_drift)

    def _chosen(self, used: float, stated: float, measured: float, std: float) -> float:
        """Return the drift (standard deviation after one hour) to assume.

        Args:
            used: Currently assumed drift.
            stated: Drift of the prior.
            measured: Mean measured drift: growth of variance per second, relative to the noise variance.
            std: Standard deviation of a single measurement.
        """
        independent = self._weight / self._blocks_apart
        prior = max(0.0, 1.0 - independent / PRIOR) * self._blocks_apart
        found = (prior * (stated / self._unit) ** 2 / 3600.0 + self._weight * measured) / (
            prior + self._weight
        )
        found += 2.0 * std / math.sqrt(max(independent, 1.0))
        drift = max(self._unit * math.sqrt(3600.0 * max(found, 0.0)), self._floor)
        steps = max(math.floor(math.log(MOST_DRIFT * stated / drift) / math.log(FINER) + 1e-9), 0)
        level = MOST_DRIFT * stated / FINER**steps
        return used if level < used <= 1.1 * FINER * drift else level


def _least(variances: tuple[float, ...], needed: float) -> int:
    """Return the index of the first value in the ascending ``variances`` that is at least ``needed``."""
    return min(bisect.bisect_left(variances, 0.999 * needed), len(variances) - 1)
