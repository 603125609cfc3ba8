"""Observation model of a frame: residuals, weights, and the effects of the nuisances.

Each wire has the residual r = w (a F(x) − 1) with w = 1/σ. In the model, r(x) − H g is noise of variance 1,
where H is the effect of the nuisances g ~ N(0, diag(d)). The nuisances are gain errors of the patch or of
each wire (drift), a forward-model error proportional to the change in each resistance, and geometry errors.
For the geometry errors, H depends on the displacement (:mod:`skinnode.solve.posterior.geometry_error`).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
from skinnode.model.tolerances import EXACT, Tolerances
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior import geometry_error
from skinnode.solve.wires.problem import PatchProblem


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Resistances of one frame, in the units of :class:`PatchProblem`."""

    a: Float
    """(U, K) resistances times gain, R · gain; the value at rest where a resistance is unusable."""
    noise: Float
    """(U, K) relative standard deviation of the resistances R."""
    usable: NDArray[np.bool_]
    """(U, K) mask of the usable resistances."""

    def without(self, wires: list[int]) -> Readings:
        """Return a copy in which the readings of ``wires`` are unusable."""
        usable = self.usable.copy()
        usable[wires] = False
        return Readings(self.a, self.noise, usable)

    def except_for(self, left_out: NDArray[np.bool_]) -> Readings:
        """Return a copy in which the readings selected by the mask ``left_out`` (U, K) are unusable."""
        return Readings(self.a, self.noise, self.usable & ~left_out)


@dataclass
class Observation:
    """Estimator input for one frame, with U wires, K resistances per wire and p nuisances."""

    a: Float
    """(U, K) resistances times gain, R · gain."""
    weight: Float
    """(U, K) weights 1/σ of the resistances; 0 where a resistance is missing."""
    h: Float
    """(U, K, p) H: effect of a unit of each nuisance on the residuals, without the geometry errors."""
    d: Float
    """Prior variances of the p nuisances, followed by those of the geometry errors."""

    @functools.cached_property
    def count(self) -> Index:
        """(U,) number of usable resistances of each wire."""
        return np.asarray(np.count_nonzero(self.weight, axis=1))


class ObservationModel:
    """Converts readings to observations.

    Args:
        problem: The patch.
        drift: ``none``, ``patch`` (one gain error) or ``wire`` (one gain error per upper wire).
        drift_std: Prior standard deviation of a gain error.
        model_error: Standard error of the forward model, as a fraction of the change in each resistance.
        tolerances: Manufacturing tolerances of the patch.

    Attributes:
        gains: Number of gain errors; these are the first nuisances.
        fixed: Number p of nuisances whose H does not depend on the displacement.
        variance: Prior variances of the p nuisances, followed by those of the geometry errors.
    """

    def __init__(
        self,
        problem: PatchProblem,
        drift: str,
        drift_std: float,
        model_error: float,
        tolerances: Tolerances = EXACT,
    ) -> None:
        wires = len(problem.rest)
        self._problem = problem
        self._drift, self._model_error = drift, model_error
        self._wires = np.arange(wires)
        self.gains = {"none": 0, "patch": 1, "wire": wires}[drift]
        self.variance = np.full(self.gains + (model_error > 0), drift_std**2)
        if model_error > 0:
            self.variance[-1] = model_error**2
        self.fixed = self.variance.size
        if not tolerances.exact:
            geometry = geometry_error.nuisances(*problem.layout.shape)
            self.variance = np.concatenate([self.variance, np.ones(geometry)])

    def observe(self, readings: Readings, noise_factor: float) -> Observation:
        """Return the observation of a frame whose noise is ``noise_factor`` times that of the readings."""
        a = readings.a
        change = a / self._problem.a_rest - 1.0
        variance = (noise_factor * readings.noise) ** 2 + 0.5 * (self._model_error * change) ** 2
        weight = np.where(readings.usable, 1.0 / np.sqrt(variance), 0.0)
        h = np.zeros((*a.shape, self.fixed))
        if self._drift == "patch":
            h[..., 0] = weight
        elif self._drift == "wire":
            h[self._wires, :, self._wires] = weight
        if self._model_error > 0:
            h[..., -1] = weight * change
        return Observation(a, weight, h, self.variance)


def eased(observation: Observation, level: float) -> Observation:
    """Return a copy with additional noise of relative standard deviation ``level``, for annealing."""
    weight = observation.weight
    loose = 1.0 / np.hypot(
        level, np.divide(1.0, weight, out=np.full_like(weight, math.inf), where=weight > 0)
    )
    share = np.divide(loose, weight, out=np.zeros_like(weight), where=weight > 0)
    return Observation(observation.a, loose, observation.h * share[..., None], observation.d)
