"""Single steps of the operators against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import KroghInterpolator
from scipy.optimize import brentq, minimize_scalar

from skinnode.solve.operators import loop
from skinnode.solve.operators.codes import EPS, LEVENBERG_MARQUARDT, OPERATORS, REJECTED, TRY
from skinnode.solve.operators.work import LAM, LIMIT, NEWTON_LENGTH, RADIUS, workspace

DOGLEG = OPERATORS["dogleg"]


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
    assert loop.start(w) == TRY
    assert loop.advance(LEVENBERG_MARQUARDT, w, REJECTED, 0.0, 0.0) == TRY
    lam, radius = w.s[LAM], w.s[RADIUS]
    assert lam > 0
    assert radius == pytest.approx(1e-2 * np.linalg.norm(u.T @ r))
    assert abs(np.linalg.norm(scale * w.step) - radius) <= 0.1001 * radius
    truth = -(vt.T @ (sigma / (sigma**2 + lam) * (u.T @ r)))
    # what rounding does to [J D⁻¹; √lam I] (Golub & Van Loan, 5.3.7): condition and what is left of r
    condition = np.sqrt((sigma[0] ** 2 + lam) / lam)
    open_ = condition * (radius + np.linalg.norm(r) / np.sqrt(lam))
    np.testing.assert_allclose(scale * w.step, truth, rtol=0, atol=10 * (n + m) * EPS * open_)


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(
    st.integers(1, 6),
    st.integers(0, 3),
    st.one_of(st.floats(1e-3, 1.0, exclude_max=True), st.just(1.0 - 2.0**-53)),
    st.integers(0, 2**32 - 1),
)
@example(n=1, spare=0, share=1.0 - 2.0**-53, seed=57)
@example(n=1, spare=1, share=1.0 - 2.0**-53, seed=193)
def test_the_dogleg_step_ends_where_its_path_leaves_the_trust_region(n, spare, share, seed):
    """The path leads from 0 to the Cauchy point to the Newton point: by dense algebra in scaled unknowns, its
    crossing by bisection. With one unknown, the two points are one."""
    rng = np.random.default_rng(seed)
    j = rng.normal(size=(n + spare, n)) * 10.0 ** rng.uniform(-6, 6, n)
    r = rng.normal(size=n + spare)
    scale = np.linalg.norm(j, axis=0)
    scaled = j / scale
    newton = -np.linalg.lstsq(scaled, r, rcond=None)[0]
    gradient = scaled.T @ r
    cauchy = -gradient * (gradient @ gradient) / np.sum((scaled @ gradient) ** 2)

    def path(t: float) -> np.ndarray:
        return t * cauchy if t < 1.0 else cauchy + (t - 1.0) * (newton - cauchy)

    radius = np.inf
    for _ in range(2):  # the first step is the Newton step and tells its length
        w = workspace(n, n + spare)
        w.r[:], w.jt[:] = r, j.T
        assert loop.start(w) == TRY
        w.s[RADIUS] = radius
        assert loop.advance(DOGLEG, w, REJECTED, 0.0, 0.0) == TRY
        radius = share * w.s[NEWTON_LENGTH]
    radius = w.s[RADIUS]
    assert radius < w.s[NEWTON_LENGTH]

    def beyond(t: float) -> float:
        return float(np.linalg.norm(path(t)) - radius)

    truth = path(brentq(beyond, 0.0, 2.0)) if beyond(2.0) > 0.0 else newton
    np.testing.assert_allclose(scale * w.step, truth, rtol=0, atol=1e-9 * np.linalg.norm(newton))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12),
    st.integers(0, 6),
    st.booleans(),
    st.sampled_from([0.01, 0.3, 0.9]),
    st.sampled_from([0.0, 1e-6, 1e-2, 1.0]),
    st.integers(0, 2**32 - 1),
)
@example(n=6, spare=0, singular=False, share=0.9, kept=1.0, seed=1)
@example(n=6, spare=2, singular=False, share=0.9, kept=1.0, seed=2)
@example(n=6, spare=0, singular=True, share=0.9, kept=1.0, seed=3)
def test_a_damping_that_is_too_strong_is_lowered(n, spare, singular, share, kept, seed):
    """The damping kept from an earlier step, as a share of the largest possible one, may be far too strong.

    The step still has the length of the radius within a tenth, by the SVD. The radius is shorter than the
    shortest minimiser of ‖J s + r‖, so that such a step exists where J is singular too.
    """
    rng = np.random.default_rng(seed)
    m = n + spare
    size = np.linspace(1.0, 0.2, n)
    if singular and n > 1:
        size[-1] = 0.0
    left, right = np.linalg.qr(rng.normal(size=(m, n)))[0], np.linalg.qr(rng.normal(size=(n, n)))[0]
    j, r = (left * size) @ right, rng.normal(size=m)
    scale = np.linalg.norm(j, axis=0)
    u, sigma, vt = np.linalg.svd(j / scale, full_matrices=False)
    known = sigma > 1e-12 * sigma[0]
    u, sigma, vt = u[:, known], sigma[known], vt[known]
    along = u.T @ r
    radius = share * np.linalg.norm(along / sigma)
    w = workspace(n, m)
    w.r[:], w.jt[:] = r, j.T
    assert loop.start(w) == TRY
    w.s[RADIUS], w.s[LAM] = radius, kept * np.linalg.norm(sigma * along) / radius
    assert loop.advance(LEVENBERG_MARQUARDT, w, REJECTED, 0.0, 0.0) == TRY
    assert w.s[RADIUS] == radius
    assert abs(np.linalg.norm(scale * w.step) - radius) <= 0.1001 * radius
    truth = -(vt.T @ (sigma / (sigma**2 + w.s[LAM]) * along))
    np.testing.assert_allclose(scale * w.step, truth, rtol=0, atol=1e-9 * radius)


@pytest.mark.parametrize("operator", [LEVENBERG_MARQUARDT, DOGLEG])
@pytest.mark.parametrize("growth", [1.02, 1.5, 2.0, 2.9, 3.5, 9.9, 10.1, np.inf])
@pytest.mark.parametrize("share", [0.2, 0.9, 20.0])
def test_a_rejected_step_shrinks_the_radius_to_the_minimiser_of_the_parabola(operator, growth, share):
    """The parabola through ‖r‖² at both ends of the step with its slope at the start, minimised by scipy.

    The factor lies between 1/10 and 1/2, and is 1/10 if ‖r‖ grew tenfold (Moré 1978; MINPACK lmder).
    """
    rng = np.random.default_rng(5)
    n = 6
    j, r = rng.normal(size=(n, n)), rng.normal(size=n)
    w = workspace(n, n)
    w.x[:], w.r[:], w.jt[:] = rng.normal(size=n), r, j.T
    scale = np.linalg.norm(j, axis=0)
    newton = np.linalg.norm(scale * np.linalg.solve(j, r))
    assert loop.start(w) == TRY
    w.s[RADIUS] = share * newton
    assert loop.advance(operator, w, REJECTED, 0.0, 0.0) == TRY
    radius, step = w.s[RADIUS], w.step.copy()
    slope = 2.0 * (r @ j @ step) / (r @ r)
    with np.errstate(invalid="ignore"):
        w.r_trial[:] = growth * np.linalg.norm(r) * np.eye(n)[0]
    expected = 0.1
    if growth < 10.0:
        parabola = KroghInterpolator([0.0, 0.0, 1.0], [1.0, slope, growth**2])
        expected = minimize_scalar(parabola, bounds=(0.1, 0.5), method="bounded", options={"xatol": 1e-10}).x
    assert loop.advance(operator, w, TRY, 0.0, 0.0) == TRY
    length = np.linalg.norm(scale * step)
    assert w.s[RADIUS] == pytest.approx(expected * min(10.0 * length, radius), rel=1e-6)
    np.testing.assert_array_equal(w.r, r)
    assert np.linalg.norm(scale * w.step) <= 1.1001 * w.s[RADIUS]
