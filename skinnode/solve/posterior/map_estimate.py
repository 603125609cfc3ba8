"""MAP estimate for one frame, computed by Gauss-Newton steps, chord steps and annealing.

- Chord steps start at the last field and reuse the factors of an earlier frame. A typical solve needs two
  evaluations of F and its Jacobian.
- A Gauss-Newton step computes new factors at the current field, and is followed by chord steps.
- Annealing starts at rest with an assumed noise of 3 %, which is divided by four in each step until it
  reaches the actual noise. At high noise, the posterior has a single maximum, near the maximum of the prior.
  Following this maximum as the noise decreases usually leads to the correct maximum, even if a press indents
  the layer by 70 % of its thickness within one frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.model.tolerances import EXACT, Tolerances
from skinnode.process.clock import perf_counter
from skinnode.solve import roots
from skinnode.solve.linalg.cholesky import (
    cholesky,
    inverse_diagonal,
    multiply,
    multiply_vector,
    solve_lower,
    solve_lower_transposed_vector,
    solve_lower_vector,
)
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior import geometry_error
from skinnode.solve.posterior import measurement_update as kernels
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.posterior.gating import Fit
from skinnode.solve.posterior.geometry_error import EFFECTS, GeometryError
from skinnode.solve.posterior.load_prior import LoadPrior
from skinnode.solve.posterior.observation import Observation, eased
from skinnode.solve.wires.problem import PatchProblem

ANNEAL_NOISE: Final = 0.03
"""Relative noise at the start of annealing. At this noise, a single Gauss-Newton step from rest almost
reaches the maximum."""
ANNEAL_RATIO: Final = 4.0
"""Factor by which each annealing step reduces the noise. In tests with 80 presses of up to 70 % of h,
annealing reached the correct maximum in all cases with a factor of 3, and in 79 cases with a factor of 5."""
SETTLED: Final = 0.02
"""Convergence tolerance of chord steps: RMS of the step, relative to the RMS standard deviation."""
CHORDS: Final = 4
"""Maximum number of chord steps per factorisation."""
CHORD_RATE: Final = 0.35
"""Maximum ratio of the sizes of two successive chord steps. If convergence is slower, a new factorisation is
cheaper than further chord steps. A factorisation costs as much as ten chord steps."""
NEWTONS: Final = 12
"""Maximum number of factorisations in a solve that starts near the maximum. One or two are typical; more are
needed if full steps oscillate."""
NEWTONS_MADE: Final = 40
"""Maximum number of factorisations in a solve with geometry errors. Such solves converge slowly, because the
maximum of the posterior is at the end of a curved ridge."""
FLAT: Final = 0.1
"""Convergence tolerance of a solve with geometry errors: decrease in −2 log posterior over :data:`FLAT_STEPS`
factorisations."""
FLAT_STEPS: Final = 4
"""Number of factorisations over which the decrease in −2 log posterior is measured."""
EFFECT_STEP: Final = 0.2
"""Relative change in the effects of the geometry errors (root sum of squares) above which the factors are
recomputed. Below this limit, the standard deviations change by less than 20 %."""
HALVINGS: Final = 6
"""Maximum number of times a Gauss-Newton step is halved."""


class MapEstimator:
    """MAP estimator of one patch; stores the displacement, the nuisances and the last factors.

    Each stream needs its own instance.

    Args:
        problem: The patch.
        elastic: Elastic prior of the patch.
        free: (f,) indices of the free coordinates of a wire.
        nuisances: Number p of nuisances, excluding the geometry errors.
        tolerances: Manufacturing tolerances of the patch.

    Attributes:
        load_prior: Prior for the loads and of the displacement.
        free: (f,) indices of the free coordinates of a wire.
        moved: (U, 3N) displacement, in pitches; 0 for fixed coordinates.
        g: The p nuisances, followed by the geometry errors.
        members: Wires whose equations are in the factors.
        factors: Serial number of the current factors.
        evaluations: Number of evaluations of F and its Jacobian, per wire. The caller resets the counter.
        factorisations: Number of factorisations. The caller resets the counter.
        until: Deadline on the clock :func:`skinnode.process.clock.perf_counter`, in s. A solve that exceeds
            the deadline raises TimeoutError.
    """

    def __init__(
        self,
        problem: PatchProblem,
        elastic: ElasticPrior,
        free: Index,
        nuisances: int,
        tolerances: Tolerances = EXACT,
    ) -> None:
        wires, equations = problem.layout.shape
        coordinates = problem.layout.unknowns
        every = (np.arange(wires)[:, None] * coordinates + free).ravel()
        self._problem, self.free = problem, free
        self.load_prior = LoadPrior(elastic, every)
        self._geometry = None if tolerances.exact else GeometryError(problem, elastic, tolerances)
        effects = 0 if self._geometry is None else EFFECTS
        self._b = kernels.without_factors(
            kernels.make_buffers(wires, equations, coordinates, free.size, nuisances, effects)
        )
        self._rows = len(self._b.v) // wires
        self._reach = roots.NEAR * float(problem.clearance.min())
        self._enough = math.inf, math.inf  # limits of the convergence tolerance; see _is_enough
        self._at_rest = np.zeros((wires, equations)), np.zeros((wires, coordinates, equations))
        kernels.potentials(np.arange(wires), problem.rest.copy(), problem.lower, *self._at_rest)
        self.g = np.zeros(nuisances + (geometry_error.nuisances(wires, equations) if effects else 0))
        self._fixed = nuisances
        self._scratch = np.zeros((EFFECTS, wires * free.size))
        self._correction = np.zeros(wires * free.size + self.g.size)
        self._every = np.arange(wires)
        self.moved = np.zeros((wires, coordinates))
        self._std, self._core, self._whole_std = np.full((3, wires, free.size), np.inf)
        self._noise_variance, self._no_noise = np.zeros((2, wires * free.size))
        self._unfinished: tuple[Float, float, float] | None = None  # see _measure
        self._gamma: float | None = None
        self.members: Index = np.arange(0)
        self._factored: tuple[Float, float, int] | None = None  # weight, s², version of the prior
        self.evaluations = self.factorisations = 0
        self.factors = 0
        self.until = math.inf
        self.reset(1.0)

    @property
    def equations(self) -> int:
        """Total number of equations of all wires after the QR reduction."""
        return len(self._b.v)

    @property
    def std(self) -> Float:
        """Standard deviations (U, f) from the last factors, in pitches."""
        self._finish_measuring()
        return self._std

    @property
    def core(self) -> Float:
        """Standard deviations (U, f) for the 95 % interval, assuming smooth bodies, in pitches."""
        self._finish_measuring()
        return self._core

    @property
    def noise_variance(self) -> Float:
        """Variance (U f,) of the displacement due to noise and nuisances, in pitch²."""
        self._finish_measuring()
        return self._noise_variance

    @property
    def factored_rows(self) -> int:
        """Number of equations in the current factors."""
        return self.members.size * self._rows

    def reset(self, scale2: float) -> None:
        """Return to rest, and expect equal loads everywhere with s² = ``scale2`` in pitch².

        The factors' memory is freed, so that a hand needs memory only for the patches in contact.
        """
        self.moved[:] = 0.0
        self.g[:] = 0.0
        self.forget_factors()
        self.load_prior.spread(scale2)
        self._b = kernels.without_factors(self._b)

    def forget_factors(self) -> None:
        """Discard the factors and the standard deviations."""
        self._std[:] = np.inf
        self._core[:] = np.inf
        self._enough = math.inf, math.inf
        self._unfinished = None
        self._factored = None

    # -- solving ---------------------------------------------------------------------------------------

    def track(
        self, observation: Observation, members: Index, is_near_enough: Callable[[], bool] = lambda: False
    ) -> bool:
        """Solve from the current displacement, using the equations of the wires ``members`` (P,).

        Args:
            observation: The frame.
            members: Wires whose equations are used.
            is_near_enough: Function that returns whether a Gauss-Newton step suffices, because the prior will
                change. In this case, there are no standard deviations.

        Returns:
            True if the solve converged; False if it found no maximum nearby.
        """
        if self._fits(observation, members) and self._settle(observation) and self._effects_fit():
            return True
        heights = []
        for _ in range(NEWTONS if self._geometry is None else NEWTONS_MADE):
            before = self.moved.copy(), self.g.copy()
            size = self._newton(observation, members)
            if not size <= self._reach:
                return False
            self._shorten(observation, *before)
            if is_near_enough():
                self.forget_factors()
                return True
            self._measure(observation)
            if self._settle(observation):
                return True
            if self._geometry is not None:
                heights.append(self.objective(observation))
                if len(heights) > FLAT_STEPS and heights[-1 - FLAT_STEPS] - heights[-1] < FLAT:
                    return True
        return False

    def anneal(self, observation: Observation, members: Index) -> bool:
        """Solve from rest while reducing the noise from :data:`ANNEAL_NOISE` to its actual value.

        Returns:
            True if the solve converged; False if a step failed or the last solve did not converge.
        """
        self.moved[:] = 0.0
        self.g[:] = 0.0
        present = observation.weight[observation.weight > 0]
        level = ANNEAL_NOISE
        while present.size and level > 1.0 / present.max():
            if not self._newton(eased(observation, level), members) < math.inf:
                return False
            level /= ANNEAL_RATIO
        if not self._newton(observation, members) < math.inf:
            return False
        self._measure(observation)
        return self._settle(observation) or self.track(observation, members)

    def step_s(self, observation: Observation) -> float:
        """Return the time in s to factorise the equations of all wires and compute the standard deviations.

        The factors are discarded.
        """
        self.until = least = math.inf
        for _ in range(3):  # the first run may include memory allocation
            start = perf_counter()
            self._newton(observation, self._every)
            self._measure(observation)
            self._finish_measuring()
            least = min(least, perf_counter() - start)
        self.forget_factors()
        return least

    # -- properties of the current field ---------------------------------------------------------------

    def residuals(self, observation: Observation, moved: Float | None = None) -> Float:
        """Return the residuals r − H g (U, K), in units of their noise, at the current field or ``moved``."""
        self._square(observation, self._every, self.moved if moved is None else moved, self.g)
        return self._b.r.copy()

    def fit(self, observation: Observation, moved: Float | None) -> Fit:
        """Return the misfit between a frame and a displacement (U, 3N) in pitches; None means at rest."""
        if moved is None:
            self._linearise_at_rest(observation)
        else:
            self._linearise(observation, moved)
        total, top = np.empty((2, len(self.moved)))
        move = np.empty((len(top), self.free.size))
        kernels.measure_fit(self.free, observation.h, self.g, self._b.jt, self._b.r, total, top, move)
        return Fit(total, top, move)

    def objective(
        self, observation: Observation, moved: Float | None = None, g: Float | None = None
    ) -> float:
        """Return −2 log posterior for the current or a given field, up to a constant."""
        moved, g = (self.moved if moved is None else moved), (self.g if g is None else g)
        square = self._square(observation, self.members, moved, g)
        prior = self.roughness(moved) / self.load_prior.scale2
        return square + prior + float((g**2 / observation.d).sum())

    def roughness(self, moved: Float) -> float:
        """Return uᵀ C⁻¹ u, in pitch², for a displacement u (U, 3N)."""
        return self.load_prior.roughness(np.ascontiguousarray(moved[:, self.free]).ravel())

    def free_displacement(self) -> Float:
        """Return the free coordinates (U f,) of the current displacement, in pitches."""
        return np.ascontiguousarray(self.moved[:, self.free]).ravel()

    def covariance(self) -> Float:
        """Return the posterior covariance (U f, U f) of the displacement, in pitch²."""
        v = self._b.whitened[: self.factored_rows]
        explained = np.empty_like(self.load_prior.covariance)
        multiply(np.ascontiguousarray(v.T), v, explained)
        return np.asarray(self.load_prior.scale2 * self.load_prior.covariance - explained)

    def information(self) -> Float:
        """Return Σ (∂r/∂x)² (U, f), in pitch⁻², from the last linearisation of all wires."""
        slopes = self._b.jt[:, self.free]
        return np.asarray(np.einsum("uik,uik->ui", slopes, slopes))

    def whiten(self, response: Float, out: Float) -> None:
        """Write L⁻¹ J G into ``out`` (m, C) for the response G (U f, C), using the current factors."""
        b, f, rows = self._b, self.free.size, self._rows
        for i, u in enumerate(self.members.tolist()):
            block = slice(i * rows, (i + 1) * rows)
            multiply(b.jacobian[block], response[u * f : (u + 1) * f], out[block])
        solve_lower(b.innovation_covariance, out, *out.shape)

    # -- evidence --------------------------------------------------------------------------------------

    def linearise(self, observation: Observation, members: Index) -> None:
        """Linearise the equations of the wires ``members`` (P,) at the current displacement."""
        self.forget_factors()
        self.members = members
        self._linearise(observation, self.moved, members)

    def factorise_uniform(self, observation: Observation, scale2: float) -> float:
        """Factorise S for equal loads over the whole patch with s² = ``scale2``; return the log evidence.

        The evidence is ln N(y; 0, S), without the constant term, for the data of the last :meth:`linearise`.
        The factors remain valid until the next solver step.
        """
        b, m = self._b, self.factored_rows
        self._assemble(observation, self.members, scale2, self.moved, self.load_prior.uniform)
        self.factorisations += 1
        self.factors += 1
        if not cholesky(b.innovation_covariance, m):
            return -math.inf
        b.v[:m] = b.y[:m]
        solve_lower_vector(b.innovation_covariance, b.v, m)
        diagonal = b.innovation_covariance.diagonal()[:m]
        return float(-0.5 * (b.v[:m] @ b.v[:m]) - np.log(diagonal).sum())

    def whitened_data(self) -> Float:
        """Return L⁻¹ y (m,) from the last :meth:`factorise_uniform`."""
        return self._b.v[: self.factored_rows].copy()

    def match(self, data: Float, response_t: Float) -> Float:
        """Return (L⁻¹ J G)ᵀ z (C,) for whitened data z (m,) and Gᵀ (C, U f), using the current factors."""
        b, f, rows = self._b, self.free.size, self._rows
        z = data.copy()
        solve_lower_transposed_vector(b.innovation_covariance, z, z.size)
        gradient = np.zeros(len(self.load_prior.response))
        for i, u in enumerate(self.members.tolist()):
            block = slice(i * rows, (i + 1) * rows)
            gradient[u * f : (u + 1) * f] = z[block] @ b.jacobian[block]
        out = np.empty(len(response_t))
        multiply_vector(response_t, gradient, out)
        return out

    def signal(self) -> Float:
        """Return the prior variance (U, K) of each relative change in R at rest, for s = 1, in pitch⁻²."""
        wires, f, a = len(self.moved), self.free.size, self._problem.a_rest
        plain = Observation(a, np.ones_like(a), np.zeros((*a.shape, 0)), np.zeros(0))
        self._linearise_at_rest(plain)
        slopes = self._b.jt[:, self.free]  # (U, f, K)
        own = self.load_prior.uniform.reshape(wires, f, wires, f)[np.arange(wires), :, np.arange(wires)]
        return np.asarray(np.einsum("uik,uij,ujk->uk", slopes, own, slopes))

    def guess_scale(self, observation: Observation, members: Index) -> float:
        """Return the s² (pitch²) at which the expected change in R from rest equals the measured change."""
        self._linearise_at_rest(observation)
        trace = self._assemble(observation, members, 1.0, np.zeros_like(self.moved))
        square = float((self._b.r[members] ** 2).sum())
        excess = square - float(np.count_nonzero(observation.weight[members]))
        return excess / trace if trace > 0 else 0.0

    def gamma(self) -> float:
        """Return the number of parameters that the data determine (MacKay's γ)."""
        if self._gamma is None:
            b, m = self._b, self.factored_rows
            inverse_diagonal(b.innovation_covariance, np.empty_like(b.innovation_covariance), b.v, m)
            self._gamma = m - float(b.v[:m].sum())
        return self._gamma

    def evidence_scale(self, weight: float, scale2: float) -> float:
        """Return s², in pitch², after one more MacKay iteration (Neural Computation 4, 415, 1992).

        Args:
            weight: Weight of the prior on s², as an equivalent number of parameters.
            scale2: Value of s² expected by this prior, in pitch².
        """
        return (self.roughness(self.moved) + weight * scale2) / (self.gamma() + weight)

    # -- steps -----------------------------------------------------------------------------------------

    def _square(self, observation: Observation, members: Index, moved: Float, g: Float) -> float:
        """Return Σ (r − H g)² over the wires ``members``."""
        o = observation
        if self._geometry is not None:
            own, geometry = g[: self._fixed], g[self._fixed :]
            return self._geometry.residuals(members, moved, o.a, o.weight, o.h, own, geometry, self._b.r)
        x = self._problem.rest + moved
        return kernels.residuals(members, x, self._problem.lower, o.a, o.weight, o.h, g, self._b.r)

    def _fits(self, observation: Observation, members: Index) -> bool:
        """Return whether the current factors are valid for the given wires, the noise and the prior."""
        if self._factored is None:
            return False
        weight, scale2, version = self._factored
        prior = self.load_prior
        if version != prior.version or scale2 != prior.scale2 or not np.array_equal(members, self.members):
            return False
        new, old = observation.weight[members], weight[members]
        return bool(
            (np.abs(new - old) <= 0.1 * old).all()
        )  # False if a resistance has become usable or unusable

    def _effects_fit(self) -> bool:
        """Return whether the effects of the geometry errors are still close to those in the factors."""
        if self._geometry is None:
            return True
        now, then = self._b.effect[self.members], self._b.factored_effect[self.members]
        change = float(((now - then) ** 2).sum())
        return change <= EFFECT_STEP**2 * float((then**2).sum()) + 1.0

    def _linearise(self, observation: Observation, moved: Float, members: Index | None = None) -> None:
        if self.until < math.inf and perf_counter() > self.until:
            raise TimeoutError
        b, o = self._b, observation
        members = self._every if members is None else members
        self.evaluations += members.size
        if self._geometry is not None:
            g = self.g[self._fixed :]
            self._geometry.linearise(members, moved, o.a, o.weight, g, b.r, b.jt, b.effect)
            return
        x = self._problem.rest + moved
        kernels.linearise(members, x, self._problem.lower, o.a, o.weight, b.r, b.jt)

    def _linearise_at_rest(self, observation: Observation) -> None:
        """Linearise all wires at rest, using the stored F and Jacobian."""
        b = self._b
        b.r[:], b.jt[:] = self._at_rest
        kernels.weigh(self._every, observation.a, observation.weight, b.r, b.jt)
        b.effect[:] = 0.0  # geometry errors have no effect at rest

    def _assemble(
        self,
        observation: Observation,
        members: Index,
        scale2: float,
        moved: Float,
        covariance: Float | None = None,
    ) -> float:
        self._b = b = kernels.with_factors(self._b)
        covariance = self.load_prior.covariance if covariance is None else covariance
        o = observation
        trace = kernels.assemble(members, self.free, covariance, scale2, o.h, o.d, moved, b)
        if self._geometry is not None:
            b.factored_effect[:] = b.effect
            g = self.g[self._fixed :]
            geometry_error.add_covariance(members, b.effect, g, b.y, b.innovation_covariance)
        return trace

    def _newton(self, observation: Observation, members: Index) -> float:
        """Take a Gauss-Newton step with new factors; return max |step| in pitches, or inf on failure."""
        prior = self.load_prior
        self._factored = None
        self._linearise(observation, self.moved, members)
        self._assemble(observation, members, prior.scale2, self.moved)
        b = self._b
        self.factorisations += 1
        self.factors += 1
        if not cholesky(b.innovation_covariance, members.size * self._rows):
            return math.inf
        before = self.moved.copy()
        kernels.gauss_newton_step(members, self.free, observation.d, self.moved, self.g, b)
        if self._geometry is not None:
            geometry_error.estimate(members, b.factored_effect, b.v, self.g[self._fixed :])
        size = float(np.abs(self.moved - before).max())
        if not size < math.inf:
            self.moved[:] = before
            return math.inf
        self.members = members
        self._factored = (observation.weight.copy(), prior.scale2, prior.version)
        return size

    def _shorten(self, observation: Observation, moved: Float, g: Float) -> None:
        """Shorten the last step to the minimum of a parabola through the objective at three points.

        A Gauss-Newton step neglects the curvature of F. If the data determine only a few parameters, full
        steps can oscillate about the minimum without converging. ``moved`` and ``g`` are the displacement and
        the nuisances before the step.
        """
        way = self.moved - moved, self.g - g

        def at(share: float) -> float:
            return self.objective(observation, moved + share * way[0], g + share * way[1])

        start, far = at(0.0), 1.0
        middle, end = at(0.5), at(1.0)
        for _ in range(HALVINGS):  # far from the minimum, the objective is not parabolic
            if end < 4.0 * start + 1.0:
                break
            far *= 0.5
            middle, end = at(0.5 * far), middle
        slope, bend = 4.0 * middle - end - 3.0 * start, 2.0 * (end - 2.0 * middle + start)
        share = far * (min(max(-0.5 * slope / bend, 0.1), 1.0) if bend > 0.0 else 1.0)
        self.moved[:], self.g[:] = moved + share * way[0], g + share * way[1]

    def _measure(self, observation: Observation) -> None:
        """Compute the posterior variances from the current factors.

        The part of the variances due to noise is computed only when needed, because solves that merely lead
        to a better prior do not need it.
        """
        b, m, prior = self._b, self.factored_rows, self.load_prior
        self._gamma = None
        b.whitened[:m] = b.cross_covariance[:m]
        solve_lower(b.innovation_covariance, b.whitened, m, b.whitened.shape[1])
        kernels.standard_deviations(
            m, prior.covariance, prior.scale2, self._no_noise, 1.0, 0.0, self._whole_std, self._core, b
        )
        self._unfinished = observation.d, prior.doubt, prior.smooth_share
        most = SETTLED * math.sqrt(float(np.mean(self._whole_std**2)))
        self._enough = math.sqrt(prior.smooth_share) * most, most

    def _finish_measuring(self) -> None:
        """Compute the standard deviations from the posterior variances, unless this has already been done."""
        if self._unfinished is None:
            return
        (d, doubt, share), self._unfinished = self._unfinished, None
        b, m, noise = self._b, self.factored_rows, self._noise_variance
        kalman_gain_t = np.empty((m, b.whitened.shape[1]))
        kernels.noise_variance(m, d, b, kalman_gain_t, noise)
        if self._geometry is not None:
            geometry_error.add_variance(self.members, b.factored_effect, kalman_gain_t, self._scratch, noise)
        own = noise.reshape(self._std.shape)
        unseen = np.maximum(self._whole_std**2 - own, 0.0)
        np.sqrt(own + doubt * unseen, out=self._std)
        np.sqrt(own + share * unseen, out=self._core)
        enough = SETTLED * math.sqrt(float(np.mean(self._core**2)))
        self._enough = enough, enough

    def _is_enough(self, size: float) -> bool:
        """Return whether a chord step of RMS ``size``, in pitches, is small compared with :attr:`core`.

        Noise accounts for anywhere from none to all of the variance. ``core`` is computed only if the result
        depends on it.
        """
        if self._enough[0] < size <= self._enough[1]:
            self._finish_measuring()
        return size <= self._enough[1]

    def _settle(self, observation: Observation) -> bool:
        """Take chord steps, and return whether they converged; if not, keep the better of the two fields."""
        moved, g = self.moved.copy(), self.g.copy()
        if self._chord(observation):
            return True
        if not self.objective(observation) <= self.objective(observation, moved, g):
            self.moved[:], self.g[:] = moved, g
        return False

    def _chord(self, observation: Observation) -> bool:
        """Take chord steps, and return whether they converged.

        They have converged if the last step is small compared with the standard deviations.
        """
        b, wires, prior, step = self._b, len(self.moved), self.load_prior, self._correction
        before = math.inf
        for _ in range(CHORDS):
            self._linearise(observation, self.moved, self.members)
            size, top = kernels.chord_step(
                self.members, self.free, prior.covariance, prior.scale2, observation.h, observation.d,
                self.moved, self.g, step, b,
            )  # fmt: skip
            if not (top <= self._reach and size < math.inf):
                return False
            self.moved[:, self.free] += step[: self._no_noise.size].reshape(wires, -1)
            self.g += step[self._no_noise.size :]
            if self._is_enough(size):
                return True
            if size > CHORD_RATE * before:
                return False
            before = size
        return False
