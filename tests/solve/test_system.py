"""solve_system: what its statuses and kinds mean, against closed forms; bad arguments."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np
import pytest

import skinnode as sk

from .more_garbow_hillstrom import (
    Pair,
    Vector,
    chebyquad,
    freudenstein_roth,
    jennrich_sampson,
    powell_badly_scaled,
    trigonometric,
)

TRUST_REGION = ("levenberg_marquardt", "dogleg")
OPERATORS = ("gauss_newton", *TRUST_REGION)


def solve(pair, x0, operator="dogleg", **options):
    with np.errstate(all="ignore"):
        return sk.solve_system(lambda x: pair(x)[0], lambda x: pair(x)[1], x0, operator, **options)


@pytest.mark.parametrize("operator", TRUST_REGION)
@pytest.mark.parametrize(
    ("pair", "x0", "minimum"),
    [(freudenstein_roth, (0.5, -2.0), 48.9842), (chebyquad, tuple(np.arange(1, 9) / 9), 3.51687e-3)],
)
def test_a_minimum_of_a_square_system_is_not_a_root(pair, x0, minimum, operator):
    solution = solve(pair, x0, operator)
    assert solution.status is sk.Status.ILL_CONDITIONED
    assert solution.kind is sk.PointKind.MINIMUM
    assert solution.residual_norm**2 == pytest.approx(minimum, rel=3e-6)
    assert solution.error_estimate == np.inf
    assert solution.optimality <= 1e-8


@pytest.mark.parametrize("operator", TRUST_REGION)
def test_a_minimum_where_the_jacobian_is_singular(operator):
    """Jennrich & Sampson: x₁ = x₂ at the minimum, so J has rank one, and only the Hessian determines x."""
    solution = solve(jennrich_sampson, (0.3, 0.4), operator)
    getcontext().prec = 40
    x, h = Decimal("0.2578"), Decimal("1e-15")

    def slope(x: Decimal) -> Decimal:
        """The derivative of ½ Σ r² along x₁ = x₂."""
        return sum(-2 * i * (i * x).exp() * (2 + 2 * i - 2 * (i * x).exp()) for i in range(1, 11))

    for _ in range(12):
        x -= slope(x) * 2 * h / (slope(x + h) - slope(x - h))
    assert solution.status is sk.Status.CONVERGED
    assert solution.kind is sk.PointKind.MINIMUM
    assert solution.residual_norm**2 == pytest.approx(124.362, rel=3e-6)
    np.testing.assert_allclose(solution.x, float(x), rtol=0, atol=min(solution.error_estimate, 1e-9))


def test_saddles_and_maxima_are_no_minima():
    """Tall, J has full rank and Jᵀr = 0 at the start: the operators' own criterion is met."""

    def hill(x: Vector) -> Pair:
        return np.array([x[0] ** 2 - 1, x[0] / 10, x[1]]), np.array([[2 * x[0], 0], [0.1, 0], [0, 1]])

    for operator in OPERATORS:
        solution = solve(hill, (0.0, 0.0), operator)
        assert solution.status is sk.Status.ILL_CONDITIONED
        assert solution.kind is sk.PointKind.SADDLE
        valley = solve(hill, (0.9, 1.0), operator)
        assert valley.status is sk.Status.CONVERGED
        assert valley.kind is sk.PointKind.MINIMUM
        np.testing.assert_allclose(valley.x, [np.sqrt(1 - 0.005), 0.0], rtol=0, atol=1e-12)


def test_a_valley_of_minima_is_flat():
    """x + y is fitted to 1, 2 and 3: every point of x + y = 2 is a minimum, none of them the answer."""
    j = np.ones((3, 2))
    for operator in TRUST_REGION:
        solution = sk.solve_system(lambda x: j @ x - [1, 2, 3], lambda x: j, [5.0, 0.0], operator)
        assert solution.status is sk.Status.ILL_CONDITIONED
        assert solution.kind is sk.PointKind.FLAT
        assert solution.x.sum() == pytest.approx(2)


def test_powell_badly_scaled_to_the_last_digit():
    """Against Newton's method in 40 decimals."""
    getcontext().prec = 40
    x, y = Decimal("1.098e-5"), Decimal("9.106")
    for _ in range(12):
        f, g = 10000 * x * y - 1, (-x).exp() + (-y).exp() - Decimal("1.0001")
        a, b, c, d = 10000 * y, 10000 * x, -(-x).exp(), -(-y).exp()
        x, y = x - (d * f - b * g) / (a * d - b * c), y - (a * g - c * f) / (a * d - b * c)
    for operator in OPERATORS:
        solution = solve(powell_badly_scaled, (0.0, 1.0), operator)
        assert solution.kind is sk.PointKind.ROOT
        np.testing.assert_allclose(solution.x, [float(x), float(y)], rtol=1e-12)


def test_a_double_root_is_found_and_its_slow_approach_counted():
    """J is singular at the root: the error halves a step, and the estimate must follow it."""
    solution = sk.solve_system(lambda x: x**2, lambda x: np.diag(2 * x), [1.0], tol_f=1e-30, tol_x=1e-10)
    assert solution.status is sk.Status.CONVERGED
    assert 0 < abs(solution.x[0]) <= 10 * solution.error_estimate <= 1e-8


def test_no_root_at_all():
    solution = sk.solve_system(lambda x: x**2 + 1, lambda x: np.diag(2 * x), [3.0])
    assert solution.status not in (sk.Status.CONVERGED, sk.Status.MAX_STEPS)
    assert abs(solution.x[0]) < 1e-3
    assert solution.residual_norm == pytest.approx(1.0)


def test_a_root_that_is_not_isolated_is_ill_conditioned():
    """x + y = 2 twice: a line of roots, none of them the answer."""
    solution = sk.solve_system(
        lambda x: np.array([x[0] + x[1] - 2, 2 * x[0] + 2 * x[1] - 4]),
        lambda x: np.array([[1.0, 1.0], [2.0, 2.0]]),
        [3.0, 1.0],
    )
    assert solution.status is sk.Status.ILL_CONDITIONED
    assert solution.kind is sk.PointKind.ROOT


def test_a_step_into_nowhere_is_taken_back():
    """log x from a start whose Newton step leaves the domain."""
    with np.errstate(all="ignore"):
        for operator in TRUST_REGION:
            solution = sk.solve_system(np.log, lambda x: np.diag(1 / x), [10.0], operator)
            assert solution.status is sk.Status.CONVERGED
            assert solution.x[0] == pytest.approx(1.0, abs=1e-12)
        full = sk.solve_system(np.log, lambda x: np.diag(1 / x), [10.0], "gauss_newton")
    assert full.status is sk.Status.NON_FINITE
    assert np.isfinite(full.x).all()


def test_starts_that_cannot_be_used():
    far = sk.solve_system(
        lambda x: np.array([np.inf, 1.0, x[0]]), lambda x: np.array([[0.0], [0.0], [1.0]]), [1.0]
    )
    assert far.status is sk.Status.INVALID_START
    wide = sk.solve_system(lambda x: x[:1], lambda x: np.eye(1, 2), [1.0, 2.0])
    assert wide.status is sk.Status.INVALID_START
    nowhere = sk.solve_system(lambda x: x * np.nan, lambda x: np.eye(2), [1.0, 2.0])
    assert nowhere.status is sk.Status.INVALID_START
    np.testing.assert_array_equal(nowhere.x, [1.0, 2.0])


def test_steps_are_bounded_and_counted():
    x0 = (0.1,) * 10
    cut = solve(trigonometric, x0, max_steps=3)
    assert cut.status is sk.Status.MAX_STEPS
    assert cut.kind is sk.PointKind.UNFINISHED
    assert (cut.stats.steps, cut.stats.evaluations) == (3, 1 + 3)
    for pair, start in (
        (trigonometric, x0),
        (jennrich_sampson, (0.3, 0.4)),
        (freudenstein_roth, (0.5, -2.0)),
    ):
        calls = {"f": 0, "j": 0}

        def f(x, pair=pair, calls=calls):
            calls["f"] += 1
            return pair(x)[0]

        def j(x, pair=pair, calls=calls):
            calls["j"] += 1
            return pair(x)[1]

        stats = sk.solve_system(f, j, start).stats
        assert (stats.evaluations, stats.jacobians) == (calls["f"], calls["j"])
        assert stats.steps == calls["f"] - 1  # one trial point each, after the start


@pytest.mark.parametrize(
    ("pair", "x0"), [(chebyquad, (0.5, 4.0, 6.0, 8.0, 9.5)), (jennrich_sampson, (0.3, 0.4))]
)
def test_functions_may_return_the_same_array_every_time(pair, x0):
    """The first system needs a second attempt from the start, the second one differences of J."""
    r, j = pair(np.array(x0))

    def residual(x):
        r[:] = pair(x)[0]
        return r

    def jacobian(x):
        j[:] = pair(x)[1]
        return j

    fresh, reused = solve(pair, x0), sk.solve_system(residual, jacobian, x0)
    assert fresh.status is reused.status is sk.Status.CONVERGED
    assert fresh.stats.evaluations == reused.stats.evaluations > 50
    np.testing.assert_array_equal(fresh.x, reused.x)


def test_a_wrong_jacobian_never_ends_converged():
    for operator in OPERATORS:
        solution = sk.solve_system(
            lambda x: np.array([x[0] - 1, x[1] ** 3 - 8]),
            lambda x: np.array([[-1.0, 0], [0, -1.0]]),
            [0.0, 1.0],
            operator,
            max_steps=200,
        )
        assert solution.status is not sk.Status.CONVERGED


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"x0": [[1.0]]}, r"x0: got shape \(1, 1\), must be \(n,\)"),
        ({"x0": [np.nan]}, "x0: got nan"),
        ({"jacobian": lambda x: np.eye(3)}, r"jacobian\(x\): got shape \(3, 3\), must be \(1, 1\)"),
        ({"operator": "brent"}, "operator: got 'brent'"),
        ({"tol_x": -1.0}, "tol_x: got -1.0, must be positive"),
        ({"max_steps": 0}, "max_steps: got 0"),
    ],
)
def test_bad_arguments_are_named(options, complaint):
    arguments = {"residual": lambda x: x, "jacobian": lambda x: np.eye(x.size), "x0": [1.0]} | options
    with pytest.raises(ValueError, match=complaint):
        sk.solve_system(**arguments)


@pytest.mark.parametrize("max_steps", [0, 2.5, np.nan])
def test_a_number_of_steps_is_an_integer(max_steps):
    with pytest.raises(ValueError, match="max_steps: got"):
        sk.solve_system(lambda x: x, lambda x: np.eye(1), [1.0], max_steps=max_steps)


def test_complex_functions_are_refused():
    """Their real part has roots that they have not."""
    with pytest.raises(ValueError, match="real numbers"):
        sk.solve_system(lambda x: x**2 - 2 + 1j, lambda x: np.array([[2 * x[0]]]), [5.0])
