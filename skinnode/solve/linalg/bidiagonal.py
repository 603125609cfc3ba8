"""Bidiagonal form of a small matrix, for the damped steps of Levenberg-Marquardt.

Levenberg-Marquardt tries several damping parameters per Jacobian. With the bidiagonal form, each parameter
takes O(n) operations instead of O(n³).
"""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, store, total
from skinnode.model.layout import Float


@njit_part
def bidiagonalise(  # noqa: C901, PLR0913 - four rows at a time; every result of the decomposition
    a: Float, left: Float, diagonal: Float, upper: Float, across: Float, down: Float, w: Float
) -> None:
    """Decompose A (n, m), n ≤ m, as P Bᵀ Qᵀ with P and Q orthogonal and B (n, n) upper bidiagonal.

    The algorithm follows Golub & Van Loan, section 5.4.8, with rows and columns exchanged. The squares of the
    elements of A must not overflow.

    Args:
        a: A, padded with zeros to (n + 3, m), with m rounded up to whole SIMD vectors. The padding allows
            loops to process four rows and whole vectors at a time. Overwritten: row k becomes the vector v
            of the k-th reflector I − β v vᵀ of Q.
        left: (n, n + 3) output, padded like ``a``: row k is the vector v of the k-th reflector of P.
        diagonal: (n,) output: diagonal of B.
        upper: (n,) output: superdiagonal of B, followed by 0.
        across: (n,) output: factors β of the reflectors of Q.
        down: (n,) output: factors β of the reflectors of P.
        w: Work array, as long as a row of ``a``.
    """
    n, end = diagonal.size, a.shape[1]
    for k in range(n):
        row, first = a[k], k - k % LANES
        for j in range(first, k):
            row[j] = 0.0
        squares = splat(0.0)
        for j in range(first, end, LANES):
            part = load(row, j, LANES)
            squares = fma(part, part, squares)
            store(w, j, LANES, splat(0.0))
        norm = math.sqrt(total(squares))
        diagonal[k] = -norm if row[k] > 0.0 else norm
        across[k] = 1.0 / (norm * (norm + abs(row[k]))) if norm > 0.0 else 0.0
        row[k] -= diagonal[k]
        upper[k] = 0.0
        down[k] = 0.0
        if k + 1 == n:
            return
        column, head = left[k], row[k]
        for j in range(0, column.size, LANES):
            store(column, j, LANES, splat(0.0))
        square = 0.0
        for i in range(k + 1, n, 4):  # apply the row's reflector, and accumulate the column's reflector
            t0, t1, t2, t3 = a[i], a[i + 1], a[i + 2], a[i + 3]
            s0, s1, s2, s3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
            for j in range(first, end, LANES):
                part = load(row, j, LANES)
                s0, s1 = fma(load(t0, j, LANES), part, s0), fma(load(t1, j, LANES), part, s1)
                s2, s3 = fma(load(t2, j, LANES), part, s2), fma(load(t3, j, LANES), part, s3)
            f0, f1 = -across[k] * total(s0), -across[k] * total(s1)
            f2, f3 = -across[k] * total(s2), -across[k] * total(s3)
            h0, h1, h2, h3 = t0[k] + f0 * head, t1[k] + f1 * head, t2[k] + f2 * head, t3[k] + f3 * head
            square += (h0 * h0 + h1 * h1) + (h2 * h2 + h3 * h3)
            column[i], column[i + 1], column[i + 2], column[i + 3] = h0, h1, h2, h3
            for j in range(first, end, LANES):
                part, summed = load(row, j, LANES), load(w, j, LANES)
                p0, p1 = fma(f0, part, load(t0, j, LANES)), fma(f1, part, load(t1, j, LANES))
                p2, p3 = fma(f2, part, load(t2, j, LANES)), fma(f3, part, load(t3, j, LANES))
                store(t0, j, LANES, p0)
                store(t1, j, LANES, p1)
                store(t2, j, LANES, p2)
                store(t3, j, LANES, p3)
                store(w, j, LANES, summed + (fma(h1, p1, h0 * p0) + fma(h3, p3, h2 * p2)))
        row, head, norm = a[k + 1], column[k + 1], math.sqrt(square)
        upper[k] = -norm if head > 0.0 else norm
        down[k] = 1.0 / (norm * (norm + abs(head))) if norm > 0.0 else 0.0
        column[k + 1] = head - upper[k]
        for j in range(first, end, LANES):
            store(w, j, LANES, -down[k] * fma(-upper[k], load(row, j, LANES), load(w, j, LANES)))
        for i in range(k + 1, n, 4):
            t0, t1, t2, t3 = a[i], a[i + 1], a[i + 2], a[i + 3]
            h0, h1, h2, h3 = column[i], column[i + 1], column[i + 2], column[i + 3]
            for j in range(first, end, LANES):
                part = load(w, j, LANES)
                store(t0, j, LANES, fma(h0, part, load(t0, j, LANES)))
                store(t1, j, LANES, fma(h1, part, load(t1, j, LANES)))
                store(t2, j, LANES, fma(h2, part, load(t2, j, LANES)))
                store(t3, j, LANES, fma(h3, part, load(t3, j, LANES)))


@njit_part
def reflect(rows: Float, beta: Float, k: int, b: Float) -> None:
    """Replace ``b`` with (I − β v vᵀ) b for reflector ``k`` of :func:`bidiagonalise`."""
    row, end, along = rows[k], b.size, splat(0.0)
    first = k - k % LANES
    for j in range(first, end, LANES):
        along = fma(load(row, j, end - j), load(b, j, end - j), along)
    share = -beta[k] * total(along)
    for j in range(first, end, LANES):
        store(b, j, end - j, fma(share, load(row, j, end - j), load(b, j, end - j)))


@njit_part
def damped_solve(  # noqa: PLR0913 - every result of the decomposition
    diagonal: Float, upper: Float, b: Float, lam: float, inverse: Float, ru: Float, x: Float
) -> None:
    """Solve the least-squares problem [B; √lam I] x = [``b``; 0], with B from :func:`bidiagonalise`.

    Uses Givens rotations (Eldén, Algorithms for the regularization of ill-conditioned least squares
    problems, 1977). The factor R of BᵀB + lam I = RᵀR is also bidiagonal: the reciprocals of its diagonal are
    written to ``inverse`` (n,), and its superdiagonal to ``ru`` (n,). The squares of lam and of B must not
    both underflow.
    """
    below, rest = lam, 0.0  # squared element of the damping row under row i of B, and its right-hand side
    for i in range(x.size):
        radius = 1.0 / (diagonal[i] * diagonal[i] + below)
        inverse[i] = math.sqrt(radius)
        root = math.sqrt(below)
        c, t = diagonal[i] * inverse[i], root * inverse[i]
        ru[i] = c * upper[i]
        x[i] = c * b[i] + t * rest
        filled = -t * upper[i]  # fill-in, to be rotated into the next damping row
        below = lam + below * radius * (upper[i] * upper[i])
        rest = (c * rest - t * b[i]) * (filled / math.sqrt(below))
    bidiagonal_solve(inverse, ru, x)


@njit_part
def bidiagonal_solve(inverse: Float, upper: Float, x: Float) -> None:
    """Replace ``x`` (n,) with R⁻¹ x, where R has the diagonal 1 / ``inverse`` and superdiagonal ``upper``."""
    last = 0.0
    for i in range(x.size - 1, -1, -1):
        last = (x[i] - upper[i] * last) * inverse[i]
        x[i] = last


@njit_part
def bidiagonal_solve_transposed(inverse: Float, upper: Float, x: Float) -> None:
    """Replace ``x`` (n,) with R⁻ᵀ x, with R as in :func:`bidiagonal_solve`."""
    carried = 0.0
    for i in range(x.size):
        value = (x[i] - carried) * inverse[i]
        carried = upper[i] * value
        x[i] = value
