"""The dense kernels of the posterior against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.solve.linalg import cholesky as dense
from skinnode.solve.linalg.qr import orthonormalise

EPS = np.finfo(float).eps
SIZES = st.sampled_from([1, 3, 29, 30, 31, 90, 300]) | st.integers(1, 70)
SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=25, deadline=None)


def spread(seed: int, n: int, size: float) -> np.ndarray:
    """S = I + B Bᵀ (n, n) as a posterior forms it, with ‖B‖ = ``size`` and fewer columns than rows."""
    rng = np.random.default_rng(seed)
    b = rng.normal(size=(n, max(1, (2 * n) // 3)))
    b *= size / np.linalg.norm(b, 2)
    return np.eye(n) + b @ b.T


def factor(s: np.ndarray, room: int = 0) -> np.ndarray:
    """Both triangles of the factor in a buffer with ``room`` rows and columns to spare."""
    n = len(s)
    buffer = np.full((n + room, n + room), np.nan)
    buffer[:n, :n] = np.triu(s)
    assert dense.cholesky(buffer, n) == 1
    assert np.isnan(buffer[n:]).all()
    assert np.isnan(buffer[:, n:]).all()
    return buffer


@FEW
@given(SIZES, SEEDS, st.sampled_from([1e-3, 1.0, 1e3, 1e7]))
def test_factor_gives_the_matrix_back(n, seed, size):
    """Backward error within Higham's bound (Accuracy and stability, 2002, theorem 10.3), singular or not."""
    s = spread(seed, n, size)
    both = factor(s, room=seed % 3)[:n, :n]
    lower = np.tril(both)
    np.testing.assert_array_equal(lower, np.triu(both).T)
    assert (np.diag(lower) > 0).all()
    limit = (n + 1) * EPS * np.sqrt(np.outer(np.diag(s), np.diag(s)))
    assert (np.abs(lower @ lower.T - s) <= 2 * limit).all()  # ours and that of the product here
    if size <= 1.0:
        np.testing.assert_allclose(lower, scipy.linalg.cholesky(s, lower=True), rtol=0, atol=1e-14 * n)


@pytest.mark.parametrize("n", [1, 6, 31, 90])
@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.nan, np.inf])
def test_matrix_that_has_no_factor_is_refused(n, wrong):
    s = spread(1, n, 1.0)
    s[n - 1, n - 1] = wrong
    assert dense.cholesky(s, n) == 0


@FEW
@given(SIZES, st.integers(1, 70), SEEDS, st.sampled_from([1.0, 1e7]))
def test_triangular_solves(n, cols, seed, size):
    """Each column to the backward error of substitution (Higham, theorem 8.5): |L X − B| ≤ n eps |L| |X|."""
    rng = np.random.default_rng(seed)
    l = factor(spread(seed, n, size), room=seed % 2)
    lower = np.tril(l[:n, :n])
    right = rng.normal(size=(n + 2, cols + 5))
    x = right.copy()
    dense.solve_lower(l, x, n, cols)
    np.testing.assert_array_equal(x[n:], right[n:])
    np.testing.assert_array_equal(x[:, cols:], right[:, cols:])
    x, b = x[:n, :cols], right[:n, :cols]

    def assert_solves(matrix, solution, value):
        slack = (n + 3) * EPS * (np.abs(matrix) @ np.abs(solution) + np.abs(value))
        assert (np.abs(matrix @ solution - value) <= 2 * slack).all()

    assert_solves(lower, x, b)
    whole = right.copy()
    dense.solve_lower_transposed(l, whole, n, cols)
    np.testing.assert_array_equal(whole[n:], right[n:])
    np.testing.assert_array_equal(whole[:, cols:], right[:, cols:])
    assert_solves(lower.T, whole[:n, :cols], b)
    forward, backward = right[:, 0].copy(), right[:, 0].copy()
    dense.solve_lower_vector(l, forward, n)
    dense.solve_lower_transposed_vector(l, backward, n)
    assert_solves(lower, forward[:n], b[:, 0])
    assert_solves(lower.T, backward[:n], b[:, 0])
    np.testing.assert_array_equal(forward[n:], right[n:, 0])
    np.testing.assert_array_equal(backward[n:], right[n:, 0])
    if size == 1.0:
        np.testing.assert_allclose(x, scipy.linalg.solve_triangular(lower, b, lower=True), atol=1e-12)


@FEW
@given(SIZES, SEEDS)
def test_a_positive_definite_system_is_solved_and_another_refused(n, seed):
    s, rng = spread(seed, n, 30.0), np.random.default_rng(seed)
    x = rng.normal(size=n)
    b = np.append(s @ x, np.nan)
    assert dense.solve_positive(s.copy(), b, n)
    np.testing.assert_allclose(b[:n], x, atol=1e-9 * np.abs(x).max())
    assert np.isnan(b[n])
    s[n - 1, n - 1] = -s[n - 1, n - 1]
    before = b.copy()
    assert not dense.solve_positive(s, b, n)
    np.testing.assert_array_equal(b, before)


@FEW
@given(SIZES, SEEDS)
def test_inverse_diagonal(n, seed):
    s = spread(seed, n, 30.0)
    l = factor(s)
    work, out = np.full((n, n), np.nan), np.full(n + 1, np.nan)
    dense.inverse_diagonal(l, work, out, n)
    np.testing.assert_allclose(out[:n], np.diag(np.linalg.inv(s)), rtol=1e-11)
    assert np.isnan(out[n])


@FEW
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 320), SEEDS)
def test_products(m, k, n, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(m, k)), rng.normal(size=(k, n))
    c = np.full((m, n), np.nan)
    dense.multiply(a, b, c)
    assert (np.abs(c - a @ b) <= 2 * k * EPS * (np.abs(a) @ np.abs(b))).all()
    v, one = rng.normal(size=k), np.full(m, np.nan)
    dense.multiply_vector(a, v, one)
    assert (np.abs(one - a @ v) <= 2 * k * EPS * (np.abs(a) @ np.abs(v))).all()


@FEW
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 80), SEEDS)
def test_a_product_is_subtracted(m, k, n, seed):
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(m, k)), rng.normal(size=(k, n)), rng.normal(size=(m, n))
    expected, size = c - a @ b, np.abs(c) + np.abs(a) @ np.abs(b)
    dense.subtract_product(a, b, c)
    assert (np.abs(c - expected) <= 2 * (k + 1) * EPS * size).all()


@FEW
@given(st.integers(1, 20), st.integers(0, 30), st.integers(0, 6), SEEDS)
def test_orthonormal_rows_span_the_rows_however_close_these_are(n, more, tilt, seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n, n + more)) + 10.0**tilt * rng.normal(size=n + more)
    q = rows.copy()
    orthonormalise(q, np.empty(n))
    np.testing.assert_allclose(q @ q.T, np.eye(n), atol=1e-13 * n)
    np.testing.assert_allclose(rows @ q.T @ q, rows, atol=1e-12 * np.abs(rows).max())


def test_no_split_of_the_work_changes_a_bit():
    """Threads may share out the columns as they like."""
    n, rng = 90, np.random.default_rng(3)
    l = factor(spread(3, n, 1e3))
    b = rng.normal(size=(n, 77))
    whole, product = b.copy(), np.empty((n, 77))
    dense.solve_lower(l, whole, n, 77)
    dense.multiply(l, b, product)
    for start, end in ((0, 1), (1, 9), (9, 40), (40, 77)):
        part = np.ascontiguousarray(b[:, start:end])
        some = np.empty_like(part)
        dense.multiply(l, part, some)
        dense.solve_lower(l, part, n, end - start)
        np.testing.assert_array_equal(part, whole[:, start:end])
        np.testing.assert_array_equal(some, product[:, start:end])
