"""Estimates the noise at each crossing and on each wire, even while the skin is touched.

The functions are pure and compute two estimates of the noise. Second differences of successive scans
(variance 6 σ²) are insensitive to slow touches. The part of a crossing's signal that the other wires do not
explain is insensitive to quick touches: a touch changes the values of many crossings by linear combinations
of a few functions of time, whereas the noise is independent at each crossing. Both estimates are upper bounds
on the noise, so the smaller of the two is used.

A quick, deep and small touch affects both estimates, but hardly affects the smallest singular values of a
wire's signals. On touched skin, these singular values are therefore compared with those of the neighbouring
wires. The patch as a whole is assessed by its own smallest singular values.
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
"""Minimum number of scans for a noise analysis; with fewer scans, the error of the estimated standard
deviation exceeds 25 %."""

_MOST_SCANS: Final = 64
"""Maximum number of scans used, from the newest; computing time grows with the square of this number."""

_FLOOR: Final = 8
"""Number of singular values that form a patch's noise floor; they determine the noise level to within 20
%."""

_MOVED: Final = 6.0
"""Minimum standard deviation of a touched crossing's values, in units of the stated noise."""
_EXPLAINED: Final = 2.0
"""Minimum ratio of a touched crossing's standard deviation to the part that other wires do not explain.

For pure noise with 25 degrees of freedom, the probability of exceeding this ratio is 1e-6.
"""
_TOUCHED: Final = 2
"""Minimum number of crossings that a touch affects at the same time; a loose contact affects one crossing."""
_STEP: Final = 20.0
"""Minimum height of a jump, in units of the stated noise."""
_STAYS: Final = 0.3
"""Maximum difference between a jump and the resulting change of the median, as a fraction of the jump."""
_STILL: Final = 0.1
"""Maximum standard deviation of a crossing after its jump is removed, as a fraction of the jump."""
_EVEN: Final = 0.2
"""Ratio of a crossing's own noise to the noise common to all crossings; below this ratio, the supply is
considered noisy."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseAnalysis:
    """Noise of a patch; arrays are (U, K), one value per crossing, unless stated otherwise."""

    noise: Float
    """Noise relative to R0, including the residual effect of a touch; NaN if unknown."""
    stated: Float
    """Noise expected from the converter and from rounding to whole codes, relative to R0."""
    level: Float
    """Median R/R0."""
    touched: Mask
    """Whether the crossing's value varied together with those of other crossings."""
    steps: Mask
    """Whether the crossing was constant except for a single jump."""
    step_at: Counts
    step_by: Float
    upper: Float
    """(U,) noise of each upper wire divided by the stated noise; the effect of a touch is removed as far as
    possible."""
    lower: Float
    """(K,) noise of each lower wire, divided by the stated noise as in ``upper``."""
    floor: float
    """Noise of all crossings together, divided by the stated noise as in ``upper``."""
    supply: float
    """Noise common to all crossings divided by the stated noise; 0 unless each
    crossing's own noise is much smaller."""

    @property
    def is_touched(self) -> bool:
        """Whether something touched the skin during the scans."""
        return int(self.touched.sum()) >= _TOUCHED


def analyse_noise(scans: ScanFacts) -> NoiseAnalysis:
    """Analyse the noise of at least LEAST_SCANS scans."""
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
    """Return the (U, K) standard deviations of the variation that the other wires do not explain.

    From the signals of each upper wire, the leading half of the temporal components of all other upper wires
    is removed. Lower wires are treated in the same way. Each crossing therefore has two residuals; the larger
    standard deviation is returned. ``moved`` has mean 0.
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
    """Return each wire's noise floor or median noise, whichever is smaller; 0 if unknown."""
    levels = np.zeros(moved.shape[1])
    for wire, there in enumerate(known):
        if there.any():
            floor = _floor(moved[:, wire, there], max(1, int(there.sum()) // 2))
            levels[wire] = min(floor, float(np.median(noise[wire, there])))
    return levels


def _floor(moved: Float, values: int) -> float:
    """Return the norm of the smallest singular values of (T, n) data, divided by the norm for unit noise."""
    return _smallest(moved, values) / _of_noise(moved.shape, values) if moved.shape[1] else 0.0


def _smallest(moved: Float, values: int) -> float:
    singular = np.linalg.svd(moved, compute_uv=False)[: min(len(moved) - 1, moved.shape[1])]
    return float(np.linalg.norm(singular[-values:]))


@functools.lru_cache(maxsize=64)
def _of_noise(shape: tuple[int, int], values: int) -> float:
    noise = np.random.default_rng(0).standard_normal(shape)
    return _smallest(noise - noise.mean(axis=0), values)


def _steps(safe: Float) -> tuple[Counts, Float, Mask]:
    """Return the scan and height of each crossing's largest jump, and whether it is otherwise constant.

    A crossing is otherwise constant if its medians before and after the jump differ by the jump's height and
    the remaining variation is small.
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
