"""Measurement update: the linear algebra of one Gauss-Newton step of the posterior.

The update works in data space, like the measurement update of a Kalman filter.

The unknowns are the free coordinates x of all electrodes, with the prior x ~ N(0, s² C), and a few nuisances
g ~ N(0, diag(d)). Each wire has the residual r = w (a F(x) − 1) with w = 1/σ. The model is

    r(x) − H g = noise of variance 1,      H = effect of a unit of each nuisance on r

Let J = ∂r/∂x, which is block-diagonal over wires. A Gauss-Newton step from x yields

    x⁺ = s² C Jᵀ S⁻¹ y,   g⁺ = −d Hᵀ S⁻¹ y,   y = J x − r,   S = I + s² J C Jᵀ + H d Hᵀ

S is the innovation covariance, s² J C the cross-covariance and K = s² C Jᵀ S⁻¹ the Kalman gain. The posterior
covariance at x⁺ is s² C − Vᵀ V, where V = L⁻¹ (s² J C) and L Lᵀ = S (Tarantola, Inverse Problem Theory, 2005,
section 3.4). No eigenvalue of S is less than 1, so rounding errors do not grow with the condition number of
J. Rounding errors are at most ε ‖S‖ standard deviations, where ε is the machine precision. For signals of 10⁶
σ, this is a thousandth of a standard deviation.

A chord step is a Newton step with the factors of an earlier J. Chord steps converge to the same maximum. At
the maximum, the vectors e_x = −s² C Jᵀ (r − H g) − x and e_g = d Hᵀ (r − H g) − g are zero. With the earlier
J, H and S, a chord step is

    δ = e − (s² C Jᵀ; −d Hᵀ) S⁻¹ (J e_x − H e_g)

A chord step requires only two triangular solves.

If a wire has more equations than unknowns, a QR decomposition of [J H] first reduces them to one equation per
unknown. No information is lost. The reduction is not possible with geometry errors
(:mod:`skinnode.solve.posterior.geometry_error`), because each lower wire then has its own nuisances. The
geometry errors follow the other p nuisances in g. For the geometry errors, H is sparse, and only its non-zero
elements are stored.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.kernels import potential, potential_jacobian, relative_residual_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import (
    multiply,
    solve_lower_transposed,
    solve_lower_transposed_vector,
    solve_lower_vector,
)
from skinnode.solve.linalg.qr import qr_factor, qr_project
from skinnode.solve.linalg.vectors import Index, dot
from skinnode.solve.posterior.geometry_error import add_effect, effect_on


class Buffers(NamedTuple):
    """Arrays written by a Gauss-Newton step, for one patch.

    Each of the U wires has K equations and f free coordinates; there are p nuisances. A reduced wire has R =
    min(K, f + p) rows. With geometry errors, R = K. The large arrays of the factors (``cross_covariance``,
    ``innovation_covariance`` and ``whitened``) can be freed while there are no factors
    (:func:`without_factors`).
    """

    r: Float
    """(U, K) residuals."""
    jt: Float
    """(U, 3N, K) transposed Jacobians."""
    free_jt: Float
    """(f + p, K) rows of Jᵀ for the free coordinates of one wire, followed by its Hᵀ."""
    jacobian: Float
    """(U R, f) stacked matrices J of the wires in the step."""
    nuisance: Float
    """(U R, p) stacked matrices H of the wires in the step."""
    y: Float
    """(U R,) right-hand side y = J x − r."""
    cross_covariance: Float
    """(U R, U f) cross-covariance s² J C of the data and the displacement."""
    innovation_covariance: Float
    """(U R, U R) innovation covariance S; the factorisation overwrites it with the Cholesky factor L."""
    whitened: Float
    """(U R, U f) whitened cross-covariance V = L⁻¹ (s² J C)."""
    gradient: Float
    """(U f,) gradient Jᵀ (r − H g)."""
    v: Float
    """(U R,) work array."""
    block: Float
    """(f, R) contiguous copy of one wire's Jᵀ."""
    qr: Float
    """(K, f + p) QR decomposition of one wire's [J H]."""
    diagonal: Float
    """(f + p,) diagonal of the triangular factor of the QR decomposition."""
    beta: Float
    """(f + p,) scale factors of the Householder vectors of the QR decomposition."""
    scratch: Float
    """(f + p,) work array."""
    e: Float
    """(K,) work array."""
    effect: Float
    """(U, K, E) non-zero elements of H for the geometry errors; E = 0 if none are modelled."""
    factored_effect: Float
    """(U, K, E) copy of ``effect`` that belongs to the current factors."""


def make_buffers(  # noqa: PLR0913 - the sizes of a patch
    wires: int, equations: int, coordinates: int, free: int, nuisances: int, effects: int = 0
) -> Buffers:
    """Return zeroed buffers. All sizes except ``wires`` and ``nuisances`` are per wire."""
    columns = free + nuisances
    rows = equations if effects else min(equations, columns)
    m, n = wires * rows, wires * free
    return Buffers(
        r=np.zeros((wires, equations)), jt=np.zeros((wires, coordinates, equations)),
        free_jt=np.zeros((columns, equations)), jacobian=np.zeros((m, free)),
        nuisance=np.zeros((m, nuisances)), y=np.zeros(m),
        cross_covariance=np.zeros((m, n)), innovation_covariance=np.zeros((m, m)), whitened=np.zeros((m, n)),
        gradient=np.zeros(n), v=np.zeros(m),
        block=np.zeros((free, rows)), qr=np.zeros((equations, columns)), diagonal=np.zeros(columns),
        beta=np.zeros(columns), scratch=np.zeros(columns), e=np.zeros(equations),
        effect=np.zeros((wires, equations, effects)), factored_effect=np.zeros((wires, equations, effects)),
    )  # fmt: skip


def with_factors(b: Buffers) -> Buffers:
    """Return the buffers with uninitialised arrays for the factors; see :func:`without_factors`."""
    return b if b.whitened.size else _resized(b, b.v.size)


def without_factors(b: Buffers) -> Buffers:
    """Return the buffers with empty arrays instead of the factors. Kernels must not use them."""
    return _resized(b, 0)


def _resized(b: Buffers, rows: int) -> Buffers:
    return b._replace(
        cross_covariance=np.empty((rows, b.gradient.size)),
        innovation_covariance=np.empty((rows, b.v.size)),
        whitened=np.empty((rows, b.gradient.size)),
    )


@njit
def linearise(  # noqa: PLR0913 - a kernel: arrays by name
    members: Index, x: Float, lower: Float, a: Float, weight: Float, r: Float, jt: Float
) -> None:
    """Write r = w (a F − 1) and its transposed Jacobian at ``x`` (U, 3N) for the wires ``members`` (P,)."""
    potentials(members, x, lower, r, jt)
    weigh(members, a, weight, r, jt)


@njit
def potentials(members: Index, x: Float, lower: Float, f: Float, jt: Float) -> None:
    """Write F (U, K) and its transposed Jacobian (U, 3N, K) at ``x`` (U, 3N) for the wires ``members``."""
    for i in range(members.size):
        u = members[i]
        potential_jacobian(x[u], lower, f[u], jt[u])


@njit
def weigh(members: Index, a: Float, weight: Float, r: Float, jt: Float) -> None:
    """Replace F and its Jacobian with r = w (a F − 1) and the Jacobian of r."""
    for i in range(members.size):
        u = members[i]
        r_u, jt_u, a_u, w_u = r[u], jt[u], a[u], weight[u]
        for k in range(r_u.size):
            r_u[k] = w_u[k] * relative_residual_part(a_u[k], r_u[k])
        for j in range(jt_u.shape[0]):
            row = jt_u[j]
            for k in range(r_u.size):
                row[k] *= w_u[k] * a_u[k]


@njit
def residuals(  # noqa: PLR0913 - a kernel: arrays by name
    members: Index, x: Float, lower: Float, a: Float, weight: Float, h: Float, g: Float, r: Float
) -> float:
    """Write w (a F − 1) − H g for the wires ``members`` (P,) into ``r`` (U, K); return the sum of squares."""
    square = 0.0
    for i in range(members.size):
        u = members[i]
        r_u, a_u, w_u = r[u], a[u], weight[u]
        potential(x[u], lower, r_u)
        for k in range(r_u.size):
            r_u[k] = w_u[k] * relative_residual_part(a_u[k], r_u[k])
        for q in range(g.size):
            for k in range(r_u.size):
                r_u[k] -= h[u, k, q] * g[q]
        square += dot(r_u, r_u)
    return square


@njit
def measure_fit(  # noqa: PLR0913 - a kernel: arrays by name
    free: Index, h: Float, g: Float, jt: Float, r: Float, square_sum: Float, top: Float, move: Float
) -> None:
    """Compute the misfit of the residuals ``r`` (U, K), and replace ``r`` with r − H g.

    Three results are written: the χ² of each wire into ``square_sum`` (U,); the error |Jᵢᵀ r| / ‖Jᵢ‖² of each
    coordinate i, with all other coordinates fixed, into ``move`` (U, f); and the largest error of each wire
    in standard deviations, |Jᵢᵀ r| / ‖Jᵢ‖, into ``top`` (U,).
    """
    for u in range(jt.shape[0]):
        r_u = r[u]
        for q in range(h.shape[2]):
            for k in range(r_u.size):
                r_u[k] -= h[u, k, q] * g[q]
        square_sum[u] = dot(r_u, r_u)
        top[u] = 0.0
        for i in range(free.size):
            row = jt[u, free[i]]
            square = dot(row, row)
            move[u, i] = 0.0
            if square > 0.0:
                along = abs(dot(row, r_u))
                move[u, i] = along / square
                top[u] = max(top[u], along / math.sqrt(square))


@njit_part
def _reduce(  # noqa: PLR0913, C901 - a kernel: arrays by name, sums as loops
    u: int, top: int, free: Index, h: Float, x: Float, b: Buffers
) -> None:
    """Write J, H and y of wire ``u`` into ``b`` from row ``top``, reduced to at most f + p rows."""
    f, p = free.size, h.shape[2]
    equations = h.shape[1]
    y = b.e
    for k in range(equations):
        y[k] = -b.r[u, k]
    for i in range(f):
        row, source, value = b.free_jt[i], b.jt[u, free[i]], x[u, free[i]]
        for k in range(equations):
            row[k] = source[k]
            y[k] += source[k] * value
    for q in range(p):
        row = b.free_jt[f + q]
        for k in range(equations):
            row[k] = h[u, k, q]
    if b.jacobian.shape[0] == x.shape[0] * equations:
        for k in range(equations):
            b.y[top + k] = y[k]
            row = b.jacobian[top + k]
            for i in range(f):
                row[i] = b.free_jt[i, k]
            for q in range(p):
                b.nuisance[top + k, q] = h[u, k, q]
        return
    qr_factor(b.free_jt, b.qr, b.diagonal, b.beta, b.scratch)
    qr_project(b.qr, b.beta, y)
    for k in range(f + p):
        b.y[top + k] = y[k]
        row, source = b.jacobian[top + k], b.qr[k]
        for i in range(f):
            row[i] = source[i] if i > k else (b.diagonal[k] if i == k else 0.0)
        for q in range(p):
            j = f + q
            b.nuisance[top + k, q] = source[j] if j > k else (b.diagonal[k] if j == k else 0.0)


@njit
def assemble(  # noqa: PLR0913, C901 - a kernel: arrays by name, sums as loops
    members: Index, free: Index, c: Float, s2: float, h: Float, d: Float, x: Float, b: Buffers
) -> float:
    """Write J, H, y, s² J C and S of the wires ``members`` (P,), using the r and Jᵀ in ``b``.

    ``free`` (f,) contains the indices of a wire's free coordinates, and ``c`` (U f, U f) is C. ``h`` (U, K,
    p) contains the effects of the nuisances, and ``d`` (p,) their variances. Only the upper triangle of S is
    written. Returns the trace of s² J C Jᵀ.
    """
    f, p = free.size, h.shape[2]
    rows = b.jacobian.shape[0] // x.shape[0]
    trace = 0.0
    for i in range(members.size):
        u, top = members[i], i * rows
        _reduce(u, top, free, h, x, b)
        multiply(b.jacobian[top : top + rows], c[u * f : (u + 1) * f], b.cross_covariance[top : top + rows])
        for k in range(top, top + rows):
            row = b.cross_covariance[k]
            for j in range(row.size):
                row[j] *= s2
    for i in range(members.size):
        u, left = members[i], i * rows
        for k in range(rows):
            source = b.jacobian[left + k]
            for j in range(f):
                b.block[j, k] = source[j]
        for q in range(i + 1):
            top = q * rows
            multiply(
                b.cross_covariance[top : top + rows, u * f : (u + 1) * f],
                b.block,
                b.innovation_covariance[top : top + rows, left : left + rows],
            )
        for k in range(left, left + rows):
            trace += b.innovation_covariance[k, k]
            for q in range(p):
                value = d[q] * b.nuisance[k, q]
                if value != 0.0:
                    for t in range(k + 1):
                        b.innovation_covariance[t, k] += value * b.nuisance[t, q]
            b.innovation_covariance[k, k] += 1.0
    return trace


@njit
def gauss_newton_step(  # noqa: PLR0913 - a kernel: arrays by name
    members: Index, free: Index, d: Float, x: Float, g: Float, b: Buffers
) -> None:
    """Write the result of a Gauss-Newton step into ``x`` (U, 3N) and ``g`` (p,), given the factors of S."""
    f = free.size
    rows = b.jacobian.shape[0] // x.shape[0]
    m = members.size * rows
    for k in range(m):
        b.v[k] = b.y[k]
    solve_lower_vector(b.innovation_covariance, b.v, m)
    solve_lower_transposed_vector(b.innovation_covariance, b.v, m)
    for j in range(b.gradient.size):
        b.gradient[j] = 0.0
    for k in range(m):
        value, row = b.v[k], b.cross_covariance[k]
        for j in range(row.size):
            b.gradient[j] += value * row[j]
    for u in range(x.shape[0]):
        for i in range(f):
            x[u, free[i]] = b.gradient[u * f + i]
    for q in range(b.nuisance.shape[1]):
        total = 0.0
        for k in range(m):
            total += b.nuisance[k, q] * b.v[k]
        g[q] = -d[q] * total


@njit
def noise_variance(  # noqa: C901 - a kernel: sums as loops
    m: int, d: Float, b: Buffers, kalman_gain_t: Float, out: Float
) -> None:
    """Write the variance of the estimate due to noise and nuisances into ``out`` (U f,), in pitch².

    The variance is diag(K (I + H d Hᵀ) Kᵀ). The transposed Kalman gain Kᵀ = L⁻ᵀ V, the change in the estimate
    per unit of noise in each equation, is written to ``kalman_gain_t`` (m, U f). V and L are read from ``b``.
    """
    n = out.size
    for k in range(m):
        for j in range(n):
            kalman_gain_t[k, j] = b.whitened[k, j]
    solve_lower_transposed(b.innovation_covariance, kalman_gain_t, m, n)
    for j in range(n):
        out[j] = 0.0
    for k in range(m):
        row = kalman_gain_t[k]
        for j in range(n):
            out[j] += row[j] * row[j]
    for q in range(b.nuisance.shape[1]):
        for j in range(n):
            b.gradient[j] = 0.0
        for k in range(m):
            value, row = b.nuisance[k, q], kalman_gain_t[k]
            if value != 0.0:
                for j in range(n):
                    b.gradient[j] += value * row[j]
        for j in range(n):
            out[j] += d[q] * b.gradient[j] * b.gradient[j]


@njit
def standard_deviations(  # noqa: PLR0913 - a kernel: arrays by name
    m: int, c: Float, s2: float, noise: Float, doubt: float, share: float, std: Float, core: Float, b: Buffers
) -> None:
    """Compute standard deviations (U, f) from the posterior covariance s² C − Vᵀ V, with V from ``b``.

    ``noise`` (U f,) is the part of the variance due to noise; the rest depends on the prior. The part that
    depends on the prior is multiplied by ``doubt`` for ``std``, and by ``share`` for ``core``.
    """
    n, f = noise.size, std.shape[1]
    explained = b.gradient
    for j in range(n):
        explained[j] = 0.0
    for k in range(m):
        row = b.whitened[k]
        for j in range(n):
            explained[j] += row[j] * row[j]
    for j in range(n):
        unseen = max(max(s2 * c[j, j] - explained[j], 0.0) - noise[j], 0.0)
        std[j // f, j % f] = math.sqrt(noise[j] + doubt * unseen)
        core[j // f, j % f] = math.sqrt(noise[j] + share * unseen)


@njit
def chord_step(  # noqa: PLR0913, C901 - a kernel: arrays by name, sums as loops
    members: Index,
    free: Index,
    c: Float,
    s2: float,
    h: Float,
    d: Float,
    x: Float,
    g: Float,
    step: Float,
    b: Buffers,
) -> tuple[float, float]:
    """Write a chord step with the current factors into ``step``: U f coordinates, followed by the nuisances.

    The residuals r, Jᵀ and the effects of the geometry errors at ``x`` (U, 3N) are read from ``b``. Returns
    the RMS and the largest absolute value of the changes in the coordinates, in pitches.
    """
    f, p = free.size, h.shape[2]
    wires, equations = b.r.shape
    rows = b.jacobian.shape[0] // wires
    m, n = members.size * rows, b.gradient.size
    made = b.effect.shape[2] > 0  # whether geometry errors are modelled
    for j in range(n):
        b.gradient[j] = 0.0
    for q in range(g.size):
        step[n + q] = -g[q]
    for i in range(members.size):
        u = members[i]
        for k in range(equations):
            value = b.r[u, k]
            for q in range(p):
                value -= h[u, k, q] * g[q]
            b.e[k] = value
            for q in range(p):
                step[n + q] += d[q] * h[u, k, q] * value
            if made:
                add_effect(b.effect, u, k, value, step, n + p, wires)
        for j in range(f):
            b.gradient[u * f + j] = dot(b.jt[u, free[j]], b.e)
    for u in range(x.shape[0]):
        for i in range(f):
            step[u * f + i] = -x[u, free[i]]
    for i in range(members.size):
        u = members[i]
        for j in range(u * f, (u + 1) * f):
            value, row = s2 * b.gradient[j], c[j]
            for t in range(n):
                step[t] -= value * row[t]
    for i in range(members.size):
        u, top = members[i], i * rows
        for k in range(top, top + rows):
            value = dot(b.jacobian[k], step[u * f : (u + 1) * f])
            for q in range(p):
                value -= b.nuisance[k, q] * step[n + q]
            if made:
                value -= effect_on(b.factored_effect, u, k - top, step, n + p, wires)
            b.v[k] = value
    solve_lower_vector(b.innovation_covariance, b.v, m)
    solve_lower_transposed_vector(b.innovation_covariance, b.v, m)
    for k in range(m):
        value, row = b.v[k], b.cross_covariance[k]
        for j in range(n):
            step[j] -= value * row[j]
    for q in range(p):
        total = 0.0
        for k in range(m):
            total += b.nuisance[k, q] * b.v[k]
        step[n + q] += d[q] * total
    if made:
        for k in range(m):
            add_effect(b.factored_effect, members[k // rows], k % rows, b.v[k], step, n + p, wires)
    square, top = 0.0, 0.0
    for j in range(n):
        square += step[j] * step[j]
        top = max(top, abs(step[j]))
    return math.sqrt(square / n), top
