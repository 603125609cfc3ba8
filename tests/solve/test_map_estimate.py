"""One step of the posterior and its maximum, against normal equations written out in NumPy and against SciPy.

The textbook's way is the other one: precisions are added up and inverted (information form), where the code
works in the space of the data.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares

import skinnode as sk
from skinnode.solve.linalg.cholesky import cholesky
from skinnode.solve.posterior import measurement_update as kernels
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.posterior.load_prior import PRIOR_DOUBT, SMOOTH_SHARE
from skinnode.solve.posterior.map_estimate import MapEstimator
from skinnode.solve.posterior.observation import Observation
from skinnode.solve.wires.problem import PatchProblem
from tests.lanes import some_long

from .press import frame_ohm, hertz_press

NOISE = 1e-3
CENTRE = (5.3e-3, 3.1e-3)


@dataclass
class Case:
    """A pressed patch of 3 wires of 4 electrodes, noisy, with nuisances of all sorts."""

    layout: sk.PatchLayout
    problem: PatchProblem
    prior: ElasticPrior
    free: np.ndarray
    scale2: float
    data: Observation

    @property
    def c(self) -> np.ndarray:
        every = (np.arange(3)[:, None] * self.layout.unknowns + self.free).ravel()
        return np.ascontiguousarray(self.prior.covariance[np.ix_(every, every)])

    def system(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """r, J and H of all wires as dense NumPy arrays, by the reference model."""
        wires, equations = self.layout.shape
        upper = self.layout.upper_m + (moved * self.layout.pitch_m).reshape(self.layout.upper_m.shape)
        scale = (self.data.weight * self.data.a)[..., None, None]
        potential = self.layout.resistivity_ohm_per_m * self.layout.pitch_m
        potential = potential / sk.resistance_ohm(self.layout, upper)
        r = self.data.weight * (self.data.a * potential - 1.0)
        slopes = scale * sk.jacobian(self.layout, upper) * self.layout.pitch_m**2
        slopes = slopes.reshape(wires, equations, -1)[..., self.free]
        j = np.zeros((wires, equations, wires, self.free.size))
        for u in range(wires):
            j[u, :, u] = slopes[u]
        return r, j, self.data.h

    def textbook(self, moved: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Displacement, nuisances and covariance after a full Gauss-Newton step from ``moved``."""
        r, j, h = self.system(moved)
        n = 3 * self.free.size
        j = j[members].reshape(-1, n)
        h = h[members].reshape(len(j), -1)
        y = j @ moved[:, self.free].ravel() - r[members].ravel()
        both = np.hstack([j, -h])
        precision = both.T @ both
        precision[:n, :n] += np.linalg.inv(self.scale2 * self.c)
        precision[n:, n:] += np.diag(1.0 / self.data.d)
        covariance = np.linalg.inv(precision)
        found = covariance @ (both.T @ y)
        return found[:n].reshape(3, -1), found[n:], covariance


def case(
    lower: int = 12,
    *,
    nuisances: int = 3,
    normal_only: bool = False,
    missing: bool = False,
    noise: float = NOISE,
    depth: float = 0.15,
) -> Case:
    layout = sk.PatchLayout.preset(
        "staggered", upper_wires=3, upper_electrodes=4, lower_wires=lower, lower_electrodes=5
    )
    rng = np.random.default_rng(lower)
    moved = hertz_press(layout, depth, centre_m=CENTRE, shear=0.0 if normal_only else 0.3)
    if normal_only:
        moved[..., :2] = 0.0
    problem = PatchProblem.of(layout)
    a = frame_ohm(layout, moved) * problem.gain * (1 + noise * rng.normal(size=layout.shape))
    weight = 1.0 / (noise * rng.uniform(0.5, 2.0, layout.shape))
    if missing:
        weight[rng.random(layout.shape) < 0.25] = 0.0
    h = np.zeros((*layout.shape, nuisances))
    if nuisances:
        h[..., 0] = weight  # a common gain, and shapes of no meaning
        h[..., 1:] = weight[..., None] * rng.normal(size=(*layout.shape, nuisances - 1))
    free = np.arange(2, 12, 3) if normal_only else np.arange(12)
    d = rng.uniform(0.5, 2.0, nuisances) * 1e-4
    return Case(layout, problem, ElasticPrior.of(layout), free, 0.03**2, Observation(a, weight, h, d))


def factored(case: Case, moved: np.ndarray, members: np.ndarray) -> tuple[kernels.Buffers, int, np.ndarray]:
    """Buffers with the factor at ``moved``; rows in use; S before it was factored."""
    wires, equations = case.layout.shape
    p = case.data.d.size
    b = kernels.make_buffers(wires, equations, case.layout.unknowns, case.free.size, p)
    x = case.problem.rest + moved
    kernels.linearise(members, x, case.problem.lower, case.data.a, case.data.weight, b.r, b.jt)
    kernels.assemble(members, case.free, case.c, case.scale2, case.data.h, case.data.d, moved, b)
    m = members.size * min(equations, case.free.size + p)
    s = b.innovation_covariance[:m, :m].copy()
    assert cholesky(b.innovation_covariance, m)
    return b, m, s


CASES = {
    "square": {},
    "square, no nuisance": {"nuisances": 0},
    "tall, reduced": {"lower": 40},
    "tall by two": {"lower": 14, "nuisances": 0},
    "tall, values missing": {"lower": 40, "missing": True},
    "short": {"lower": 5},
    "one lower wire": {"lower": 1},
    "values missing": {"missing": True},
    "normal only, reduced": {"normal_only": True},
    "normal only, short": {"lower": 3, "normal_only": True},
}


@pytest.mark.parametrize("members", [[0, 1, 2], [2], [0, 2]])
@pytest.mark.parametrize("name", CASES)
def test_full_step_is_the_textbooks(name, members):
    """Mean, nuisances and covariance; from a position that is neither rest nor the solution."""
    it, members = case(**CASES[name]), np.array(members)
    moved = np.zeros((3, 12))
    moved[:, it.free] = 0.01 * np.random.default_rng(1).normal(size=(3, it.free.size))
    expected, nuisances, covariance = it.textbook(moved, members)
    b, m, s = factored(it, moved, members)
    x, g = moved.copy(), np.full(it.data.d.size, np.nan)
    kernels.gauss_newton_step(members, it.free, it.data.d, x, g, b)
    std = np.sqrt(np.diag(covariance))
    n = expected.size
    fixed = np.setdiff1d(np.arange(12), it.free)
    np.testing.assert_array_equal(x[:, fixed], 0.0)
    assert np.abs(x[:, it.free] - expected).max() < 1e-6 * std[:n].min()
    assert (np.abs(g - nuisances) < 1e-6 * std[n:]).all()
    v = np.linalg.solve(np.linalg.cholesky(s, upper=True).T, b.cross_covariance[:m])
    np.testing.assert_allclose(
        it.scale2 * it.c - v.T @ v, covariance[:n, :n], rtol=0, atol=1e-6 * std[:n].max() ** 2
    )


@pytest.mark.parametrize("name", CASES)
def test_innovation_is_the_covariance_of_the_data(name):
    """S has the eigenvalues of I + s² J C Jᵀ + H d Hᵀ; the rows that a reduction drops have 1."""
    it = case(**CASES[name])
    moved = np.zeros((3, 12))
    _, m, s = factored(it, moved, np.arange(3))
    s = np.triu(s) + np.triu(s, 1).T
    r, j, h = it.system(moved)
    j, h = j.reshape(-1, 3 * it.free.size), h.reshape(r.size, -1)
    full = np.eye(len(j)) + it.scale2 * j @ it.c @ j.T + h * it.data.d @ h.T
    expected = np.linalg.eigvalsh(full)
    np.testing.assert_allclose(np.linalg.eigvalsh(s), expected[-m:], rtol=1e-9)
    np.testing.assert_allclose(expected[:-m], 1.0, rtol=1e-6)


def test_one_resistance_is_a_rank_one_update():
    """By hand: u = s² C j y / (1 + s² jᵀ C j), Sherman and Morrison."""
    it = case(nuisances=0)
    keep = np.zeros_like(it.data.weight)
    keep[1, 5] = it.data.weight[1, 5]
    it.data.weight[:] = keep
    moved = np.zeros((3, 12))
    b, _, _ = factored(it, moved, np.array([1]))
    r, j, _ = it.system(moved)
    row = j[1, 5].ravel()
    c_row = it.scale2 * it.c @ row
    expected = c_row * -r[1, 5] / (1.0 + row @ c_row)
    kernels.gauss_newton_step(np.array([1]), it.free, it.data.d, moved, np.zeros(0), b)
    np.testing.assert_allclose(moved.ravel(), expected, rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize("name", CASES)
def test_chord_steps_with_old_factors_reach_the_maximum(name):
    """Factors of the rest position, a press of 15 %: the gradient falls to 1e-9 of its two terms."""
    it, members = case(**CASES[name]), np.arange(3)
    moved, g = np.zeros((3, 12)), np.zeros(it.data.d.size)
    b, _, _ = factored(it, moved, members)
    step = np.zeros(3 * it.free.size + g.size)
    for _ in range(60):
        x = it.problem.rest + moved
        kernels.linearise(members, x, it.problem.lower, it.data.a, it.data.weight, b.r, b.jt)
        kernels.chord_step(members, it.free, it.c, it.scale2, it.data.h, it.data.d, moved, g, step, b)
        moved[:, it.free] += step[: 3 * it.free.size].reshape(3, -1)
        g += step[3 * it.free.size :]
    r, j, h = it.system(moved)
    left = (r - h @ g).ravel()
    j, h = j.reshape(left.size, -1), h.reshape(left.size, -1)
    pull = it.scale2 * it.c @ (j.T @ left)
    np.testing.assert_allclose(moved[:, it.free].ravel(), -pull, rtol=0, atol=1e-9 * np.abs(pull).max())
    if g.size:
        np.testing.assert_allclose(g, it.data.d * (h.T @ left), rtol=1e-6, atol=1e-9 * np.abs(g).max())
    assert np.abs(pull).max() > 1e-3  # there was a press


def estimator(it: Case) -> MapEstimator:
    found = MapEstimator(it.problem, it.prior, it.free, it.data.d.size)
    found.load_prior.spread(it.scale2)
    return found


@pytest.mark.parametrize("name", ["square", "tall, values missing", "short", "normal only, reduced"])
def test_annealing_finds_the_maximum_scipy_finds(name):
    """SciPy minimises r'r + u'(s²C)⁻¹u + g'D⁻¹g from the truth; the solve starts from rest."""
    it = case(**CASES[name], depth=0.3)
    solver = estimator(it)
    assert solver.anneal(it.data, np.arange(3))
    root = np.linalg.inv(np.linalg.cholesky(it.scale2 * it.c))
    n = 3 * it.free.size

    def objective(theta: np.ndarray) -> np.ndarray:
        moved = np.zeros((3, 12))
        moved[:, it.free] = theta[:n].reshape(3, -1)
        r, _, h = it.system(moved)
        return np.concatenate([(r - h @ theta[n:]).ravel(), root @ theta[:n], theta[n:] / np.sqrt(it.data.d)])

    shear = 0.0 if it.free.size == 4 else 0.3
    start = hertz_press(it.layout, 0.3, centre_m=CENTRE, shear=shear) / it.layout.pitch_m
    start = np.concatenate([start.reshape(3, 12)[:, it.free].ravel(), np.zeros(it.data.d.size)])
    best = least_squares(objective, start, xtol=1e-12, ftol=1e-14, gtol=1e-12)
    _, _, covariance = it.textbook(solver.moved, np.arange(3))
    std = np.sqrt(np.diag(covariance))
    assert np.abs((solver.moved[:, it.free].ravel() - best.x[:n]) / std[:n]).max() < 0.1
    assert np.abs((solver.g - best.x[n:]) / std[n:]).max() < 0.1
    found = (objective(np.concatenate([solver.moved[:, it.free].ravel(), solver.g])) ** 2).sum()
    assert solver.objective(it.data) == pytest.approx(found, rel=1e-8)
    assert found == pytest.approx(2 * best.cost, rel=1e-3)


@pytest.mark.parametrize("name", ["square", "tall, reduced", "short", "normal only, reduced"])
def test_covariance_and_directions_known_are_the_textbooks(name):
    """σ² of each coordinate, parted into what noise does and Σ (s²C)⁻¹ Σ, which the prior leaves open and a
    fixed field would have as bias; and γ = Uf − tr((s²C)⁻¹ Σ) (MacKay)."""
    it = case(**CASES[name], depth=0.02, noise=1e-4)
    solver = estimator(it)
    assert solver.anneal(it.data, np.arange(3))
    _, _, covariance = it.textbook(solver.moved, np.arange(3))
    n = 3 * it.free.size
    covariance = covariance[:n, :n]
    np.testing.assert_allclose(solver.covariance(), covariance, rtol=0, atol=0.01 * covariance.max())
    left = np.diag(covariance @ np.linalg.solve(it.scale2 * it.c, covariance))
    noise = np.diag(covariance) - left
    np.testing.assert_allclose(solver.noise_variance, noise, rtol=0.04, atol=0.01 * left.min())
    for found, share in ((solver.std, PRIOR_DOUBT), (solver.core, SMOOTH_SHARE)):
        np.testing.assert_allclose(found.ravel(), np.sqrt(noise + share * left), rtol=0.02)
    if not it.data.d.size:
        known = n - np.trace(np.linalg.solve(it.scale2 * it.c, covariance))
        assert solver.gamma() == pytest.approx(known, rel=0.01)


def test_directions_known_without_nuisances_are_mackays():
    it = case(nuisances=0, depth=0.02)
    solver = estimator(it)
    assert solver.anneal(it.data, np.arange(3))
    _, _, covariance = it.textbook(solver.moved, np.arange(3))
    known = 36 - np.trace(np.linalg.solve(it.scale2 * it.c, covariance))
    assert solver.gamma() == pytest.approx(known, rel=1e-3)
    assert 10 < known < 35


@pytest.mark.parametrize(
    ("height", "depth", "noise", "frames"),
    some_long(
        [(0.5, 0.5, 1e-5, 50), (0.5, 0.5, 1e-4, 50), (1.0, 0.7, 1e-5, 400), (1.0, 0.7, 1e-4, 50)],
        (0.5, 0.5, 1e-5, 50),
    ),
)
def test_annealing_a_jump_ends_where_small_steps_lead(height, depth, noise, frames):
    """A whole patch: annealed from rest, and followed through a press in steps small enough to track."""
    layout = sk.PatchLayout.preset("staggered", height_m=height * 4e-3)
    problem = PatchProblem.of(layout)
    solvers = [MapEstimator(problem, ElasticPrior.of(layout), np.arange(30), 0) for _ in range(2)]
    jump, steps = solvers
    every = np.arange(10)
    for solver in solvers:
        solver.load_prior.spread(0.05**2 * height)
    for share in np.linspace(1 / frames, 1.0, frames):
        moved = hertz_press(layout, depth * share)
        a = frame_ohm(layout, moved) * problem.gain
        data = Observation(a, np.full(a.shape, 1 / noise), np.zeros((*a.shape, 0)), np.zeros(0))
        assert steps.track(data, every)
    assert jump.anneal(data, every)
    assert np.abs((jump.moved - steps.moved) / jump.std).max() < 0.1
    truth = moved.reshape(10, 30) / layout.pitch_m
    assert np.sqrt(np.mean(((jump.moved - truth) / jump.std) ** 2)) < 1.2


def test_sharpest_is_the_wald_test_of_each_coordinate():
    """By how many deviations the best move of a single coordinate lowers χ²: from least squares."""
    it = case(lower=40, nuisances=0, missing=True)
    moved = np.zeros((3, 12))
    r, j, _ = it.system(moved)
    total, sharpest, moves = estimator(it).fit(it.data, moved)
    for u in range(3):
        best = 0.0
        for i, column in enumerate(j[u, :, u].T):
            step = np.linalg.lstsq(column[:, None], -r[u], rcond=None)[0][0]
            assert abs(moves[u, i]) == pytest.approx(abs(step), rel=1e-6)
            best = max(best, (r[u] ** 2).sum() - ((r[u] + column * step) ** 2).sum())
        assert sharpest[u] == pytest.approx(np.sqrt(best), rel=1e-6)
        assert total[u] == pytest.approx((r[u] ** 2).sum(), rel=1e-9)


def test_deadline_breaks_a_solve_off_and_the_next_is_right():
    it = case(nuisances=0)
    solver, other = estimator(it), estimator(it)
    solver.until = time.perf_counter() - 1.0
    with pytest.raises(TimeoutError):
        solver.anneal(it.data, np.arange(3))
    solver.until = np.inf
    assert solver.anneal(it.data, np.arange(3))
    assert other.anneal(it.data, np.arange(3))
    np.testing.assert_array_equal(solver.moved, other.moved)
