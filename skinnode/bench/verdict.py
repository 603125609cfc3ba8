"""Compares solved displacements with the true displacements, and assigns a verdict to each wire.

Each wire of a frame receives one of three verdicts:

flagged    The status is not CONVERGED, or the data failed a test (``wires_trusted``).
accurate   The wire is not flagged, and every coordinate is within the reported uncertainty.
wrong      The wire is not flagged, but an error is too large; or (with any status) a value is not finite.

With noise, errors of up to 5 reported standard deviations are accepted; 6e-7 of all coordinates exceed this
limit by chance. A long run must neither fail by chance nor miss a real defect. Each row of the report is
therefore tested against two conditions. If the errors are Gaussian with the reported standard deviation, a
row violates each condition with a probability of 1e-4.

- No error exceeds the larger of 5 and z(n) standard deviations, where n is the number of coordinates. The
  largest of n independent errors exceeds z(n) with a probability of 1e-4; z(n) is 5.7 for 9,000 coordinates
  and 6.4 for 1e6. This is the Bonferroni bound: correlated errors exceed it less often.
- The number of seeds with an error above 5 standard deviations does not exceed a quantile of the binomial
  distribution. The probability per seed is bounded by the expected number of such errors in a seed. The test
  counts seeds, not coordinates, because only seeds are independent.

If too many seeds have an error above 5 standard deviations, every wire with such an error is given the
verdict ``wrong``. With exact data, no error is attributed to chance: the limit is 5 reported standard
deviations or 1e-6 of the wire's largest displacement, whichever is larger.
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
"""Probability of a false alarm in a row of the report; about 1/30 in a run of 350 rows."""
EXACT_SHARE: Final = 1e-6
"""Maximum error with exact data, relative to the wire's largest displacement."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Displacements and standard deviations computed by a method for the frames of a stream."""

    displacement_m: Float
    """(F, U, N, 3)"""
    std_m: Float
    """(F, U, N, 3), metres: reported standard deviation. For path methods, the value is the error estimate
    divided by 5."""
    converged: NDArray[np.bool_]
    """(F, U) bool: True for a wire that is CONVERGED and, if trust was assessed, trusted."""

    def equals(self, other: Solved) -> bool:
        """Return whether the two results are bitwise equal."""
        return (
            np.array_equal(self.displacement_m, other.displacement_m, equal_nan=True)
            and np.array_equal(self.std_m, other.std_m, equal_nan=True)
            and np.array_equal(self.converged, other.converged)
        )


def beyond(deviations: float) -> float:
    """Return the two-sided Gaussian tail probability beyond ``deviations`` standard deviations."""
    return math.erfc(deviations / math.sqrt(2.0))


def limit_of(coordinates: int) -> float:
    """Return the larger of 5 and z(n) for n = ``coordinates``; the module docstring defines z(n)."""
    from scipy.special import ndtri

    if coordinates == 0:
        return LIMIT
    return max(LIMIT, float(-ndtri(0.5 * CHANCE / coordinates)))


def allowed_seeds(coordinates: int, seeds: int) -> int:
    """Return the number of seeds that may have an error above 5 standard deviations by chance."""
    from scipy.stats import binom

    if seeds == 0:
        return 0
    return int(binom.isf(CHANCE, seeds, min(1.0, coordinates / seeds * beyond(LIMIT))))


@dataclass
class Tally:
    """Accumulates the results of one method on all streams of a case, for one row of the report."""

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
    """Wires with an error above :data:`LIMIT`: (error in standard deviations or inf, seed, frame, wire)."""

    def add(self, seed: int, solved: Solved, truth_m: Float) -> None:
        """Add the result for a seed, ignoring frames whose (F, U, N, 3) true displacement is NaN."""
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
        """Add the error and standard deviation of the converged wires in the frame with the deepest press.

        Both are divided by the displacement in that frame. The worst error is the largest error in any frame,
        divided by the same displacement.
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
        """Return the accumulated statistics and the number of wires for each verdict."""
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
    """Describe a wrong row in one line: case, method, largest error, and where it occurred."""
    worst = row["worst"]
    far = "not finite" if worst["deviations"] is None else f"{worst['deviations']:.3g} standard deviations"
    return (
        f"{row['case']} by {row['method']}: {row['wrong']} of {row['wires']} wires wrong, worst {far} "
        f"(seed {worst['seed']}, frame {worst['frame']}, wire {worst['wire']})"
    )
