"""Estimates the noise of each crossing and of each wire, even while the skin is being touched.

The noise of a crossing is the smaller of two estimates. A touch can only increase these estimates. The first
estimate uses the second differences of successive scans, whose variance is 6 σ²; it is insensitive to slow
touches. The second estimate is the part of a crossing's signal that the signals of other wires do not
explain; it is insensitive to quick touches. It relies on the fact that a touch changes all crossings by
linear combinations of a few functions of time, whereas noise is independent at each crossing.

A touch that is quick, deep and small increases both estimates, but hardly affects the smallest singular
values of a wire's signals. These values determine the noise of the wires and of the whole patch while the
skin is being touched.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.diagnose.facts import Counts, ScanFacts
from skinnode.model.layout import Float

LEAST_SCANS: Final = 20
"""Minimum number of scans for a noise analysis. With fewer scans, the error in the estimated standard
deviation exceeds 25 %."""

_MOST_SCANS: Final = 64
"""Maximum number of recent scans to analyse. The computing time grows with the square of this number."""

_FLOOR: Final = 8
"""Number of singular values used for a patch's noise floor. They determine the noise to within 20 %."""

_MOVED: Final = 6.0
"""Minimum standard deviation of a touched crossing's signal, relative to the stated noise."""
_EXPLAINED: Final = 2.0
"""Minimum standard deviation of a touched crossing's signal, relative to the part that other wires do not
explain. Pure noise with 25 degrees of freedom exceeds this ratio with a probability of 1e-6."""
_TOUCHED: Final = 2
"""Minimum number of crossings affected by a touch. A loose contact affects a single crossing."""
_STEP: Final = 20.0
"""Minimum height of a jump, relative to the stated noise."""
_STAYS: Final = 0.3
"""Maximum difference between the height of a jump and the change in the median, as a fraction of the
height."""
_STILL: Final = 0.1
"""Maximum standard deviation of a signal after its jump has been removed, as a fraction of the height."""
_EVEN: Final = 0.2
"""Ratio of the crossings' individual noise to their common noise below which the common noise is attributed
to the supply."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseAnalysis:
    """Noise of a patch. Arrays are (U, K) unless stated otherwise."""

    noise: Float
    """Measured noise relative to R0; NaN if unknown. It is too large if a touch affects both estimates."""
    stated: Float
    """Expected noise relative to R0: converter noise and quantization noise."""
    level: Float
    """Median R/R0."""
    touched: Mask
    """Mask of the crossings whose values varied together with those of other crossings."""
    steps: Mask
    """Mask of the crossings that were constant except for a single jump."""
    step_at: Counts
    step_by: Float
    upper: Float
    """(U,) noise of each upper wire relative to the stated noise, hardly affected by a touch; 0 if
    unknown."""
    lower: Float
    """(K,) noise of each lower wire, defined as for ``upper``."""
    floor: float
    """Noise of the whole patch, defined as for ``upper``."""
    supply: float
    """Noise common to all crossings, relative to the stated noise; 0 unless the individual noise of the
    crossings is much smaller."""

    @property
    def is_touched(self) -> bool:
        """Whether something touched the skin during the scans."""
        return int(self.touched.sum()) >= _TOUCHED


@functools.lru_cache(maxsize=16)  # three checks and the report analyse the same patches
def analyse_noise(scans: ScanFacts) -> NoiseAnalysis:
    """Analyse the noise of a patch; ``scans`` must contain at least :data:`LEAST_SCANS` scans."""
    ratio = scans.ratio[scans.complete] if scans.complete.sum() >= LEAST_SCANS else scans.ratio
    ratio = ratio[-_MOST_SCANS:]
    known: Mask = np.asarray(np.isfinite(ratio).all(axis=0))
    safe = np.where(known, ratio, 1.0)
    level = np.median(safe, axis=0)
    stated = np.hypot(scans.stated_noise * level, scans.step / np.sqrt(12.0))
    moved = (safe - safe.mean(axis=0)) / stated
    rough, alone = _roughness(safe) / stated, _unexplained(moved)
    noise = np.minimum(rough, alone)
    touched = known & (moved.std(axis=0) > np.maximum(_MOVED, _EXPLAINED * alone))
    at, by, still = _steps(safe)
    common = np.median(safe[:, known], axis=1) if known.any() else np.ones(len(safe))
    supply = float(_roughness(common) / np.median(stated))
    uneven = (
        float(np.median((_roughness(safe / common[:, None, None]) / stated)[known])) if known.any() else 0.0
    )
    return NoiseAnalysis(
        noise=np.where(known, noise * stated, np.nan),
        stated=stated,
        level=np.where(known, level, np.nan),
        touched=touched,
        steps=known & ~touched & (by > _STEP * stated) & still,
        step_at=at,
        step_by=by,
        upper=_of_wires(moved, noise, known),
        lower=_of_wires(moved.transpose(0, 2, 1), noise.T, known.T),
        floor=_floor(moved[:, known], _FLOOR),
        supply=supply if uneven < _EVEN * supply else 0.0,
    )


def _roughness(series: Float) -> Float:
    return np.asarray(np.sqrt(np.mean(np.diff(series, 2, axis=0) ** 2, axis=0) / 6.0))


def _unexplained(moved: Float) -> Float:
    """Return the (U, K) standard deviations of the part of each signal that other wires do not explain.

    The signals of each upper wire are projected onto the complement of the leading principal components of
    all other upper wires; half of the components count as leading. The same is done for lower wires. Each
    crossing thus has two residuals; the larger of their standard deviations is returned. ``moved`` must have
    zero mean.
    """
    count = len(moved)
    flat = moved.reshape(count, -1)
    gram, left = flat @ flat.T, np.zeros(moved.shape[1:])
    for axis in (1, 2):
        others = (moved.shape[axis] - 1) * moved.shape[3 - axis]
        rank = min(count // 2 - 1, others)
        for wire in range(moved.shape[axis]):
            own = np.take(moved, wire, axis)
            leading = np.linalg.eigh(gram - own @ own.T)[1][:, count - rank :]
            rest = own - leading @ (leading.T @ own)
            of_wire = left[wire] if axis == 1 else left[:, wire]
            np.maximum(of_wire, np.sqrt((rest**2).sum(axis=0) / (count - 1 - rank)), out=of_wire)
    return left


def _of_wires(moved: Float, noise: Float, known: Mask) -> Float:
    """Return the noise of each wire: its noise floor or its median noise, whichever is smaller."""
    levels = np.zeros(moved.shape[1])
    for wire, there in enumerate(known):
        if there.any():
            floor = _floor(moved[:, wire, there], max(1, int(there.sum()) // 2))
            levels[wire] = min(floor, float(np.median(noise[wire, there])))
    return levels


def _floor(moved: Float, values: int) -> float:
    """Return the norm of the smallest singular values of (T, n) data, relative to the norm for unit noise."""
    return _smallest(moved, values) / _of_noise(moved.shape, values) if moved.shape[1] else 0.0


def _smallest(moved: Float, values: int) -> float:
    singular = np.linalg.svd(moved, compute_uv=False)[: min(len(moved) - 1, moved.shape[1])]
    return float(np.linalg.norm(singular[-values:]))


@functools.lru_cache(maxsize=64)
def _of_noise(shape: tuple[int, int], values: int) -> float:
    noise = np.random.default_rng(0).standard_normal(shape)
    return _smallest(noise - noise.mean(axis=0), values)


def _steps(safe: Float) -> tuple[Counts, Float, Mask]:
    """Return the scan and height of each crossing's largest jump, and a mask of the lasting jumps.

    A jump is lasting if the medians before and after it differ by its height, and if the signal is otherwise
    nearly constant.
    """
    jumps = np.diff(safe, axis=0)
    at = np.abs(jumps).argmax(axis=0)
    by = np.take_along_axis(jumps, at[None], axis=0)[0]
    after = np.arange(len(safe))[:, None, None] > at
    high, low = (np.nanmedian(np.where(side, safe, np.nan), axis=0) for side in (after, ~after))
    rest = (safe - np.where(after, high - low, 0.0)).std(axis=0)
    stays = np.abs(high - low - by) < _STAYS * np.abs(by)
    inside = (at >= 2) & (at <= len(safe) - 4)
    return at, np.abs(by), inside & stays & (rest < _STILL * np.abs(by))
