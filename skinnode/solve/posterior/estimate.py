"""The maximum of the posterior of one frame: Gauss-Newton, chord steps, and annealing for large jumps.

chord     from the last field on with the factors of an older frame: two evaluations of F and J as a rule
newton    factors made anew at the field at hand, then chord steps
anneal    from the rest position with the noise taken as 3 %, then a quarter of that, and so on down to what
          it is. At a high noise the posterior has one maximum, near the prior's; it leads to the right one:
          presses of 70 % of the layer between two frames arrive, on layouts where the samples of the press
          itself lead the exact inversion astray.

Where on the patch the prior expects loads is set from the loads found (:meth:`Estimator.localise`): a contact
is stiff where nothing else touches. Against one scale for the whole patch that divides the error by two to
three, and a narrow contact no longer sticks out of the reported deviation.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.layout import Float
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
from skinnode.solve.posterior import innovation as kernels
from skinnode.solve.posterior.prior import SLACK, ElasticPrior
from skinnode.solve.wires.problem import PatchProblem

Index = NDArray[np.int64]

ANNEAL_NOISE: Final = 0.03
"""First relative noise of the annealing: there one Gauss-Newton step from rest is close to the maximum."""
ANNEAL_RATIO: Final = 4.0
"""Of the noise from one step to the next. On staggered and aligned, h = 0.5 and 1, presses to 70 % from
rest: ratio 3 brings 80 of 80 home, 5 all but one."""
SETTLED: Final = 0.02
"""A correction is done when its RMS is below this share of the RMS deviation."""
CHORDS: Final = 4
"""Most chord steps with one set of factors."""
CHORD_RATE: Final = 0.35
"""Contraction of chord steps above which new factors are the shorter way: they cost ten chord steps."""
NEWTONS: Final = 12
"""Most factorisations of a solve that starts near: one or two as a rule, more where full steps would
cycle."""
HALVINGS: Final = 6
"""Most times such a step is halved."""
LOCAL_SPREAD: Final = 0.7
"""Deviation, in cells, of the Gaussian that spreads the squares of the loads found over their neighbours.
Less trusts single cells, which is better for contacts on rubber as the prior has it, and overconfident for
others; 1 loses a quarter of the gain."""
LOCAL_SIGNIFICANT: Final = 4.0
"""Square of the deviations at which a load counts as found."""
LOCAL_CERTAIN: Final = 100.0
"""The same at which something certainly presses. At 25 and with much noise the places found first are not yet
to be relied on, and errors are 1 % larger; from 1000 on half a press is still expected all over the patch
where a layout sees little (`aligned`), which costs 14 %."""
LOCAL_FLOOR: Final = 0.05
"""Mean square load expected where none was found, over the mean: for a light touch beside a press."""
LOCAL_CHANGE: Final = 0.35
"""Share of the expected loads that must have moved elsewhere before the prior is made anew: at 0.5 frames of
a slow press reach 6 deviations, at 0.25 twice as many frames pay for it."""
LOCAL_SURPRISE: Final = 16.0
"""So many times the expected square of a load at one cell, and the prior is made anew however little moved
elsewhere: after an odd motion that left little to expect, a press twice as deep as the last frame's was 7
deviations off. Costs nothing: as many frames are factorised in slow presses at 16 as without."""
PRIOR_DOUBT: Final = 3.0
"""σ² is what the noise does to the estimate and what the prior says of all that the data leave open; the
deviation counts the second so many times, since how much load to expect where is known to a factor only.
At 1 the hidden part of a first touch is 5 to 7 deviations off in one wire of 20 000, and so are dents that no
half-space makes; at 2 one of 12 000 coordinates of such dents is 5.6, of the hard cases none is beyond 5."""
SMOOTH_SHARE: Final = 0.25
"""So much of the prior's part is in the 95 % interval. Independent loads on cells are rougher than bodies:
measured, 0.0 to 0.13 of that variance is in the errors of spheres, 0.02 to 0.5 in those of Gaussian dents.
The tail of that is the deviation's, its body the interval's."""


@dataclass
class Data:
    """One frame as the estimator sees it."""

    a: Float
    """(U, K)"""
    weight: Float
    """(U, K) 1/σ, 0 where a resistance is missing."""
    h: Float
    """(U, K, p) what a unit of each nuisance does to the residual."""
    d: Float
    """(p,) prior variances of the nuisances."""

    @functools.cached_property
    def count(self) -> Index:
        """(U,) resistances there are of each wire."""
        return np.asarray(np.count_nonzero(self.weight, axis=1))


class Estimator:
    """State and buffers of one patch: displacement, nuisances, scale of the prior and the last factors.

    ``free`` (f,): coordinates of a wire that move.
    """

    def __init__(self, problem: PatchProblem, prior: ElasticPrior, free: Index, nuisances: int) -> None:
        wires, equations = problem.layout.shape
        coordinates = problem.layout.unknowns
        every = (np.arange(wires)[:, None] * coordinates + free).ravel()
        self._problem, self._free = problem, free
        self._response = np.ascontiguousarray(prior.response[every])
        self._response_t = np.ascontiguousarray(self._response.T)
        self._blur = _blur(prior.shape)
        self._b = kernels.buffers(wires, equations, coordinates, free.size, nuisances)
        self._rows = min(equations, free.size + nuisances)
        self._reach = roots.NEAR * float(problem.clearance.min())
        self._enough = math.inf  # RMS of a correction that is small against the deviation
        self._at_rest = np.zeros((wires, equations)), np.zeros((wires, coordinates, equations))
        kernels.potentials(np.arange(wires), problem.rest.copy(), problem.lower, *self._at_rest)
        self._correction = np.zeros(wires * free.size + nuisances)
        self._every = np.arange(wires)
        self._uniform = np.ascontiguousarray(prior.covariance[np.ix_(every, every)])
        self._covariance, self._root = self._uniform.copy(), np.empty_like(self._uniform)
        self.moved = np.zeros((wires, coordinates))
        """(U, 3N) displacement, pitches; fixed coordinates stay 0."""
        self.g = np.zeros(nuisances)
        self.std = np.full((wires, free.size), np.inf)
        """(U, f) at the last factors, pitches."""
        self.core = np.full((wires, free.size), np.inf)
        """(U, f) the same under bodies as smooth as they are, for the 95 % interval."""
        self.noise_variance = np.zeros(wires * free.size)
        """(U f,) what noise and nuisances put into the displacement, pitch²."""
        self.scale2 = 1.0
        """s², pitch²."""
        self.share = np.ones(len(self._blur))
        """(Q,) variance of the loads of a cell over s²; their mean is 1."""
        self._gamma: float | None = None
        self.members: Index = np.arange(0)
        """Wires whose equations are in the factors."""
        self._factored: tuple[Float, float] | None = None
        self._whitened_loads = np.empty((len(self._b.v), self._response.shape[1]))
        self._stiffness = np.empty(self._response.shape[1])
        self._told = False  # whether the last two belong to the factors at hand
        self._loads: tuple[Float, Float] | None = None  # displacement, loads; by the prior at hand
        self.evaluations = self.factorisations = 0
        self.factors = 0
        """Number of the factors at hand."""
        self.until = math.inf
        """Time of :func:`time.perf_counter` after which a solve is broken off with a TimeoutError."""
        self.reset(1.0)

    def reset(self, scale2: float) -> None:
        """The rest position, nothing known."""
        self.moved[:] = 0.0
        self.g[:] = 0.0
        self.forget_factors()
        self.spread(scale2)

    def forget_factors(self) -> None:
        """Nothing is known of the field at hand."""
        self.std[:] = np.inf
        self.core[:] = np.inf
        self._enough = math.inf
        self._factored = None

    def spread(self, scale2: float) -> None:
        """Loads are expected all over the patch alike, at scale s²."""
        self.scale2 = scale2
        self.share[:] = 1.0
        self._covariance[:] = self._uniform
        self._root[:] = self._uniform
        cholesky(self._root, len(self._root))
        self._factored = self._loads = None

    def loads(self) -> Float:
        """(Q, 3) mean of the loads given the displacement, in units of the prior's."""
        moved = self.free_displacement()
        if self._loads is not None and np.array_equal(self._loads[0], moved):
            return self._loads[1]
        z, q = moved.copy(), np.empty(self._response.shape[1])
        solve_lower_vector(self._root, z, z.size)
        solve_lower_transposed_vector(self._root, z, z.size)
        multiply_vector(self._response_t, z, q)
        self._loads = moved, q.reshape(-1, 3) * self.share[:, None]
        return self._loads[1]

    def expected(self, least: float) -> Float:
        """(Q,) variances of the loads of cells that the loads found speak for, pitch²; at least ``least``.

        Half the way from those at hand, or neighbours would take turns; all of it from loads expected all
        over the patch alike, where something certainly presses.
        """
        found, certain = self._evidence()
        floor = LOCAL_FLOOR * float(found.mean()) + least
        wanted = np.empty_like(found)
        multiply_vector(self._blur, found, wanted)
        wanted += floor
        if certain and (self.share == 1.0).all():
            return wanted
        return np.asarray(0.5 * (wanted + self.scale2 * self.share))

    def localise(self, variance: Float) -> bool:
        """Expect loads of these variances; False where hardly any would have to be expected elsewhere."""
        mean = float(variance.mean())
        share = variance / mean
        moved = 0.5 * float(np.abs(share - self.share).mean()) > LOCAL_CHANGE
        if not moved and (variance <= LOCAL_SURPRISE * self.scale2 * self.share).all():
            return False
        self.scale2 = mean
        self.share[:] = share
        multiply(self._response * np.repeat(share, 3), self._response_t, self._covariance)
        self._covariance[np.diag_indices_from(self._covariance)] += SLACK**2
        self._root[:] = self._covariance
        cholesky(self._root, len(self._root))
        self._factored = self._loads = None
        return True

    def _evidence(self) -> tuple[Float, bool]:
        """(Q,) squares of the loads found, freed from what the prior took of them: the largest of the three
        components; and whether one of them is certain.

        A load whose own prior is taken away has the estimate q / s² k and the variance 1/k − s², k being what
        a unit of it adds to χ² (Tipping and Faul, Fast marginal likelihood maximisation for sparse Bayesian
        models, 2003).
        """
        found = np.empty(len(self.share))
        self._whiten_loads()
        most = kernels.loads_found(
            self.loads(), self.scale2 * self.share, self._stiffness, LOCAL_SIGNIFICANT, found
        )
        return found, most > LOCAL_CERTAIN

    def _whiten_loads(self) -> Float:
        """(m, 3Q) L⁻¹ J G by the factors at hand; k of each load with it."""
        b, f, rows = self._b, self._free.size, self._rows
        told = self._whitened_loads[: self.members.size * rows]
        if not self._told:
            self._told = True
            for i, u in enumerate(self.members.tolist()):
                block = slice(i * rows, (i + 1) * rows)
                multiply(b.jacobian[block], self._response[u * f : (u + 1) * f], told[block])
            solve_lower(b.innovation, told, *told.shape)
            self._stiffness[:] = np.maximum(np.einsum("mq,mq->q", told, told), 1e-300)
        return told

    def load_std(self, loads: Index, weights: Float) -> Float:
        """(F,) deviations, by the factors at hand, of sums of the ``loads`` (F, n), numbers below 3Q, with
        ``weights`` (F, n)."""
        shared = weights * self.share[loads // 3]
        square = np.empty(len(weights))
        kernels.load_squares(self._whiten_loads(), loads, shared, square)
        variance = self.scale2 * ((weights * shared).sum(axis=1) - self.scale2 * square)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def residuals(self, data: Data, moved: Float | None = None) -> Float:
        """(U, K) r − H g at the displacement at hand, or another; what noise there is has deviation 1."""
        self._square(data, self._every, self.moved if moved is None else moved, self.g)
        return self._b.r.copy()

    def surprise(self, data: Data, moved: Float | None) -> tuple[Float, Float, Float]:
        """How badly a displacement, None for that at rest, explains the frame: (U,) χ² of each wire, (U,) by
        how many deviations a single coordinate is off at most, and (U, f) by how much each would be, were it
        the only one, pitches.

        χ² alone overlooks what moves one electrode by 7 deviations.
        """
        if moved is None:
            self._linearise_at_rest(data)
        else:
            self._linearise(data, moved)
        total, top = np.empty((2, len(self.moved)))
        move = np.empty((len(top), self._free.size))
        kernels.surprises(self._free, data.h, self.g, self._b.jt, self._b.r, total, top, move)
        return total, top, move

    def objective(self, data: Data, moved: Float | None = None, g: Float | None = None) -> float:
        """What a solve minimises, χ² and the prior's part, at the field at hand or another; with equal
        factors."""
        moved, g = (self.moved if moved is None else moved), (self.g if g is None else g)
        square = self._square(data, self.members, moved, g)
        return square + self.roughness(moved) / self.scale2 + float((g**2 / data.d).sum())

    def _square(self, data: Data, members: Index, moved: Float, g: Float) -> float:
        """Σ (r − H g)² of these wires."""
        x, b = self._problem.rest + moved, self._b
        return kernels.residuals(members, x, self._problem.lower, data.a, data.weight, data.h, g, b.r)

    def track(self, data: Data, members: Index) -> bool:
        """Solve from the displacement at hand; False where that leads nowhere near."""
        if self._fits(data, members) and self._settle(data):
            return True
        for _ in range(NEWTONS):
            before = self.moved.copy(), self.g.copy()
            size = self._newton(data, members)
            if not size <= self._reach:
                return False
            self._shorten(data, *before)
            self._measure(data)
            if self._settle(data):
                return True
        return False

    def anneal(self, data: Data, members: Index) -> bool:
        """Solve from rest, through a noise that falls from :data:`ANNEAL_NOISE` to what it is."""
        self.moved[:] = 0.0
        self.g[:] = 0.0
        weight = data.weight
        present = weight[weight > 0]
        level = ANNEAL_NOISE
        while present.size and level > 1.0 / present.max():
            eased = 1.0 / np.hypot(
                level, np.divide(1.0, weight, out=np.full_like(weight, np.inf), where=weight > 0)
            )
            share = np.divide(eased, weight, out=np.zeros_like(weight), where=weight > 0)
            loose = Data(data.a, eased, data.h * share[..., None], data.d)
            if not self._newton(loose, members) < math.inf:
                return False
            level /= ANNEAL_RATIO
        if not self._newton(data, members) < math.inf:
            return False
        self._measure(data)
        return self._settle(data) or self.track(data, members)

    def signal(self) -> Float:
        """(U, K) variance of each relative change of R at rest under a prior of scale 1, pitch⁻²."""
        wires, f = len(self.moved), self._free.size
        a = self._problem.a_rest
        plain = Data(a, np.ones_like(a), np.zeros((*a.shape, 0)), np.zeros(0))
        self._linearise_at_rest(plain)
        slopes = self._b.jt[:, self._free]  # (U, f, K)
        own = self._uniform.reshape(wires, f, wires, f)[np.arange(wires), :, np.arange(wires)]
        return np.asarray(np.einsum("uik,uij,ujk->uk", slopes, own, slopes))

    def guess_scale(self, data: Data, members: Index) -> float:
        """s² at which the resistances would differ from those at rest as much as they do."""
        self._linearise_at_rest(data)
        trace = self._assemble(data, members, 1.0, np.zeros_like(self.moved))
        excess = float((self._b.r[members] ** 2).sum()) - float(np.count_nonzero(data.weight[members]))
        return excess / trace if trace > 0 else 0.0

    def gamma(self) -> float:
        """Number of directions in the space of the data that the data determine, not the prior."""
        if self._gamma is None:
            b, m = self._b, self.members.size * self._rows
            inverse_diagonal(b.innovation, b.work, b.v, m)
            self._gamma = m - float(b.v[:m].sum())
        return self._gamma

    def evidence_scale(self, weight: float, scale2: float) -> float:
        """The next s² of MacKay's fixed point (Neural Computation 4, 415, 1992), under a prior worth
        ``weight`` directions at ``scale2``."""
        return (self.roughness(self.moved) + weight * scale2) / (self.gamma() + weight)

    def roughness(self, moved: Float) -> float:
        """uᵀ C⁻¹ u, pitch²: the square of the scale that a displacement asks for, times the unknowns."""
        z = np.ascontiguousarray(moved[:, self._free]).ravel()
        solve_lower_vector(self._root, z, z.size)
        return float(z @ z)

    def free_displacement(self) -> Float:
        """(U f,) the free coordinates, pitches."""
        return np.ascontiguousarray(self.moved[:, self._free]).ravel()

    def covariance(self) -> Float:
        """(U f, U f) of the displacement, pitch²."""
        v = self._b.whitened[: self.members.size * self._rows]
        told = np.empty_like(self._covariance)
        multiply(np.ascontiguousarray(v.T), v, told)
        return np.asarray(self.scale2 * self._covariance - told)

    def step_s(self, data: Data) -> float:
        """Time of one factorisation of all wires and of the deviations by it; forgets the factors."""
        self.until = least = math.inf
        for _ in range(3):  # the first may wait for memory
            start = perf_counter()
            self._newton(data, self._every)
            self._measure(data)
            least = min(least, perf_counter() - start)
        self.forget_factors()
        return least

    def _fits(self, data: Data, members: Index) -> bool:
        """Whether the factors at hand were made for these wires, noise and scale."""
        if self._factored is None:
            return False
        weight, scale2 = self._factored
        if scale2 != self.scale2 or not np.array_equal(members, self.members):
            return False
        new, old = data.weight[members], weight[members]
        return bool((np.abs(new - old) <= 0.1 * old).all())  # which a resistance lost or found is not

    def _linearise(self, data: Data, moved: Float, members: Index | None = None) -> None:
        if self.until < math.inf and perf_counter() > self.until:
            raise TimeoutError
        b = self._b
        members = self._every if members is None else members
        x = self._problem.rest + moved
        kernels.linearise(members, x, self._problem.lower, data.a, data.weight, b.r, b.jt)
        self.evaluations += members.size

    def _linearise_at_rest(self, data: Data) -> None:
        """The same for all wires at rest, where F and J are known."""
        b = self._b
        b.r[:], b.jt[:] = self._at_rest
        kernels.weigh(self._every, data.a, data.weight, b.r, b.jt)

    def _assemble(self, data: Data, members: Index, scale2: float, moved: Float) -> float:
        return kernels.assemble(members, self._free, self._covariance, scale2, data.h, data.d, moved, self._b)

    def _newton(self, data: Data, members: Index) -> float:
        """One Gauss-Newton step with new factors; how far it moved any coordinate, inf where it failed."""
        b = self._b
        self._factored = None
        self._linearise(data, self.moved, members)
        self._assemble(data, members, self.scale2, self.moved)
        m = members.size * self._rows
        self.factorisations += 1
        self.factors += 1
        self._told = False
        if not cholesky(b.innovation, m):
            return math.inf
        before = self.moved.copy()
        kernels.full_step(members, self._free, data.d, self.moved, self.g, b)
        size = float(np.abs(self.moved - before).max())
        if not size < math.inf:
            self.moved[:] = before
            return math.inf
        self.members = members
        self._factored = (data.weight.copy(), self.scale2)
        return size

    def _shorten(self, data: Data, moved: Float, g: Float) -> None:
        """From there towards the field at hand, to the minimum of the parabola through what is minimised.

        Gauss-Newton leaves out the curvature of F, and where the data say little its full steps go to and fro
        across the minimum for ever.
        """
        way = self.moved - moved, self.g - g

        def at(share: float) -> float:
            return self.objective(data, moved + share * way[0], g + share * way[1])

        start, far = at(0.0), 1.0
        middle, end = at(0.5), at(1.0)
        for _ in range(HALVINGS):  # far from the minimum it is no parabola
            if end < 4.0 * start + 1.0:
                break
            far *= 0.5
            middle, end = at(0.5 * far), middle
        slope, bend = 4.0 * middle - end - 3.0 * start, 2.0 * (end - 2.0 * middle + start)
        share = far * (min(max(-0.5 * slope / bend, 0.1), 1.0) if bend > 0.0 else 1.0)
        self.moved[:], self.g[:] = moved + share * way[0], g + share * way[1]

    def _measure(self, data: Data) -> None:
        """Deviations by the factors at hand."""
        b, m = self._b, self.members.size * self._rows
        self._gamma = None
        b.whitened[:m] = b.gain[:m]
        columns = b.whitened.shape[1]
        solve_lower(b.innovation, b.whitened, m, columns)
        kernels.noise_variance(m, data.d, b, self.noise_variance)
        kernels.deviations(
            m, self._covariance, self.scale2, self.noise_variance, PRIOR_DOUBT, SMOOTH_SHARE, self.std,
            self.core, b,
        )  # fmt: skip
        self._enough = SETTLED * math.sqrt(float(np.mean(self.core**2)))

    def _settle(self, data: Data) -> bool:
        """Chord steps to the maximum; where they do not settle, the better of the fields before and after."""
        moved, g = self.moved.copy(), self.g.copy()
        if self._chord(data):
            return True
        if not self.objective(data) <= self.objective(data, moved, g):
            self.moved[:], self.g[:] = moved, g
        return False

    def _chord(self, data: Data) -> bool:
        """Chord steps until the correction is small against the deviation."""
        b, wires = self._b, len(self.moved)
        before = math.inf
        for _ in range(CHORDS):
            self._linearise(data, self.moved, self.members)
            size, top = kernels.chord_step(
                self.members, self._free, self._covariance, self.scale2, data.h, data.d, self.moved, self.g,
                self._correction, b,
            )  # fmt: skip
            step = self._correction
            if not (top <= self._reach and size < math.inf):
                return False
            self.moved[:, self._free] += step[: self.std.size].reshape(wires, -1)
            self.g += step[self.std.size :]
            if size <= self._enough:
                return True
            if size > CHORD_RATE * before:
                return False
            before = size
        return False


def _blur(shape: tuple[int, int]) -> Float:
    """(Q, Q) weights of a Gaussian of :data:`LOCAL_SPREAD` cells around each cell, summing to 1."""
    cell = np.indices(shape).reshape(2, -1)
    square = ((cell[:, :, None] - cell[:, None, :]) ** 2).sum(axis=0)
    weight = np.exp(-0.5 * square / LOCAL_SPREAD**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
