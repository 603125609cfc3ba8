"""Verdicts on solved wires against the truth: accurate, flagged or wrong.

A wire in a frame is

flagged    if its status is not CONVERGED or its data failed a test (``wires_trusted``), so that no accuracy
           was claimed
accurate   if accuracy was claimed and every coordinate is within the reported uncertainty
wrong      if accuracy was claimed and an error is too large, or if it is not finite, whatever its status

With noise, an error may reach 5 reported standard deviations; chance alone puts 6e-7 of all coordinates
beyond this limit. A long run must not fail by chance, and a fault must not be attributed to chance, so each
row must meet two conditions. For errors that are Gaussian with the reported standard deviation, each
condition fails with a probability of 1e-4:

- no coordinate is beyond z(n) or 5, whichever is larger, where any of n independent coordinates exceeds z(n)
  standard deviations with probability 1e-4. z is 5.7 for 9,000 coordinates and 6.4 for 1e6 (Bonferroni's
  bound: correlation only makes it safer)
- the number of seeds with a coordinate beyond 5 is within the limit of a binomial distribution whose
  probability is the expected number of such coordinates per seed (again a bound); seeds are independent even
  though coordinates are not

If the second condition fails, every wire with an error beyond 5 is wrong. With exact data, chance plays no
part: the limit is 5 reported standard deviations or 1e-6 of the wire's largest displacement, whichever is
larger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float

LIMIT: Final = 5.0
"""Maximum error, in reported standard deviations."""
CHANCE: Final = 1e-4
"""Probability that a correct row is judged wrong: with 350 rows per run, one false alarm in 30 runs."""
EXACT_SHARE: Final = 1e-6
"""Tolerance with exact data, relative to the wire's largest displacement."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A method's estimates for the frames of a stream."""

    displacement_m: Float
    """(F, U, N, 3)"""
    std_m: Float
    """(F, U, N, 3), reported standard deviation, or a fifth of an error estimate."""
    converged: NDArray[np.bool_]
    """(F, U) wires that are CONVERGED and, if trust was assessed, trusted."""

    def equals(self, other: Solved) -> bool:
        """Return whether both results are equal, bit for bit."""
        return (
            np.array_equal(self.displacement_m, other.displacement_m, equal_nan=True)
            and np.array_equal(self.std_m, other.std_m, equal_nan=True)
            and np.array_equal(self.converged, other.converged)
        )


def beyond(deviations: float) -> float:
    """Return the probability that a normal variable is more than ``deviations`` sigma from its mean."""
    return math.erfc(deviations / math.sqrt(2.0))


def limit_of(coordinates: int) -> float:
    """Return z(n), as defined in the module docstring, for n ``coordinates``; never less than 5."""
    from scipy.special import ndtri

    if coordinates == 0:
        return LIMIT
    return max(LIMIT, float(-ndtri(0.5 * CHANCE / coordinates)))


def allowed_seeds(coordinates: int, seeds: int) -> int:
    """Return the maximum number of seeds with a coordinate beyond 5 that chance can explain."""
    from scipy.stats import binom

    if seeds == 0:
        return 0
    return int(binom.isf(CHANCE, seeds, min(1.0, coordinates / seeds * beyond(LIMIT))))


@dataclass
class Tally:
    """Accumulates one row: a case solved by one method for all seeds."""

    exact: bool
    seeds: int = 0
    wires: int = 0
    flagged: int = 0
    time_s: float = 0.0
    _coordinates: int = 0
    _errors: list[float] = field(default_factory=list)
    _reported: list[float] = field(default_factory=list)
    _worst_error: float = math.nan
    _deviations: list[tuple[float, int, int, int]] = field(default_factory=list)
    """(standard deviations, seed, frame, wire) of every wire beyond 5; inf if the wire is not finite."""

    def add(self, seed: int, solved: Solved, truth_m: Float) -> None:
        """Add a seed. ``truth_m`` (F, U, N, 3) is the truth of the frames; NaN frames are left out."""
        self.seeds += 1
        kept = np.flatnonzero(np.isfinite(truth_m).all(axis=(1, 2, 3)))
        truth_m, moved, std = truth_m[kept], solved.displacement_m[kept], solved.std_m[kept]
        converged = solved.converged[kept]
        finite = np.isfinite(moved).all(axis=(2, 3)) & ~np.isnan(std).any(axis=(2, 3))
        self.wires += converged.size
        self.flagged += int((~converged & finite).sum())
        with np.errstate(all="ignore"):
            error = np.abs(moved - truth_m)
            floor = 0.0
            if self.exact:
                floor = EXACT_SHARE / LIMIT * np.abs(truth_m).max(axis=(2, 3), keepdims=True)
            ratio = np.where(error == 0.0, 0.0, error / np.maximum(std, floor)).max(axis=(2, 3))
        ratio = np.where(finite, np.where(converged, ratio, 0.0), np.inf)
        self._coordinates += int((converged & finite).sum()) * truth_m[0, 0].size
        for frame, wire in np.argwhere(ratio > LIMIT).tolist():
            self._deviations.append((float(ratio[frame, wire]), seed, int(kept[frame]), wire))
        self._shares(np.where((converged & finite)[..., None, None], error, np.nan), std, truth_m)

    def _shares(self, error: Float, std: Float, truth: Float) -> None:
        """Add the relative error and standard deviation of the converged wires in the deepest frame.

        Both are relative to the displacement. The worst error is the largest in any frame, relative to the
        displacement in the deepest frame.
        """
        deepest = int(np.argmax(np.linalg.norm(truth.reshape(len(truth), -1), axis=1)))
        used = np.isfinite(error[deepest])
        if used.any():
            size = float(np.linalg.norm(truth[deepest][used]))
            if size > 0:
                self._errors.append(float(np.linalg.norm(error[deepest][used])) / size)
                self._reported.append(float(np.linalg.norm(std[deepest][used])) / size)
                self._worst_error = float(np.fmax(self._worst_error, self._errors[-1]))
        each = np.sqrt(np.nansum(error**2, axis=(1, 2, 3)))
        worst = float(each.max()) / float(np.linalg.norm(truth[deepest]))
        if np.isfinite(error).any():
            self._worst_error = float(np.fmax(self._worst_error, worst))

    def row(self) -> dict[str, Any]:
        """Return the figures and the verdict."""
        limit = LIMIT if self.exact else limit_of(self._coordinates)
        hit = {seed for _, seed, _, _ in self._deviations}
        by_count = self.exact or len(hit) > allowed_seeds(self._coordinates, self.seeds)
        wrong = [found for found in self._deviations if by_count or found[0] > limit]
        worst = max(self._deviations, default=None)
        return {
            "seeds": self.seeds,
            "wires": self.wires,
            "median_error": float(np.median(self._errors)) if self._errors else math.nan,
            "worst_error": self._worst_error,
            "reported": float(np.median(self._reported)) if self._reported else math.nan,
            "converged": 1.0 - self.flagged / self.wires if self.wires else math.nan,
            "accurate": self.wires - self.flagged - len(wrong),
            "flagged": self.flagged,
            "wrong": len(wrong),
            "wrong_seeds": len({seed for _, seed, _, _ in wrong}),
            "beyond_5": len(self._deviations),
            "expected_beyond_5": 0.0 if self.exact else self._coordinates * beyond(LIMIT),
            "limit": limit,
            "worst": None
            if worst is None
            else dict(zip(("deviations", "seed", "frame", "wire"), worst, strict=True)),
            "time_s": self.time_s,
        }


def named(row: Mapping[str, Any]) -> str:
    """Describe a wrong row in one line: the case, the size of the error, and how to reproduce the error."""
    worst = row["worst"]
    far = "not finite" if worst["deviations"] is None else f"{worst['deviations']:.3g} standard deviations"
    return (
        f"{row['case']} by {row['method']}: {row['wrong']} of {row['wires']} wires wrong, worst {far} "
        f"(seed {worst['seed']}, frame {worst['frame']}, wire {worst['wire']})"
    )
