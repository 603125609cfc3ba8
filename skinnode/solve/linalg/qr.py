"""QR factorisation of small matrices: Householder reflectors, and Gram-Schmidt orthonormalisation.

Householder factors solve wires with more equations than unknowns. The normal equations would square the
condition number (Golub & Van Loan, Matrix Computations, 4th ed., sections 5.2 and 5.3).
"""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import multiply_vector
from skinnode.solve.linalg.vectors import dot


@njit_part
def qr_factor(jt: Float, a: Float, diagonal: Float, beta: Float, w: Float) -> int:  # noqa: C901 - loops
    """Factor J = ``jt``ᵀ (m, n), m ≥ n, as Q R; return 1, or 0 if R has a zero on its diagonal.

    Args:
        jt: (n, m) transpose of J.
        a: (m, n) output: R above the diagonal; on and below it, the vectors v of the reflectors I − β v vᵀ
            of Q.
        diagonal: (n,) output: diagonal of R.
        beta: (n,) output: factors β of the reflectors.
        w: (n,) work array.
    """
    n, m = jt.shape
    for j in range(n):
        for i in range(m):
            a[i, j] = jt[j, i]
    full = 1
    for k in range(n):
        square = 0.0
        for i in range(k, m):
            square += a[i, k] * a[i, k]
        norm = math.sqrt(square)
        diagonal[k] = -norm if a[k, k] > 0.0 else norm
        if not (norm > 0.0 and norm < math.inf):
            beta[k] = 0.0
            full = 0
            continue
        beta[k] = 1.0 / (norm * (norm + abs(a[k, k])))
        a[k, k] -= diagonal[k]
        for j in range(k + 1, n):
            w[j] = 0.0
        for i in range(k, m):
            row = a[i]
            factor = row[k]
            for j in range(k + 1, n):
                w[j] += factor * row[j]
        for i in range(k, m):
            row = a[i]
            factor = row[k] * beta[k]
            for j in range(k + 1, n):
                row[j] -= factor * w[j]
    return full


@njit_part
def qr_project(a: Float, beta: Float, b: Float) -> None:
    """Replace ``b`` (m,) with Qᵀ b."""
    m, n = a.shape
    for k in range(n):
        total = 0.0
        for i in range(k, m):
            total += a[i, k] * b[i]
        total *= beta[k]
        for i in range(k, m):
            b[i] -= total * a[i, k]


@njit_part
def r_solve(a: Float, diagonal: Float, b: Float) -> None:
    """Solve R s = b; s replaces the first n elements of ``b``."""
    for i in range(diagonal.size - 1, -1, -1):
        row = a[i]
        total = b[i]
        for j in range(i + 1, diagonal.size):
            total -= row[j] * b[j]
        b[i] = total / diagonal[i]


@njit_part
def qr_inverse(a: Float, diagonal: Float, beta: Float, v: Float, inverse: Float) -> None:  # noqa: C901 - loops
    """Write J⁺ = R⁻¹ Qᵀ into the first n rows of ``inverse`` (≥ n, m); ``v`` (m,) is a work array."""
    m, n = a.shape
    for j in range(n):
        row = inverse[j]
        for i in range(m):
            row[i] = 0.0
        row[j] = 1.0
    for k in range(n - 1, -1, -1):
        for i in range(m):
            v[i] = a[i, k] if i >= k else 0.0
        for j in range(k, n):  # reflector k does not change the rows above row k
            row = inverse[j]
            share = beta[k] * dot(row, v)
            for i in range(k, m):
                row[i] -= share * v[i]
    for j in range(n - 1, -1, -1):
        row = inverse[j]
        for k in range(j + 1, n):
            other, factor = inverse[k], a[j, k]
            for i in range(m):
                row[i] -= factor * other[i]
        scale = 1.0 / diagonal[j]
        for i in range(m):
            row[i] *= scale


@njit
def orthonormalise(rows: Float, work: Float) -> None:
    """Orthonormalise linearly independent ``rows`` (r, n) by classical Gram-Schmidt with two passes.

    The second pass makes the rows orthogonal to machine precision (Giraud et al., 2005). ``work`` (r,) is a
    work array.
    """
    for i in range(len(rows)):
        row, overlap = rows[i], work[:i]
        for _ in range(2):
            multiply_vector(rows[:i], row, overlap)
            for j in range(i):
                factor, other = overlap[j], rows[j]
                for k in range(row.size):
                    row[k] -= factor * other[k]
        length = math.sqrt(dot(row, row))
        for k in range(row.size):
            row[k] /= length
