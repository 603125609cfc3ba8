"""solve_system on the test set of Moré, Garbow & Hillstrom, from the standard starts times 1, 10 and 100."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

import skinnode as sk
from skinnode import PointKind

from .extended_precision import LONG, verdict
from .more_garbow_hillstrom import FACTORS, PROBLEMS, Problem, solved

PLAIN = ("1 rosenbrock 2", "6 jennrich_sampson 2", "13 powell_singular 4", "35 chebyquad 5")
"""Problems of a plain run; one is solved by no operator."""

by_problem = pytest.mark.parametrize(
    "problem",
    [pytest.param(each, marks=[] if each.name in PLAIN else pytest.mark.long) for each in PROBLEMS],
    ids=lambda problem: problem.name,
)

OPERATORS = {"dogleg": {}, "levenberg_marquardt": {}, "gauss_newton": {"max_steps": 500}}
"""Options of each operator: full steps that have not converged after 489 steps never do."""

# fmt: off
UNSOLVED = {
    "dogleg": {
        "2 freudenstein_roth 2": (1, 10, 100), "3 powell_badly_scaled 2": (100,), "5 beale 2": (10, 100),
        "6 jennrich_sampson 2": (10, 100), "11 gulf 3": (100,), "12 box 3": (10, 100),
        "15 kowalik_osborne 4": (10, 100), "17 osborne_1 5": (100,), "18 biggs 6": (100,),
        "19 osborne_2 11": (10, 100), "35 chebyquad 9": (100,), "35 chebyquad 10": (10, 100),
    },
    "levenberg_marquardt": {
        "2 freudenstein_roth 2": (1, 10, 100), "3 powell_badly_scaled 2": (100,), "5 beale 2": (10,),
        "6 jennrich_sampson 2": (10, 100), "11 gulf 3": (100,), "12 box 3": (10, 100),
        "18 biggs 6": (100,), "19 osborne_2 11": (10, 100), "26 trigonometric 10": (1, 10),
    },
    "gauss_newton": {
        "3 powell_badly_scaled 2": (100,), "5 beale 2": (1,), "6 jennrich_sampson 2": (1, 10, 100),
        "8 bard 3": (10, 100), "9 gaussian 3": (10, 100), "10 meyer 3": (10, 100), "11 gulf 3": (1, 100),
        "12 box 3": (10, 100), "15 kowalik_osborne 4": (10, 100), "16 brown_dennis 4": (1, 10, 100),
        "17 osborne_1 5": (10, 100), "18 biggs 6": (1, 10, 100), "19 osborne_2 11": (1, 10, 100),
        "20 watson 12": (1, 10, 100), "23 penalty_1 4": (1, 10, 100), "23 penalty_1 10": (1, 10, 100),
        "24 penalty_2 4": (1, 10, 100), "24 penalty_2 10": (1, 10, 100),
        "27 brown_almost_linear 30": (1, 10), "27 brown_almost_linear 40": (1, 100),
        "33 linear_rank_1 10": (1, 10, 100), "34 linear_rank_1_with_zeros 10": (1, 10, 100),
        "35 chebyquad 5": (10, 100), "35 chebyquad 6": (1, 10, 100), "35 chebyquad 7": (1, 10, 100),
        "35 chebyquad 8": (1, 10, 100), "35 chebyquad 9": (1, 10, 100), "35 chebyquad 10": (1, 10, 100),
    },
}
# fmt: on
"""Starts from which no root is found or, if the system has none, no minimum. Take out what gets solved."""

BY_ROUNDING = {
    ("dogleg", "5 beale 2", 1),
    ("dogleg", "10 meyer 3", 100),
    ("dogleg", "18 biggs 6", 1),
    ("dogleg", "18 biggs 6", 10),
    ("levenberg_marquardt", "27 brown_almost_linear 30", 100),
    ("levenberg_marquardt", "27 brown_almost_linear 40", 100),
    ("gauss_newton", "26 trigonometric 10", 10),
    ("gauss_newton", "26 trigonometric 10", 100),
}
"""Starts that are solved or not depending on a relative change of 4e-15, so on the processor's exp."""


@by_problem
def test_jacobians_are_those_of_the_functions(problem):
    """Against central differences in 80 bits, at the start and at a random point beside it."""
    rng = np.random.default_rng(1)
    for shift in (0.0, rng.uniform(0.01, 0.1, len(problem.x0))):
        x = (problem.start(1) + shift).astype(LONG)
        j = problem.jacobian(x)
        for k in range(x.size):
            ends = np.stack([x, x])
            ends[:, k] += np.array([1e-7, -1e-7]) * max(1, abs(x[k]))
            r = [problem.residual(end) for end in ends]
            slope = (r[0] - r[1]) / (ends[0, k] - ends[1, k])
            noise = 1e-19 * np.abs(r[0]).max() / 1e-7
            np.testing.assert_allclose(
                j[:, k].astype(float), slope.astype(float), rtol=0, atol=1e-9 * np.abs(j).max() + noise
            )


@by_problem
def test_published_minima_are_those_of_scipy(problem):
    """Six digits of Σ r². From the standard start of problem 2, every solver finds a local minimum."""
    x = problem.start(1) if problem.number != 2 else np.array([4.0, 3.5])
    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-12)
    found = []
    with np.errstate(all="ignore"):
        for method in ("lm", "trf", "dogbox"):
            result = optimize.least_squares(
                problem.residual, x, problem.jacobian, method=method, max_nfev=500, **tolerances
            )
            found.append(2 * result.cost)
    assert min(abs(each - problem.least) for each in found) <= 5e-6 * problem.least + 1e-14


@pytest.mark.parametrize("operator", OPERATORS)
@by_problem
def test_solved_or_the_truth_told(problem: Problem, operator: str):
    for factor in FACTORS:
        with np.errstate(all="ignore"):
            options = OPERATORS[operator]
            solution = sk.solve_system(
                problem.residual, problem.jacobian, problem.start(factor), operator, **options
            )
        tells_the_truth(problem, solution)
        if (operator, problem.name, factor) not in BY_ROUNDING:
            expected = factor not in UNSOLVED[operator].get(problem.name, ())
            assert solved(problem, solution.kind, solution.residual_norm) == expected, (factor, solution)
        if factor == 1 and operator != "gauss_newton" and solution.status is sk.Status.CONVERGED:
            assert solution.residual_norm**2 <= problem.least * (1 + 5e-6) + 1e-18


def tells_the_truth(problem: Problem, solution) -> None:
    """CONVERGED is a root of a square system, a root or minimum of a tall one; the kind is what is there."""
    truth = verdict(problem, solution.x)
    converged, kind, square = solution.status is sk.Status.CONVERGED, solution.kind, problem.square
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(problem.residual(solution.x))
    assert solution.residual_norm == pytest.approx(norm, rel=1e-12, nan_ok=True)
    if kind is PointKind.ROOT:
        assert truth.root
    elif kind is PointKind.MINIMUM:
        assert not truth.root
        assert truth.minimum
        assert truth.isolated
    elif kind in (PointKind.FLAT, PointKind.SADDLE):
        assert truth.cosine <= 1e-6
    if converged:
        assert truth.root or not square
        assert kind in (PointKind.ROOT, PointKind.MINIMUM)
        assert truth.error <= (1.5e-8 if square else 6.1e-6)
        assert solution.error_estimate < np.inf
    else:
        assert kind is not PointKind.MINIMUM or square
        assert solution.error_estimate == np.inf
