"""Single steps of the operators against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.solve import operators
from skinnode.solve.operators import EPS, LAM, LEVENBERG_MARQUARDT, LIMIT, RADIUS, REJECTED, TRY, workspace


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 34),
    st.integers(0, 12),
    st.sampled_from([0.0, 3.0, 9.0, 14.0, np.inf]),
    st.integers(0, 2**32 - 1),
)
def test_shortened_step_is_the_damped_one_of_the_right_length(n, spare, decades, seed):
    """s = −(JᵀJ + lam D²)⁻¹ Jᵀr with ‖D s‖ within a tenth of the radius, by the SVD of J D⁻¹; J singular
    (inf decades), nearly so and not, its columns of very different size, m = n and more."""
    rng = np.random.default_rng(seed)
    m = n + spare
    size = 10.0 ** -np.linspace(0.0, min(decades, 20.0), n)
    if n > 1 and decades == np.inf:
        size[-1] = 0.0
    left, right = np.linalg.qr(rng.normal(size=(m, n)))[0], np.linalg.qr(rng.normal(size=(n, n)))[0]
    j = (left * size) @ right * 10.0 ** rng.uniform(-6, 6, n)
    r = rng.normal(size=m)
    w = workspace(n, m)
    w.x[:] = 1.0
    w.r[:] = r
    w.jt[:] = j.T
    scale = np.linalg.norm(j, axis=0)
    u, sigma, vt = np.linalg.svd(j / scale, full_matrices=False)
    w.s[LIMIT] = 1e-2 * np.linalg.norm(u.T @ r) / np.linalg.norm(scale)  # sigma ≤ √n: Newton's is longer
    assert operators.start(w) == TRY
    assert operators.advance(LEVENBERG_MARQUARDT, w, REJECTED, 0.0, 0.0) == TRY
    lam, radius = w.s[LAM], w.s[RADIUS]
    assert lam > 0
    assert radius == pytest.approx(1e-2 * np.linalg.norm(u.T @ r))
    assert abs(np.linalg.norm(scale * w.step) - radius) <= 0.1001 * radius
    truth = -(vt.T @ (sigma / (sigma**2 + lam) * (u.T @ r)))
    # what rounding does to [J D⁻¹; √lam I] (Golub & Van Loan, 5.3.7): condition and what is left of r
    condition = np.sqrt((sigma[0] ** 2 + lam) / lam)
    open_ = condition * (radius + np.linalg.norm(r) / np.sqrt(lam))
    np.testing.assert_allclose(scale * w.step, truth, rtol=0, atol=10 * (n + m) * EPS * open_)
