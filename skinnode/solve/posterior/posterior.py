"""Posterior of a patch: estimates fields from a stream of frames, and tests the readings of each frame.

If the noise is 1e-4 or more, :mod:`skinnode.solve.posterior.past` first combines the readings of a frame
with those of earlier frames. ``frame_estimator`` then solves the frame, and
:mod:`skinnode.solve.checks.data_check` tests whether the readings of the frame itself contradict each other.
If some readings are wrong, the frame is solved again without them.
"""

from __future__ import annotations

import math
from typing import Final, Unpack

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.tolerances import EXACT
from skinnode.process.clock import perf_counter
from skinnode.solve.checks.data_check import DataCheck
from skinnode.solve.checks.linearised_readings import Solved
from skinnode.solve.options import PosteriorArguments, PosteriorOptions, merged
from skinnode.solve.posterior.frame_estimator import FrameEstimator, Mask
from skinnode.solve.posterior.observation import Readings
from skinnode.solve.posterior.past.frame_filter import LEAST_READINGS, FrameFilter

PLACED: Final = 2.0
"""Assumed error of a reading per pitch of placement error, as a fraction of the largest change in any
reading."""
RESOLVE: Final = 0.75
"""Ratio of the filtered noise to that in the last solve below which a frame is solved again even if the last
field explains it. The reciprocal is the limit for an increase."""
DITHERED: Final = 2.0
"""Minimum ratio of a reading's noise to its quantization error at which averaging reduces the quantization
error."""


class Posterior(FrameEstimator):
    """Estimates the displacement, loads and contacts of one patch, frame by frame.

    Each stream needs its own instance. The constructor compiles the kernels, which release the GIL.

    Args:
        layout: The patch, with any number of lower wires.
        options: Estimation options; :class:`skinnode.solve.options.PosteriorOptions()` by default.
        **arguments: Options by name; these take precedence over ``options``.

    Attributes:
        layout: The patch.
        options: Options in effect.
        check: Data check of the readings.
        from_rest_s: Minimum time to solve a touched frame from rest, in s; 0 if no deadline is set.
        noise_estimate: Estimate of the stream's noise, used to scale the stated noise; None if the stated
            noise is used unchanged.

    Raises:
        ValueError: If an option has the wrong shape or is out of range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        options: PosteriorOptions | None = None,
        **arguments: Unpack[PosteriorArguments],
    ) -> None:
        super().__init__(layout, merged(PosteriorOptions, options, arguments))
        noise = float(np.median(self._noise))
        self.check = DataCheck(
            self._problem,
            noise,
            _model_std(self.options),
            self.options.drift,
            noise_varies=self.options.estimate_noise,
        )
        self._past: FrameFilter | None = None
        self._factor = 1.0  # noise factor of the frames in the filter
        self._solved_share = 1.0  # noise in the last solve, relative to the noise of its frame alone
        enough = layout.shape[0] * layout.shape[1] >= LEAST_READINGS
        if self.options.past == "auto" and enough and not self.options.estimate_noise:
            self._past = FrameFilter(layout, self._problem.a_rest)
        self.warm_up()

    def reset(self) -> None:
        """Discard the state of the stream; the next frame is solved from rest."""
        super().reset()
        self.check.reset()
        self.forget_past()

    def forget_past(self) -> None:
        """Solve the next frame without the readings of earlier frames.

        Call this method if frames are missing from the stream.
        """
        if self._past is not None:
            self._past.forget()

    def update(
        self,
        frame_ohm: ArrayLike,
        valid: ArrayLike | None = None,
        relative_noise: ArrayLike | None = None,
        rounding_ohm: Float | None = None,
    ) -> FieldFrame:
        """Estimate the displacement field, loads and contacts of one frame.

        Unless the ``past`` option is off, the estimate also uses the readings of earlier frames.

        No resistance value raises an exception. If a wire has no usable resistances, its displacement is
        estimated from its neighbours, and its standard deviation is larger. If no deformation explains the
        resistances of a wire, the wire is INCONSISTENT and left out of the estimate. A wire that does not
        converge even when solved alone has the status MAX_STEPS and is also left out. If the whole frame
        cannot be solved, the last trusted field is returned with an infinite standard deviation.

        Args:
            frame_ohm: (U, K) resistances, in ohms. Values that are not positive and finite are ignored.
            valid: (U, K) bool: False where a reading is missing; all True by default.
            relative_noise: Relative noise of this frame only, a number or (U, K). Resistances whose noise is
                not positive and finite are ignored.
            rounding_ohm: (U, K) standard deviation of the quantization error of the codes, in ohms. This
                noise and ``relative_noise`` are treated as independent.

        Returns:
            The field, with one status per wire.

        Raises:
            ValueError: If an array has the wrong shape.
        """
        start = perf_counter()
        readings = self._readings(frame_ohm, valid, relative_noise, rounding_ohm)
        if self.check.left_out is not None:
            readings = readings.except_for(self.check.left_out)
        with np.errstate(over="ignore", invalid="ignore"):
            a = np.asarray(frame_ohm, np.float64) * self._problem.gain

        least = None
        if rounding_ohm is not None:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                error = np.abs(rounding_ohm / np.asarray(frame_ohm, np.float64))
            least = np.where(readings.noise < DITHERED * error, error, 0.0)
        if self._past is not None:
            factor = 1.0 if self.noise_estimate is None else self.noise_estimate.factor
            if factor != self._factor:
                self._past.forget()  # the filter assumed a different noise
            self._factor = factor
            self._past.next_frame()

        def solve(without: Mask | None = None) -> Solved:
            kept = readings if without is None else readings.except_for(without)
            field = self._estimate(self._with_past(kept, least), start, kept)
            return Solved(field, a, self._hyper.noise_factor * kept.noise, kept.usable)

        return self.check.check(solve(), solve, start + self._seconds)

    def _with_past(self, readings: Readings, least: Float | None) -> Readings:
        """Return the readings of a frame, estimated from this frame and earlier frames."""
        if self._past is None:
            return readings
        found = self._past.filtered(readings, least)
        used = found.usable
        share = float(found.noise[used].sum() / readings.noise[used].sum()) if used.any() else 1.0
        if not RESOLVE * self._solved_share <= share <= self._solved_share / RESOLVE:
            self._seen = np.zeros_like(self._seen)
            self._solved_share = share
        return found


def _model_std(options: PosteriorOptions) -> float:
    """Return the forward model's standard error for the given options, relative to the largest change."""
    made = options.tolerances or EXACT
    placed = PLACED * math.hypot(made.placement, made.electrode_radius)
    return math.hypot(options.model_error, placed, made.thickness, made.gain)
