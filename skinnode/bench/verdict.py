"""Judges solved wires by comparison with the truth.

Each wire of a frame receives one of three verdicts:

flagged    no accuracy was claimed, because the status is not CONVERGED or the data failed a test
           (``wires_trusted``)
accurate   accuracy was claimed, and every coordinate is within the reported uncertainty
wrong      accuracy was claimed but an error is too large, or, whatever the status, a value is not finite

With noise, an error may reach 5 reported standard deviations; 6e-7 of all coordinates exceed this limit by
chance alone. A long run must not fail by chance, and a fault must not be attributed to chance. Each row must
therefore meet two conditions. If errors are Gaussian with the reported standard deviation, each condition
fails with a probability of 1e-4:

- No coordinate exceeds z(n) or 5 standard deviations, whichever is larger. z(n) is the limit that any of n
  independent coordinates exceeds with probability 1e-4: 5.7 for 9,000 coordinates and 6.4 for 1e6. The
  limit is Bonferroni's bound; correlated coordinates only decrease the probability.
- The number of seeds with an error beyond 5 standard deviations is within the limit of a binomial
  distribution. The probability of the distribution is the expected number of such errors per seed (an upper
  bound). Seeds are independent even though coordinates are not.

If the second condition fails, every wire with an error beyond 5 standard deviations is wrong. With exact
data, chance plays no role: the limit is 5 reported standard deviations or 1e-6 of the wire's largest
displacement, whichever is larger.
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
"""Maximum error of a coordinate, in reported standard deviations."""
CHANCE: Final = 1e-4
"""Probability that a correct row is judged wrong; 350 rows per run cause one false alarm in 30 runs."""
EXACT_SHARE: Final = 1e-6
"""Maximum error with exact data, relative to the wire's largest displacement."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A method's estimates for the frames of a stream."""

    displacement_m: Float
    """(F, U, N, 3)"""
    std_m: Float
    """(F, U, N, 3), reported standard deviation, metres; for paths, a fifth of the error estimate."""
    converged: NDArray[np.bool_]
    """(F, U), whether a wire is CONVERGED and, if trust was assessed, trusted."""

    def equals(self, other: Solved) -> bool:
        """Return whether both results are bitwise equal."""
        return (
            np.array_equal(self.displacement_m, other.displacement_m, equal_nan=True)
            and np.array_equal(self.std_m, other.std_m, equal_nan=True)
            and np.array_equal(self.converged, other.converged)
        )


def beyond(deviations: float) -> float:
    """Return the probability that a Gaussian error exceeds ``deviations`` standard deviations."""
    return math.erfc(deviations / math.sqrt(2.0))


def limit_of(coordinates: int) -> float:
    """Return the limit z(n), as defined in the module docstring, for n ``coordinates``; at least 5."""
    from scipy.special import ndtri

    if coordinates == 0:
        return LIMIT
    return max(LIMIT, float(-ndtri(0.5 * CHANCE / coordinates)))


def allowed_seeds(coordinates: int, seeds: int) -> int:
    """Return the maximum number of seeds in which chance can explain an error beyond 5 deviations."""
    from scipy.stats import binom

    if seeds == 0:
        return 0
    return int(binom.isf(CHANCE, seeds, min(1.0, coordinates / seeds * beyond(LIMIT))))


@dataclass
class Tally:
    """Accumulates the row of the report for one case and one method, over all seeds."""

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
    """Wires with an error beyond :data:`LIMIT`: (error in deviations or inf, seed, frame, wire)."""

    def add(self, seed: int, solved: Solved, truth_m: Float) -> None:
        """Add a seed's result; frames whose true displacement ``truth_m`` (F, U, N, 3) is NaN are ignored."""
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
        """Add the error and standard deviation of the converged wires in the deepest frame.

        Error and standard deviation are relative to the displacement in the deepest frame, as is the worst
        error, which is the largest error in any frame.
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
        """Return the accumulated figures, and the numbers of wires by verdict."""
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
    """Describe a wrong row in one line: the case, the size of the error, and how to reproduce it."""
    worst = row["worst"]
    far = "not finite" if worst["deviations"] is None else f"{worst['deviations']:.3g} standard deviations"
    return (
        f"{row['case']} by {row['method']}: {row['wrong']} of {row['wires']} wires wrong, worst {far} "
        f"(seed {worst['seed']}, frame {worst['frame']}, wire {worst['wire']})"
    )
