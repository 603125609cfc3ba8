"""Filter over the frames of one patch: replaces a frame's readings with estimates from several frames.

The filter works on the logarithms of the readings, before the posterior solve. It returns readings with less
noise, which the posterior treats like those of a single frame. If noise cannot explain a change in the
readings, the filter forgets all earlier frames immediately, and the frame is solved unfiltered.

The state before a frame is kept until the next frame. If the data check finds wrong readings, both the filter
and the solve are repeated without them. Detected wrong readings therefore do not affect later frames.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.posterior.observation import Readings
from skinnode.solve.posterior.past.filter_kernel import (
    JUMPS,
    SPEEDS,
    UNEXPLAINED,
    FilterArrays,
    filter_frame,
    start,
    switching,
)
from skinnode.solve.posterior.past.load_modes import LoadModes

NOISY: Final = 0.9e-4
"""Minimum relative noise of the readings (RMS) for the filter to be used. It is slightly below 1e-4, so that
readings with a noise of 1e-4 are filtered even if the estimated noise is a little lower."""
LEAST_NOISE: Final = 2.5e-5
"""Minimum noise of the filtered readings. With less noise, forward-model errors that the stated noise covers
would make correct readings contradict each other."""
MOST_FRAMES: Final = 64.0
"""Maximum number of frames averaged."""
LEAST_READINGS: Final = 12
"""Minimum number of readings of a patch. With fewer, the noise estimate
(:mod:`skinnode.solve.noise_estimate`) cannot distinguish movements from noise: with 6 readings and a new
press in each frame, it was 3,000 times too large; with 12, it was right."""
ENOUGH: Final = 0.5
"""Minimum fraction of usable readings. With fewer, the filter forgets all earlier frames."""
JUMPED: Final = 0.5
"""Probability of a jump above which a frame is solved unfiltered."""


SURPRISE: Final = 5.0
"""Change along one mode or of one coordinate, in standard deviations, above which the filter forgets all
earlier frames. The banks expect changes in many cells at once. Without this test, slow movements of a single
electrode under a small body went unnoticed, and errors reached 10 standard deviations."""
RECENT: Final = 0.25
"""Weight of the last frame in the running mean of the changes. Both this mean and the last change are
tested."""


class FrameFilter:
    """Filter over the frames of one patch. Each stream needs its own instance.

    The constructor compiles the kernels.

    Args:
        layout: The patch.
        a_rest: (U, K) readings at rest, in the units of
            :class:`skinnode.solve.posterior.observation.Readings`.
    """

    def __init__(self, layout: PatchLayout, a_rest: Float) -> None:
        self._modes = modes = LoadModes.of(layout)
        m, banks = a_rest.size, SPEEDS.size + 1
        self._a_rest = a_rest
        self._arrays = FilterArrays(
            modes=modes.modes,
            share=modes.share,
            weight=modes.weight,
            total=modes.total,
            speeds=SPEEDS,
            jumps=JUMPS,
            unexplained=UNEXPLAINED,
            switch=switching(SPEEDS.size),
            frame=np.zeros(m),
            state=np.zeros((banks, m)),
            variance=np.ones((banks, m)),
            chance=np.full(banks, 1.0 / banks),
            next_state=np.zeros((banks, m)),
            next_variance=np.ones((banks, m)),
            next_chance=np.zeros(banks),
            modal=np.zeros(m),
            expected=np.zeros(banks),
            mixture=np.zeros((banks, banks)),
            start_of=np.zeros(banks),
            filtered=np.zeros(m),
            noise=np.ones(m),
        )
        start(self._arrays.table)  # compile the kernels
        filter_frame(self._arrays.table, 1.0)
        self._change = np.zeros((m, 2))  # last and mean recent change, in units of the noise
        self._next_change = np.zeros((m, 2))
        self._mean = np.zeros(m)  # filtered changes before the frame, in units of the noise
        self.forget()

    def forget(self) -> None:
        """Forget all frames."""
        self._sigma = 0.0  # relative noise before the frame; 0 if there is no frame
        self._next_sigma = 0.0
        self._used = self._next_used = np.zeros(self._a_rest.shape, bool)
        self._last_a = self._next_a = self._a_rest
        self._next_change[:] = 0.0
        self._spread = 1.0  # mean variance of the filtered changes before the frame
        self._shift: Float | None = None  # readings of the last frame that were not usable before it

    def next_frame(self) -> None:
        """Accept the last frame, and advance the filter to the next frame."""
        its = self._arrays
        its.state[:], its.variance[:], its.chance[:] = its.next_state, its.next_variance, its.next_chance
        self._spread = min(float(its.noise.mean()), 1.0)
        self._mean[:], self._change[:] = its.filtered, self._next_change
        self._sigma, self._used, self._last_a = self._next_sigma, self._next_used, self._next_a
        if self._shift is not None:
            self._restart(self._shift)
        self._shift = None

    def filtered(self, readings: Readings, least: Float | None = None) -> Readings:
        """Return the readings of a frame, estimated from this frame and earlier frames.

        If the method is called again before :meth:`next_frame`, the new readings replace those of the frame.

        Args:
            readings: The frame. Readings that are not usable are ignored and stay unusable. A reading is
                returned unchanged if it was not usable in the last frame, or if it repeats its last value
                exactly, because averaging does not reduce the noise of a frozen converter.
            least: (U, K) relative errors that are the same in all frames, such as the quantization error of
                readings with little noise; None if there are none.
        """
        used, m = readings.usable, self._a_rest.size
        self._next_sigma, self._next_used, self._shift = 0.0, used, None
        self._next_a = readings.a
        if np.count_nonzero(used) < ENOUGH * m:
            return readings
        sigma = math.sqrt(float(np.mean(readings.noise[used] ** 2)))
        if sigma < NOISY:
            return readings
        its, self._next_sigma = self._arrays, sigma
        its.frame[:] = (np.log(self._a_rest / readings.a) / sigma).ravel()
        if self._sigma == 0.0:
            start(its.table)
            self._next_change[:] = 0.0
            return readings
        self._rescale(self._sigma / sigma)
        fresh = used & ~self._used
        past = used & self._used & (readings.a != self._last_a)
        new = its.frame.copy()
        ignored = ~past.ravel()
        if ignored.any():
            its.frame[ignored] = self._mean[ignored]
        jumped = self._advance(max(1.0 / MOST_FRAMES, (LEAST_NOISE / sigma) ** 2))
        if fresh.any():
            self._shift = np.where(fresh.ravel(), new - its.filtered, 0.0)
        if jumped:
            return readings
        shape = readings.a.shape
        a = self._a_rest * np.exp(-sigma * its.filtered.reshape(shape))
        noise = readings.noise * np.sqrt(np.minimum(its.noise.reshape(shape), 1.0))
        if least is not None:
            noise = np.maximum(noise, least)
        return Readings(np.where(past, a, readings.a), np.where(past, noise, readings.noise), used)

    def _advance(self, least: float) -> bool:
        """Filter the frame; return whether the skin jumped, in which case the frame is used alone.

        Args:
            least: Minimum variance of a filtered mode, in units of the noise variance.
        """
        its = self._arrays
        if self._has_changed():
            start(its.table)
        elif filter_frame(its.table, least) > JUMPED:
            its.filtered[:], its.noise[:] = its.frame, 1.0
        else:
            return False
        self._next_change[:] = 0.0
        return True

    def _has_changed(self) -> bool:
        """Return whether the last frame, or the mean of the last few, differs from the filtered readings."""
        change = self._next_change
        change[:, 0] = self._arrays.frame - self._mean
        change[:, 1] = (1.0 - RECENT) * self._change[:, 1] + RECENT * change[:, 0]
        variance = 1.0 + self._spread
        one, recent = self._modes.largest(change) ** 2 / variance
        return bool(max(one, recent * (2.0 - RECENT) / RECENT) > SURPRISE**2)

    def _rescale(self, ratio: float) -> None:
        """Convert the state before the frame to units of a new noise; ``ratio`` is old noise / new noise."""
        if ratio == 1.0:
            return
        its = self._arrays
        its.state *= ratio
        its.variance *= ratio**2
        self._mean *= ratio
        self._change *= ratio
        self._spread *= ratio**2
        self._sigma /= ratio

    def _restart(self, shift: Float) -> None:
        """Use only the last frame for readings that were not usable before.

        Args:
            shift: (m,) differences between these readings and the filtered changes; 0 for other readings.
        """
        its = self._arrays
        its.state += its.modes @ shift
        own = (its.modes[:, shift != 0.0] ** 2).sum(axis=1)
        its.variance += (1.0 - np.minimum(its.variance, 1.0)) * own
        self._mean += shift
