"""Scores decoded fields: compares their errors with the reported uncertainty and the Cramér-Rao bound.

The bound applies to a single scan. Let J be the Jacobian of a wire's relative residuals F/b − 1 at the true
position, and S the diagonal matrix of their standard deviations. Every unbiased estimator of the electrode
positions then has a covariance of at least J⁻¹ S Sᵀ J⁻ᵀ. The bound is computed with the NumPy reference model
and is thus independent of the solver.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from skinnode.model.forward import jacobian, potential_per_m
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float, PatchLayout

OUTLIER_DEVIATIONS = 6.0
"""Maximum permissible error of a coordinate, in reported standard deviations. A run scores about 1e5
coordinates, so one run in 5,000 exceeds this limit by chance."""

EXCESS_LIMIT = 1.15
"""Maximum permissible ratio of a run's RMS error to its RMS reported standard deviation."""


def bound_std_m(layout: PatchLayout, upper_m: Float, relative_std: Float) -> Float:
    """Return the (U, N, 3) Cramér-Rao bounds on the coordinates' standard deviations, in metres.

    Args:
        layout: The patch.
        upper_m: (U, N, 3), metres: electrode positions.
        relative_std: (U, K) relative standard deviations of the resistances.

    Returns:
        (U, N, 3), metres: the bounds; inf for wires with a singular Jacobian.
    """
    potential = potential_per_m(layout, upper_m)
    slopes = jacobian(layout, upper_m).reshape(*layout.shape, layout.unknowns)
    bound = np.full((layout.shape[0], layout.unknowns), np.inf)
    for wire, slope in enumerate(slopes):
        whitened = slope / (potential[wire] * relative_std[wire])[:, None]
        _, singular, right = np.linalg.svd(whitened, full_matrices=False)
        if len(singular) == layout.unknowns and singular[-1] > 1e-14 * singular[0]:
            bound[wire] = np.linalg.norm(right / singular[:, None], axis=0)
    return bound.reshape(layout.upper_m.shape)


@dataclass(frozen=True, slots=True)
class Score:
    """Results of one patch in a run. Lengths are in metres; they are NaN if no scan was scored."""

    scans: int
    untrusted: int
    """Number of scans with an untrusted field; all other results exclude them."""
    deepest_m: float
    """Largest absolute component of any true electrode displacement."""
    error_rms_m: float
    reported_rms_m: float
    bound_rms_m: float
    """RMS Cramér-Rao bound due to quantization alone, as if the converter were noise-free."""
    error_max_m: float
    relative_error: float
    """Relative error ‖X − X*‖ / ‖X* − X(0)‖ of the scan with the largest true displacement."""
    coverage95: float
    """Fraction of coordinates whose error is within the reported 95 % interval."""
    worst_deviations: float
    """Largest error of a coordinate, in reported standard deviations."""

    @property
    def within_uncertainty(self) -> bool:
        """Whether all scans were trusted and all errors are consistent with the reported uncertainty."""
        return (
            self.scans > 0
            and self.untrusted == 0
            and self.error_rms_m <= EXCESS_LIMIT * self.reported_rms_m
            and self.worst_deviations <= OUTLIER_DEVIATIONS
        )


@dataclass
class Scorer:
    """Scores one patch during a run; ``code_std`` is the standard deviation of R/R0 due to quantization."""

    layout: PatchLayout
    code_std: float
    bound_every: int = 10
    """The Cramér-Rao bound is computed only for every ``bound_every``-th scan, because it changes slowly."""
    _scans: int = 0
    _untrusted: int = 0
    _squares: float = 0.0
    _variances: float = 0.0
    _bound_at: list[Float] = field(default_factory=list)
    _largest: float = 0.0
    _covered: int = 0
    _worst: float = 0.0
    _deepest: tuple[float, float] = (0.0, float("nan"))

    def add(self, frame: FieldFrame, true_upper_m: Float) -> float:
        """Compare a scan with the (U, N, 3) true positions in metres; return its RMS error in metres."""
        truth = true_upper_m - self.layout.upper_m
        error = frame.displacement_m - truth
        rms = float(np.sqrt(np.mean(error**2)))
        if not frame.trusted:
            self._untrusted += 1
            return rms
        std = frame.displacement_std_m
        deviations = np.abs(error) / std
        if self._scans % self.bound_every == 0:
            self._bound_at.append(true_upper_m)
        self._scans += 1
        self._squares += float(np.mean(error**2))
        self._variances += float(np.mean(std**2))
        self._covered += int((np.abs(error) <= frame.half_width_95_m).sum())
        self._largest = max(self._largest, float(np.abs(error).max()))
        self._worst = max(self._worst, float(deviations.max()))
        depth = float(np.abs(truth).max())
        if depth > self._deepest[0]:
            self._deepest = depth, float(np.linalg.norm(error) / np.linalg.norm(truth))
        return rms

    def score(self) -> Score:
        """Return the score of all scans added so far."""
        count = self._scans or float("nan")
        at_rest = potential_per_m(self.layout, self.layout.upper_m)
        bounds = [
            # The relative standard deviation of R is code_std R0 / R = code_std F / F0.
            bound_std_m(self.layout, upper_m, self.code_std * potential_per_m(self.layout, upper_m) / at_rest)
            for upper_m in self._bound_at
        ]
        return Score(
            scans=self._scans,
            untrusted=self._untrusted,
            deepest_m=self._deepest[0],
            error_rms_m=float(np.sqrt(self._squares / count)),
            reported_rms_m=float(np.sqrt(self._variances / count)),
            bound_rms_m=float(np.sqrt(np.mean(np.square(bounds)))) if bounds else float("nan"),
            error_max_m=self._largest,
            relative_error=self._deepest[1],
            coverage95=self._covered / (count * self.layout.upper_m.size),
            worst_deviations=self._worst,
        )
