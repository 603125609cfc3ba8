"""Noise of each crossing and wire, told apart from touch. Pure functions.

Noise is taken from second differences of successive scans (their variance is 6 σ²), which a slow touch
leaves alone, and from what the other wires leave unexplained, which a quick one leaves alone: a touch moves
crossings of many wires by a few functions of time, noise has one of its own for each. Both are at least the
noise, so the smaller counts. Of a touch that is quick, deep and small even that leaves something; so on skin
that is touched a wire is judged by its smallest singular values, which touch hardly reaches, against those
of its neighbours, and the patch by its own.
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
"""A standard deviation of fewer is known to worse than a quarter."""

_MOST_SCANS: Final = 64
"""More are not looked at: the newest are enough, and time grows with their square."""

_FLOOR: Final = 8
"""Smallest singular values of a patch that are its floor: what they tell of noise is known to a fifth."""

_MOVED: Final = 6.0
"""Times the noise told; a crossing that moved by less is not said to be touched."""
_EXPLAINED: Final = 2.0
"""How much larger the motion of a crossing is, if touched, than what other wires leave of it unexplained. Of
noise with 25 degrees of freedom one in a million looks like that."""
_TOUCHED: Final = 2
"""Crossings that have to move together before the skin counts as touched: a loose contact moves one."""
_STEP: Final = 20.0
"""Least height of a jump, in units of the noise told."""
_STAYS: Final = 0.3
"""Share of a jump by which the medians before and after may differ from it."""
_STILL: Final = 0.1
"""Most deviation of a crossing beside its jump, as a share of that."""
_EVEN: Final = 0.2
"""Most noise of a crossing beside what all have in common, as a share of that, where the supply is noisy."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseAnalysis:
    """Crossing by crossing (U, K), where nothing else is said."""

    noise: Float
    """Relative to R0, what touch left of it in; NaN where it could not be had."""
    told: Float
    """What converter and codes explain."""
    level: Float
    """Median R/R0."""
    touched: Mask
    """Moved, and by what moved others too."""
    steps: Mask
    """Stayed where it was but for one jump of its own."""
    step_at: Counts
    step_by: Float
    upper: Float
    """(U,) noise of each upper wire over what is told, touch left out as far as can be."""
    lower: Float
    """(K,)"""
    floor: float
    """The same of all crossings together."""
    supply: float
    """Noise that all crossings have in common over what is told; 0 where they differ."""

    @property
    def is_touched(self) -> bool:
        """Whether something moved on the skin."""
        return int(self.touched.sum()) >= _TOUCHED


def analyse_noise(scans: ScanFacts) -> NoiseAnalysis:
    """Figures of each crossing over all scans. Needs LEAST_SCANS."""
    ratio = scans.ratio[scans.complete] if scans.complete.sum() >= LEAST_SCANS else scans.ratio
    ratio = ratio[-_MOST_SCANS:]
    known: Mask = np.asarray(np.isfinite(ratio).all(axis=0))
    safe = np.where(known, ratio, 1.0)
    level = np.median(safe, axis=0)
    told = np.hypot(scans.told_noise * level, scans.step / np.sqrt(12.0))
    moved = (safe - safe.mean(axis=0)) / told
    rough, alone = _roughness(safe) / told, _unexplained(moved)
    noise = np.minimum(rough, alone)
    touched = known & (moved.std(axis=0) > np.maximum(_MOVED, _EXPLAINED * alone))
    at, by, still = _steps(safe)
    common = np.median(safe[:, known], axis=1) if known.any() else np.ones(len(safe))
    supply = float(_roughness(common) / np.median(told))
    uneven = (
        float(np.median((_roughness(safe / common[:, None, None]) / told)[known])) if known.any() else 0.0
    )
    return NoiseAnalysis(
        noise=np.where(known, noise * told, np.nan),
        told=told,
        level=np.where(known, level, np.nan),
        touched=touched,
        steps=known & ~touched & (by > _STEP * told) & still,
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
    """(U, K) deviation that is left of each crossing without the leading half of the functions of time of all
    other upper wires, or of all other lower wires where that leaves more. ``moved`` has mean 0.
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
    """Of each wire of the first axis: the smaller of its floor and of its median crossing, 0 for none."""
    levels = np.zeros(moved.shape[1])
    for wire, there in enumerate(known):
        if there.any():
            floor = _floor(moved[:, wire, there], max(1, int(there.sum()) // 2))
            levels[wire] = min(floor, float(np.median(noise[wire, there])))
    return levels


def _floor(moved: Float, values: int) -> float:
    """The smallest singular values of (T, n) over those of noise of deviation 1."""
    return _smallest(moved, values) / _of_noise(moved.shape, values) if moved.shape[1] else 0.0


def _smallest(moved: Float, values: int) -> float:
    singular = np.linalg.svd(moved, compute_uv=False)[: min(len(moved) - 1, moved.shape[1])]
    return float(np.linalg.norm(singular[-values:]))


@functools.lru_cache(maxsize=64)
def _of_noise(shape: tuple[int, int], values: int) -> float:
    noise = np.random.default_rng(0).standard_normal(shape)
    return _smallest(noise - noise.mean(axis=0), values)


def _steps(safe: Float) -> tuple[Counts, Float, Mask]:
    """Where each crossing made its largest step, how large that was, and whether it is all that happened: the
    medians before and after differ by it, and little else does.
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
