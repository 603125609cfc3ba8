"""solve_system on systems of the literature that have nothing to do with skin."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np
import pytest

import skinnode as sk

from .textbook import (
    SQUARE,
    TALL,
    System,
    chebyquad,
    complex_step,
    freudenstein_roth,
    powell_badly_scaled,
    trigonometric,
)

TRUST_REGION = ("levenberg_marquardt", "dogleg")
OPERATORS = ("gauss_newton", *TRUST_REGION)


def solve(system: System, operator: str, **options):
    with np.errstate(all="ignore"):
        return sk.solve_system(system.f, complex_step(system.f), system.x0, operator, **options)


def tells_the_truth(system: System, solution) -> None:
    """Whatever the outcome, the numbers belong to the x given, and CONVERGED means a root or a minimum."""
    with np.errstate(all="ignore"):
        r = system.f(solution.x)
        if not np.isfinite(r).all() or np.abs(r).max() > 1e150:
            assert solution.status is not sk.Status.CONVERGED
            return
        assert solution.residual_norm == pytest.approx(np.linalg.norm(r), rel=1e-12, abs=1e-300)
        if solution.status is not sk.Status.CONVERGED:
            return
        j = complex_step(system.f)(solution.x)
    if r.size == solution.x.size:
        assert np.abs(r).max() <= 1e-10 * max(1.0, np.abs(j).max())
    else:
        slope = np.abs(j.T @ r) / np.linalg.norm(j, axis=0)
        assert (slope <= 1e-6 * np.linalg.norm(r) + 1e-12).all()
    assert solution.error_estimate <= 1e-5 * max(1.0, np.abs(solution.x).max())


@pytest.mark.parametrize("system", SQUARE, ids=lambda s: s.name)
@pytest.mark.parametrize("operator", TRUST_REGION)
def test_roots_of_square_systems(system, operator):
    solution = solve(system, operator)
    tells_the_truth(system, solution)
    if (system.name, operator) == ("trigonometric", "levenberg_marquardt"):
        # the known local minimum of this function, Σ r² = 2.79506e-5: no root, and not called one
        assert solution.residual_norm**2 == pytest.approx(2.79506e-5, rel=1e-5)
        assert solution.status is sk.Status.ILL_CONDITIONED
        return
    assert solution.status is sk.Status.CONVERGED
    if system.root is not None:
        np.testing.assert_allclose(solution.x, system.root, atol=1e-11)


@pytest.mark.parametrize("system", TALL, ids=lambda s: s.name)
@pytest.mark.parametrize("operator", TRUST_REGION)
def test_minima_of_tall_systems(system, operator):
    solution = solve(system, operator)
    tells_the_truth(system, solution)
    if system.root is not None:
        np.testing.assert_allclose(solution.x, system.root, rtol=1e-11)
    else:
        assert solution.residual_norm**2 == pytest.approx(system.minimum, rel=3e-6)
    if system.name == "jennrich-sampson":  # both unknowns are equal at the minimum: J has rank one
        assert solution.status is sk.Status.ILL_CONDITIONED
    else:
        assert solution.status is sk.Status.CONVERGED


@pytest.mark.parametrize("system", SQUARE + TALL, ids=lambda s: s.name)
def test_full_steps_converge_or_say_that_they_did_not(system):
    tells_the_truth(system, solve(system, "gauss_newton"))


@pytest.mark.parametrize("operator", TRUST_REGION)
def test_a_false_minimum_is_not_a_root(operator):
    """Freudenstein & Roth from the standard start ends where Σ r² = 48.9842 and J is singular."""
    solution = solve(System("freudenstein-roth", freudenstein_roth, (0.5, -2.0)), operator)
    assert solution.status is sk.Status.ILL_CONDITIONED
    assert solution.residual_norm**2 == pytest.approx(48.9842, rel=1e-5)
    np.testing.assert_allclose(solution.x, [11.41277, -0.89680], rtol=1e-4)
    assert solution.error_estimate == np.inf


@pytest.mark.parametrize("operator", TRUST_REGION)
def test_chebyquad_8_has_no_root(operator):
    solution = solve(System("chebyquad 8", chebyquad, tuple(np.arange(1, 9) / 9)), operator)
    assert solution.status is sk.Status.ILL_CONDITIONED
    assert solution.residual_norm**2 == pytest.approx(3.51687e-3, rel=1e-5)


def test_powell_badly_scaled_to_the_last_digit():
    """Against Newton's method in 40 decimals."""
    getcontext().prec = 40
    x, y = Decimal("1.098e-5"), Decimal("9.106")
    for _ in range(12):
        f, g = 10000 * x * y - 1, (-x).exp() + (-y).exp() - Decimal("1.0001")
        a, b, c, d = 10000 * y, 10000 * x, -(-x).exp(), -(-y).exp()
        x, y = x - (d * f - b * g) / (a * d - b * c), y - (a * g - c * f) / (a * d - b * c)
    for operator in OPERATORS:
        solution = solve(System("", powell_badly_scaled, (0.0, 1.0)), operator)
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
    wide = sk.solve_system(lambda x: x[:1], lambda x: np.eye(1, 2), [1.0, 2.0])
    assert wide.status is sk.Status.INVALID_START
    nowhere = sk.solve_system(lambda x: x * np.nan, lambda x: np.eye(2), [1.0, 2.0])
    assert nowhere.status is sk.Status.INVALID_START
    np.testing.assert_array_equal(nowhere.x, [1.0, 2.0])


def test_steps_are_bounded_and_counted():
    system = System("trigonometric", trigonometric, (0.1,) * 10)
    cut = solve(system, "dogleg", max_steps=3)
    assert cut.status is sk.Status.MAX_STEPS
    assert (cut.stats.steps, cut.stats.evaluations) == (3, 1 + 3)
    calls = {"f": 0, "j": 0}

    def f(x):
        calls["f"] += 1
        return system.f(x)

    def j(x):
        calls["j"] += 1
        return complex_step(system.f)(x)

    stats = sk.solve_system(f, j, system.x0).stats
    assert (stats.evaluations, stats.jacobians) == (calls["f"], calls["j"])
    assert stats.steps == calls["f"] - 1  # one trial point each, after the start


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
