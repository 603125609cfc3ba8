"""Measure how many scans per second this computer can solve for a hand.

The time of a scan depends on the layout, the noise and the solver's settings. It is measured on a dent that
presses, slides by one pitch and is released, at the noise of the patch: an untouched patch takes almost no
time, and a touch that does not move takes less time than one that moves.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from skinnode.compiled.jit import is_cold
from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host.scan_solver import tracker_options
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.solve.options import TrackerOptions
from skinnode.solve.tracker import Tracker

FRAMES: Final = 24
"""Number of frames measured; the body moves in each of them."""
DEPTH: Final = 0.2
"""Maximum depth of the dent, as a fraction of the height of the electrodes."""
RADIUS: Final = 1.5
"""Radius of the dent, in pitches."""
KERNELS: Final = "solve_patch", "gauss_newton_step", "climb"
"""Kernels that must have been compiled before a time is measured."""


@dataclass(frozen=True, slots=True)
class SolveRate:
    """Solve times of a hand's patches on this computer."""

    threads: int
    """Number of threads that solve scans."""
    scan_s: Mapping[str, float]
    """CPU time (s) of a scan of each patch while the touch moves, by patch name."""

    @property
    def rate_hz(self) -> float:
        """Maximum number of scans per second and patch (1/s) if all patches are touched.

        This assumes that the threads do not slow each other down.
        """
        times = self.scan_s.values()
        return min(self.threads / sum(times), 1.0 / max(times))


@dataclass(frozen=True)
class _Settings:
    """Options of a tracker; equal if their values are printed alike, because arrays have no hash."""

    options: TrackerOptions = field(compare=False)
    text: str
    noise: float


def solve_rate(hand: HandConfig) -> SolveRate | None:
    """Measure the solve times of a hand's patches; return None if the kernels have not been compiled yet.

    Raises:
        ConfigError: if the solver cannot compute displacements for a patch's layout.
    """
    if any(is_cold(kernel) for kernel in KERNELS):
        return None
    times: dict[str, float] = {}
    for patch in hand.patches:
        layout = patch.layout.build()
        noise = math.hypot(patch.relative_noise, CodeScale(patch.code_bits).relative_std)
        options = tracker_options(
            patch, hand.solver, relative_noise=noise, period_s=1e-3 * hand.sync.period_ms
        )
        try:
            times[patch.name] = _scan_s(layout, _Settings(options, repr(options), noise))
        except ValueError as error:  # the host would refuse the patch, too
            raise ConfigError(f"patch {patch.name!r}", layout.name, str(error)) from None
    threads = hand.solver.workers or len(os.sched_getaffinity(0))
    return SolveRate(min(threads, len(times)), times)


@functools.lru_cache(maxsize=64)
def _scan_s(layout: PatchLayout, settings: _Settings) -> float:
    """Return the mean CPU time (s) of a scan in which the touch moves. The deadline is not used."""
    rest_ohm = resistance_ohm(layout, layout.upper_m)
    options = dataclasses.replace(settings.options, baseline_ohm=rest_ohm, deadline_us=None, detect=False)
    tracker, rng, used_s = Tracker(layout, options), np.random.default_rng(1), 0.0
    for number, moved_m in enumerate(_touch(layout)):
        errors = rng.normal(1.0, settings.noise, layout.shape)
        ohm = resistance_ohm(layout, layout.upper_m + moved_m) * errors
        start_s = time.thread_time()
        tracker.update(ohm)
        if number:  # the first frame may load kernels from the cache
            used_s += time.thread_time() - start_s
    return used_s / FRAMES


def _touch(layout: PatchLayout) -> Iterator[Float]:
    """Yield the displacement (U, N, 3), in m, in ``FRAMES`` + 1 frames: press, slide, release."""
    wires, electrodes = layout.upper_m.shape[:2]
    row, column = np.indices((wires, electrodes))
    for number in range(FRAMES + 1):
        phase = number / FRAMES
        depth_m = DEPTH * layout.height_m * min(1.0, 4.0 * phase + 0.1, 4.0 * (1.0 - phase) + 0.1)
        along = min(max(2.0 * phase - 0.5, 0.0), 1.0)
        square = (row - 0.5 * (wires - 1)) ** 2 + (column - 0.5 * (electrodes - 1) - along) ** 2
        moved_m = np.zeros_like(layout.upper_m)
        moved_m[..., 2] = -depth_m / (1.0 + square / RADIUS**2) ** 1.5
        yield moved_m
