"""Gate between the touch detector and the solvers: an untouched patch is not solved.

The field of an untouched patch is zero. Its standard deviations, statuses and trust are taken from the last
solved frame that was untouched, converged and trusted, with the same usable readings and the same noise. The
gate opens for every frame that is touched or doubtful, or contains an unusual reading or wire, so that the
data check can examine it. The gate stays open while readings are left out because of a fault.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import FieldFrame, SolveStats, amended
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve.detect.touch_detector import TouchDetector, TouchVerdict
from skinnode.solve.inputs import checked_noise
from skinnode.solve.options import TrackerOptions
from skinnode.solve.wires.problem import PatchProblem

NOISIER: Final = 1.25
"""Factor by which a frame's noise must differ from the detector's for the detector to adopt it."""
NOISIER_FRAMES: Final = 4
"""Number of successive frames, noisier than the detector assumes, after which it adopts their noise. Until
then, their readings have less weight. The detector adopts lower noise immediately. If it also adopted higher
noise immediately, it would discard its last frames at each change, and a touch would never end if the noise
alternated."""
GAP_S: Final = 2.0
"""Interval between two frames, in s, above which the detector counts the missing frames. Over a shorter
interval, the drift is negligible."""
SAME: Final = 0.1
"""Maximum relative change in noise for which a rest field remains valid."""


class RestGate:
    """Touch detector of one patch, and the patch's field at rest. Each stream needs its own instance.

    Args:
        layout: The patch.
        options: Options of the tracker.

    Attributes:
        detector: Touch detector of the patch.
        t_ns: Time of the next frame, in ns; None if unknown. Without times, gaps in the stream go unnoticed.
    """

    def __init__(self, layout: PatchLayout, options: TrackerOptions) -> None:
        problem = PatchProblem.of(layout, options.baseline_ohm)
        noise, codes = np.array(checked_noise(options.relative_noise, layout)), options.codes
        rounding = np.zeros(layout.shape)
        if codes is not None:
            noise = np.full(layout.shape, codes.relative_noise)
            with np.errstate(divide="ignore", invalid="ignore"):
                relative = codes.rounding_ohm / codes.baseline_ohm
            rounding = np.where(np.isfinite(relative), relative, 0.0)
        self._rounding = rounding
        self._drift, self._gates = options.drift, options.hold and not options.estimate_noise
        self.detector = TouchDetector(
            layout,
            problem.a_rest / problem.gain,
            noise,
            rounding,
            period_s=options.scan_period_s,
            false_alarms_per_hour=options.false_alarms_per_hour,
            gain_std=_gain_std(layout, options),
        )
        self._factor, self._period_s = 1.0, options.scan_period_s
        self.t_ns: int | None = None
        self._usual, self._layout = noise, layout
        self._noisier_frames = 0  # number of successive frames with more noise than the detector assumes
        self._stated = self._usual_level = float(np.median(noise))
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        self._noisier_frames = 0
        self._restore()
        self.detector.reset()
        self._verdict = TouchVerdict(None, 0.0, False)
        self._field: FieldFrame | None = None
        self._used: NDArray[np.bool_] | None = None
        self._noise_of_field: Float | None = None
        self._noise: Float | None = None
        self._last_ns: int | None = None

    def see(
        self,
        ohm: Float,
        valid: NDArray[np.bool_] | None,
        noise: Float | None,
        left_out: NDArray[np.bool_] | None,
    ) -> FieldFrame | None:
        """Return a frame's field if the frame need not be solved; None if it must be solved.

        Args:
            ohm: (U, K) resistances, in ohms.
            valid: (U, K) bool: False for missing readings; None if no readings are missing.
            noise: (U, K) relative noise of this frame; None for the stated noise.
            left_out: (U, K) bool: True for faulty readings; None if no readings are faulty.
        """
        start = perf_counter()
        self._count_missing()
        if left_out is not None:
            valid = ~left_out if valid is None else valid & ~left_out
        if noise is not None:
            self._adapt(noise)
            noise = self._factor * noise
        elif self._is_noisier(self._usual_level):
            noise = np.hypot(self._factor * self._usual, self._rounding)
        else:
            self._restore()
        self._noise = noise
        self._verdict = self.detector.see(ohm, valid, noise)
        field = self._field
        if not self._verdict.quiet or field is None or left_out is not None or not self._fits(noise):
            return None
        gain = field.gain
        if gain is not None:
            errors, wires = self.detector.gains, len(field.status)
            gain = errors[:wires] + float(errors[wires:-1].mean() + errors[-1])
            gain = gain if self._drift == "wire" else np.full(wires, gain.mean())
        return amended(
            field,
            residual=self.detector.residual,
            stats=SolveStats(0, 0, 0, perf_counter() - start),
            gain=gain,
            touched=self._verdict.touched,
            touch_odds=self._verdict.odds,
        )

    def _count_missing(self) -> None:
        """Tell the detector how many frames have been missed since the last one."""
        last_ns, self._last_ns = self._last_ns, self.t_ns
        if last_ns is None or self.t_ns is None:
            return
        since_s = 1e-9 * (self.t_ns - last_ns)
        missing = round(since_s / self._period_s) - 1
        if since_s > GAP_S and missing > 0:
            self.detector.miss(missing)

    def add(self, field: FieldFrame) -> FieldFrame:
        """Return a solved frame's field with ``touched`` and ``touch_odds`` filled in."""
        verdict = self._verdict
        if (
            self._gates
            and verdict.quiet
            and field.trusted
            and not field.faults
            and all(status is Status.CONVERGED for status in field.status)
            and (self._field is None or not self._fits(self._noise) or self._field.method != field.method)
        ):
            self._field = amended(
                field,
                displacement_m=np.zeros_like(field.displacement_m),
                force_n=None if field.force_n is None else np.zeros_like(field.force_n),
                contacts=(),
                held=np.ones(len(field.status), np.bool_),
            )
            self._used = None if self.detector.complete else self.detector.used
            self._noise_of_field = self._noise
        return amended(field, touched=verdict.touched, touch_odds=verdict.odds)

    def set_noise_factor(self, factor: float) -> None:
        """Set the factor that multiplies the stated noise; the next untouched frame is then solved again."""
        if factor != self._factor:
            self._factor = factor
            self.detector.set_noise(factor)
            self._field = None

    def _fits(self, noise: Float | None) -> bool:
        """Return whether the last frame has the same usable readings and the same noise as the rest field."""
        before = self._noise_of_field
        if (noise is None) != (before is None):
            return False
        if noise is not None and before is not None:
            with np.errstate(invalid="ignore"):
                same = (np.abs(noise - before) <= SAME * before) | (noise == before)
            if not same.all():
                return False
        if self.detector.complete:
            return self._used is None
        return self._used is not None and np.array_equal(self._used, self.detector.used)

    def _restore(self) -> None:
        """Let the detector assume the stated noise again after frames that had their own noise levels."""
        if self._stated != self._usual_level:
            self._stated = self._usual_level
            self.detector.set_noise(self._factor, self._usual)
            self._field = None

    def _adapt(self, noise: Float) -> None:
        """Adapt the detector if the frame's noise differs from the noise that the detector assumes."""
        usable = noise[(noise > 0.0) & (noise < math.inf)]
        if not usable.size:
            return
        now = float(np.median(usable))
        if not self._is_noisier(now) and not 1.0 / NOISIER < now / self._stated < NOISIER:
            self._stated = now
            self.detector.set_noise(self._factor, np.full(self._layout.shape, now))
            self._field = None

    def _is_noisier(self, now: float) -> bool:
        """Return whether the detector must wait before adopting a frame's noise, ``now``."""
        if not now / self._stated >= NOISIER:
            self._noisier_frames = 0
            return False
        self._noisier_frames += 1
        if self._noisier_frames < NOISIER_FRAMES:
            return True
        self._noisier_frames = 0
        return False


def _gain_std(layout: PatchLayout, options: TrackerOptions) -> Float | None:
    """Return the prior standard deviations (U + K + 1,) of the gains; None for a fresh baseline."""
    if options.drift == "none":
        return None
    upper, lower = layout.shape
    std = np.full(upper + lower + 1, 1e-4)
    std[slice(0, upper) if options.drift == "wire" else slice(-1, None)] = options.drift_std
    return std
