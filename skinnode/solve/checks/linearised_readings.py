"""Changes in the readings of one frame, linearised at rest, and the evidence that they are due to faults.

Displacements of the electrodes change the logarithms of the readings by J u. For a converged field of the
exact inverse, J u contains all the information in the readings; for other fields, the residuals are added.
:class:`LinearisedReadings` computes these changes z in units of the noise, and the log evidence that
:mod:`skinnode.solve.checks.reading_model` assigns to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit
from skinnode.model.frames import FieldFrame
from skinnode.model.kernels import potential
from skinnode.model.layout import Float
from skinnode.solve.checks.crossed_wires import likeliest
from skinnode.solve.checks.greedy_search import crossing_gain
from skinnode.solve.checks.reading_model import ReadingModel, changes, evidences
from skinnode.solve.checks.wire_tests import GAIN_STD, LEAST, least_fitting
from skinnode.solve.linalg.cholesky import multiply, multiply_vector, solve_positive
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.wires.problem import PatchProblem

WRONG: Final = 0.1
"""Expected relative error of a wrong reading. Not tuned: reducing it to 0.01 would change the cost of a wrong
reading by only 2 nats."""
OFFSETS: Final = (0, 1, 3, 5)
"""Values of κ at which single readings are tested, in steps down from the best-fitting value."""
NOISE_RATIOS: Final = (2.0, 4.0, 8.0, 16.0)
"""Ratios of actual to stated noise that the check tries as explanations of a suspicious frame."""
COARSE: Final = 0.1
"""Assumed error of the linearised readings if several upper wires have no solution, as a fraction of the 90 %
quantile of the readings' changes since rest."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A field and the readings from which it was computed."""

    field: FieldFrame
    a: Float
    """(U, K) resistances times gain, R · gain, in the units of the :class:`PatchProblem`."""
    noise: Float
    """(U, K) relative standard deviation of the resistances R."""
    used: Mask
    """(U, K) mask of the readings used in the solve."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Largest gains in log evidence from assuming a fault, in nats."""

    readings: float
    """Gain from assuming one wrong reading or two crossed wires."""
    wires: float
    """Gain from assuming one faulty wire."""
    suspect: int
    """Index of the reading that is most likely to be wrong."""

    @property
    def largest(self) -> float:
        """Larger of the two gains."""
        return max(self.readings, self.wires)


class LinearisedReadings:
    """Linearised changes in the readings of one frame at a time. Each stream needs its own instance.

    Args:
        problem: The patch.
        model_std: Standard deviation of the forward model's error, relative to the largest change in a
            reading; 0 if the patch matches its layout exactly.
        drift: Expected gain errors: ``none``, ``patch`` (one error for the patch) or ``wire`` (one for each
            upper wire).

    Attributes:
        model: Joint distribution of the readings.
        z: (U, K) changes in units of their noise.
        sigma: Relative noise of the readings.
        present: (U, K) mask of the readings to use.
        evidence: (L,) log evidence of the changes at each κ.
        best: Index of the κ with the largest log evidence.
    """

    def __init__(self, problem: PatchProblem, model_std: float, drift: str) -> None:
        self._problem, self._model_std, self._drift = problem, model_std, drift
        self.model = ReadingModel.of(problem.layout)
        shape = problem.layout.shape
        self.z, self._f = np.empty(shape), np.empty(shape)
        self._c = np.empty((2, self.z.size))
        self._numbers = np.empty(len(OFFSETS), np.int64)
        self._weights, self._alpha = np.empty((2, len(OFFSETS), self.z.size))
        self._row = np.empty(max(shape))
        self.evidence = np.empty(len(self.model.kappa))
        self._all = np.ones(shape, bool)
        self.present: Mask = self._all
        self.sigma, self.best = 1.0, 0

    def compile(self) -> None:
        """Compile the kernels."""
        shape, free = self.z.shape, self.model.jacobian.shape[2]
        at_rest = np.zeros((shape[0], free))
        self.set_change(at_rest, 1.0)
        self._residuals(at_rest, np.ones(shape), np.ones(shape[0], bool))
        self.gains()
        self.reading_gain()
        self.present = np.ones(shape, bool)
        self.present[0, 0] = False
        self._fit()

    @property
    def cost(self) -> float:
        """Log evidence subtracted for each wrong reading, in nats."""
        return math.log(max(WRONG / self.sigma, math.e))

    def set_complete(self, solved: Solved) -> None:
        """Compute the changes since rest in a frame that the exact inverse solved with all readings.

        The result is the same as that of :meth:`set_frame`, but takes less time to compute.
        """
        if self._drift != "none":
            self.set_frame(solved, self._all)
            return
        moved = solved.field.displacement_m.reshape(self.z.shape[0], -1)
        sigma, pitch = float(np.median(solved.noise)), self._problem.layout.pitch_m
        changes(self.model.jacobian, moved, sigma * pitch, self.z)
        if self._model_std > 0.0:
            ratio = math.hypot(1.0, self._model_std * float(np.abs(self.z).max()))
            self.z /= ratio
            sigma *= ratio
        self.sigma, self.present = sigma, self._all
        self._fit()

    def set_change(self, change_m: Float, noise: float) -> None:
        """Compute the changes in the readings between two complete fields.

        Args:
            change_m: (U, 3N) change in the displacement, in metres.
            noise: Relative noise of the readings of either field.
        """
        self.sigma, self.present = math.sqrt(2.0) * noise, self._all
        changes(self.model.jacobian, change_m, self.sigma * self._problem.layout.pitch_m, self.z)
        self._fit()

    def set_frame(self, solved: Solved, present: Mask) -> None:
        """Compute the changes in a frame since rest, linearised about its field."""
        field, layout = solved.field, self._problem.layout
        sigma = float(np.median(solved.noise[present]))
        moved = field.displacement_m.reshape(layout.shape[0], -1) / layout.pitch_m
        changes(self.model.jacobian, moved, 1.0, self.z)
        if self._model_std > 0.0:
            sigma = math.hypot(sigma, self._model_std * float(np.abs(self.z[present]).max()))
        inexact = np.ones(len(moved), bool) if field.method == "posterior" else field.by_prior
        if inexact is not None and inexact.any():
            self.z[inexact] -= self._residuals(moved, solved.a, inexact)
            if field.gain is not None:
                self.z[inexact] += field.gain[inexact, None]
        self.z /= sigma
        self.sigma, self.present = sigma, present
        self.z[~present] = 0.0
        if self._drift != "none":
            self._remove_gain(GAIN_STD / sigma)
        self._fit()

    def set_raw(self, solved: Solved) -> bool:
        """Compute the changes from the ratios of rest readings to current readings, without a field.

        Returns:
            False if fewer than half of the readings are usable, in which case the changes are not valid.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            np.log(self._problem.a_rest / solved.a, out=self.z)
        self.present = solved.used & np.isfinite(self.z)
        self.z[~self.present] = 0.0
        if np.count_nonzero(self.present) < 0.5 * self.present.size:
            return False
        sigma = COARSE * float(np.quantile(np.abs(self.z[self.present]), 0.9))
        self.sigma = max(sigma, float(np.median(solved.noise[self.present])))
        self.z /= self.sigma
        self._fit()
        return True

    def gains(self) -> Gains:
        """Return the largest gains in log evidence from assuming a fault."""
        reading, suspect = self._reading_gain(len(OFFSETS))
        level, alpha = self.model.level(self.best), self._alpha[0]
        crossed, _ = likeliest(level.precision, alpha, self.z, self.present, enough=reading)
        found = least_fitting(level.wires, self.z.ravel(), alpha, self.present, self.sigma, self._row)
        return Gains(crossed, found.gain, suspect)

    def reading_gain(self) -> tuple[float, int]:
        """Return the largest gain from assuming one wrong reading at the best κ, and the reading's index."""
        return self._reading_gain(1)

    def noisier(self) -> float:
        """Return the log evidence of the frame, assuming that its noise is above the stated level.

        If the noise is ``ratio`` times the stated noise, the log evidence is that of z / ratio, minus
        ln(ratio) for each reading.
        """
        squares = -2.0 * self.evidence - self.model.log_det  # zᵀ P z at each κ
        most = -math.inf
        for ratio in NOISE_RATIOS:
            of_ratio = -0.5 * (squares / ratio**2 + self.model.log_det)
            most = max(most, float(of_ratio.max()) - self.z.size * math.log(ratio))
        return most - math.log(len(NOISE_RATIOS))

    def deviations(self, solved: Solved) -> tuple[Float, Mask]:
        """Return the deviations (U, K) of all readings from the field of a frame, in standard deviations.

        Also returns a (U, K) mask of the valid deviations. Invalid deviations are infinite.
        """
        layout = self._problem.layout
        moved = solved.field.displacement_m.reshape(layout.shape[0], -1) / layout.pitch_m
        residual = self._residuals(moved, solved.a, np.ones(len(moved), bool))
        std = solved.field.displacement_std_m.reshape(layout.shape[0], -1) / layout.pitch_m
        with np.errstate(invalid="ignore", over="ignore"):
            spread = np.einsum("ukn,un->uk", self.model.jacobian**2, np.minimum(std, 1e3) ** 2)
            deviation = residual / np.sqrt(spread + solved.noise**2)
        known = np.isfinite(deviation) & (solved.noise > 0)
        return np.where(known, deviation, np.inf), known

    def _reading_gain(self, count: int) -> tuple[float, int]:
        """Return the largest gain from one wrong reading at the first ``count`` :data:`OFFSETS`."""
        model = self.model
        gain, where = _largest_gain(
            model.vectors_t, model.shrink, model.diagonals, self.evidence, self._c[0], self.present.ravel(),
            self.best, self.cost, self._numbers[:count], self._weights, self._alpha,
        )  # fmt: skip
        return gain, int(where)

    def _remove_gain(self, std: float) -> None:
        """Estimate the remaining gain errors with the prior N(0, ``std``²) and subtract them from ``z``.

        The solver underestimates gain errors, because its prior attributes part of each error to a
        displacement of the wire.
        """
        upper, lower = self.z.shape
        self._fit()
        p = self.model.level(self.best).precision
        alpha = np.empty(self.z.size)
        multiply_vector(p, self.z.ravel(), alpha)
        sums = alpha.reshape(upper, lower).sum(axis=1)
        blocks = p.reshape(upper, lower, upper, lower).sum(axis=(1, 3))
        if self._drift == "wire":
            self.z -= np.linalg.solve(blocks + np.eye(upper) / std**2, sums)[:, None]
        else:
            self.z -= sums.sum() / (blocks.sum() + 1.0 / std**2)
        self.z[~self.present] = 0.0

    def _residuals(self, moved: Float, a: Float, wires: Mask) -> Float:
        """Return the residuals a F − 1 (n, K) of the n upper wires in the mask ``wires`` (U,)."""
        for u in np.flatnonzero(wires).tolist():
            potential(self._problem.rest[u] + moved[u], self._problem.lower, self._f[u])
        return np.asarray(a[wires] * self._f[wires] - 1.0)

    def _fit(self) -> None:
        """Fill in missing readings, compute the log evidence at every κ, and find the best κ."""
        model, z = self.model, self.z.ravel()
        self.best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self.evidence)
        missing = np.flatnonzero(~self.present) if self.present is not self._all else ()
        if len(missing):  # replace missing readings with their conditional means
            p, count = model.level(self.best).precision[missing], len(missing)
            block, unknown = np.ascontiguousarray(p[:, missing]), np.empty(count)
            block.flat[:: count + 1] += LEAST
            multiply_vector(p, z, unknown)
            if solve_positive(block, unknown, count):
                z[missing] = -unknown
                self.best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self.evidence)


@njit
def _largest_gain(  # noqa: PLR0913 - a kernel: arrays by name
    vectors_t: Float,
    shrink: Float,
    diagonals: Float,
    evidence: Float,
    c: Float,
    present: Mask,
    best: int,
    cost: float,
    numbers: Index,
    weights: Float,
    alpha: Float,
) -> tuple[float, int]:
    """Return the largest gain from one wrong reading over several κ, and the reading's index.

    The gain is relative to the log evidence at the best κ. Writes the indices of the κ into ``numbers`` (n,)
    and α = P z at each κ into the rows of ``alpha`` (≥ n, m). With the eigenvectors V and the components
    ``c`` (m,) of z along them, α = V diag(shrink) c, so that one matrix serves every κ. ``weights`` (≥ n, m)
    is a work array.
    """
    used = 0
    for k in range(len(numbers)):
        offset = OFFSETS[k]
        if best >= offset:
            numbers[used] = best - offset
            for i in range(c.size):
                weights[used, i] = shrink[best - offset, i] * c[i]
            used += 1
    multiply(weights[:used], vectors_t, alpha[:used])
    gain, where = -math.inf, -1
    for j in range(used):
        number = numbers[j]
        here, reading = crossing_gain(diagonals[number], alpha[j], present, cost)
        here += evidence[number] - evidence[best]
        if here > gain:
            gain, where = here, reading
    return gain, where
