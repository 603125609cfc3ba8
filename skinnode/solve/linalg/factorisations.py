"""Small dense factorisations for the step loops: LU of a square Jacobian, QR of a tall one, and the
bidiagonal form of either, in which a damped step costs next to nothing whatever the damping.

Written by hand because at 30 unknowns a LAPACK call costs more than the arithmetic, and ``numpy.linalg``
inside compiled code costs seconds of compile time. The LU is taken of Jᵀ, which is how the kernels store J:
every inner loop then runs through a contiguous row and no sum has to be reordered to vectorise. Normal
equations are avoided; they square the condition number (Golub & Van Loan, Matrix Computations, 4th ed.,
3.4, 5.2, 5.3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, drop, fma, load, splat, store, total
from skinnode.model.layout import Float

Index = NDArray[np.int64]


def padded(rows: int, size: int) -> Float:
    """(rows, ≥ size) zeros, a row of whole vectors at whole cache lines."""
    size = -(-size // LANES) * LANES
    room = np.zeros(rows * size + 8)
    first = (-room.ctypes.data // room.itemsize) % 8
    return room[first : first + rows * size].reshape(rows, size)


@njit_part
def dot(a: Float, b: Float) -> float:
    """a·b in four partial sums: as exact as one, and four times less latency."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    whole = a.size - a.size % 4
    for i in range(0, whole, 4):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
    for i in range(whole, a.size):
        s0 += a[i] * b[i]
    return (s0 + s1) + (s2 + s3)


@njit_part
def largest(a: Float) -> float:
    """max |a_i|; NaN where there is one."""
    top = 0.0
    for value in a:
        size = abs(value)
        if not size <= top:
            top = size
    return top


@njit_part
def lu_factor(a: Float, pivot: Index) -> int:
    """LU of A (n, n) in place with row exchanges in ``pivot`` (n,); sign of det A, 0 where it is singular.

    ``a`` (n + 3, whole lanes of n) is A with zeros around it: four rows share the loads of the pivot row, and
    whole vectors need no special cases at the ends.
    """
    n, end = pivot.size, a.shape[1]
    sign, top, p = 1, 0.0, 0
    for i in range(n):
        size = abs(a[i, 0])
        if size > top:
            top, p = size, i
    for j in range(n):
        pivot[j] = p
        if not (top > 0.0 and top < math.inf):
            return 0
        row = a[j]
        if p != j:
            sign = -sign
            other = a[p]
            for k in range(0, end, LANES):
                part = load(row, k, LANES)
                store(row, k, LANES, load(other, k, LANES))
                store(other, k, LANES, part)
        if row[j] < 0.0:
            sign = -sign
        inverse = 1.0 / row[j]
        top, p = 0.0, j + 1
        first, ahead = (j + 1) - (j + 1) % LANES, row[min(j + 1, n - 1)]
        for i in range(j + 1, n, 4):
            i1, i2, i3 = i + 1, i + 2, i + 3
            t0, t1, t2, t3 = a[i], a[i1], a[i2], a[i3]
            f0, f1, f2, f3 = t0[j] * inverse, t1[j] * inverse, t2[j] * inverse, t3[j] * inverse
            s0, s1 = abs(t0[j + 1] - f0 * ahead), abs(t1[j + 1] - f1 * ahead)
            s2, s3 = abs(t2[j + 1] - f2 * ahead), abs(t3[j + 1] - f3 * ahead)
            for k in range(first, end, LANES):
                part = drop(load(row, k, LANES), j + 1 - k)
                p0, p1 = fma(-f0, part, load(t0, k, LANES)), fma(-f1, part, load(t1, k, LANES))
                p2, p3 = fma(-f2, part, load(t2, k, LANES)), fma(-f3, part, load(t3, k, LANES))
                store(t0, k, LANES, p0)
                store(t1, k, LANES, p1)
                store(t2, k, LANES, p2)
                store(t3, k, LANES, p3)
            t0[j], t1[j], t2[j], t3[j] = f0, f1, f2, f3
            if s0 > top:
                top, p = s0, i
            if s1 > top:
                top, p = s1, i1
            if s2 > top:
                top, p = s2, i2
            if s3 > top:
                top, p = s3, i3
    return sign


@njit_part
def lu_solve_transposed(lu: Float, pivot: Index, b: Float) -> None:
    """Solve aᵀ s = b for the ``a`` of :func:`lu_factor`; s replaces ``b`` (n,)."""
    n = b.size
    for i in range(n):
        row = lu[i]
        value = b[i] / row[i]
        b[i] = value
        for k in range(i + 1, n):
            b[k] -= value * row[k]
    for i in range(n - 1, -1, -1):
        row = lu[i]
        value = b[i]
        for k in range(i):
            b[k] -= value * row[k]
    for i in range(n - 1, -1, -1):
        p = pivot[i]
        if p != i:
            b[i], b[p] = b[p], b[i]


@njit_part
def lu_inverse_transposed(lu: Float, pivot: Index, inverse: Float) -> None:
    """(Aᵀ)⁻¹ of the A of :func:`lu_factor` into ``inverse`` (n, n)."""
    n = pivot.size
    for i in range(n):
        row = inverse[i]
        for c in range(n):
            row[c] = 0.0
        row[i] = 1.0
    for c0 in range(0, n, 4 * LANES):  # the sums of four vectors stay in registers
        c1, c2, c3 = c0 + LANES, c0 + 2 * LANES, c0 + 3 * LANES
        n0, n1, n2, n3 = n - c0, n - c1, n - c2, n - c3
        for sweep in range(2):
            for step in range(n):
                i = step if sweep == 0 else n - 1 - step
                low, high = (0, i) if sweep == 0 else (i + 1, n)
                row = inverse[i]
                s0, s1 = load(row, c0, n0), load(row, c1, n1)
                s2, s3 = load(row, c2, n2), load(row, c3, n3)
                for k in range(low, high):
                    other, factor = inverse[k], -lu[k, i]
                    s0, s1 = fma(factor, load(other, c0, n0), s0), fma(factor, load(other, c1, n1), s1)
                    s2, s3 = fma(factor, load(other, c2, n2), s2), fma(factor, load(other, c3, n3), s3)
                scale = 1.0 / lu[i, i] if sweep == 0 else 1.0
                store(row, c0, n0, s0 * scale)
                store(row, c1, n1, s1 * scale)
                store(row, c2, n2, s2 * scale)
                store(row, c3, n3, s3 * scale)
    for i in range(n - 1, -1, -1):
        p = pivot[i]
        if p != i:
            row, other = inverse[i], inverse[p]
            for c in range(n):
                row[c], other[c] = other[c], row[c]


@njit_part
def qr_factor(jt: Float, a: Float, diagonal: Float, beta: Float, w: Float) -> int:
    """Householder QR of J = ``jt``ᵀ, (m, n) with m ≥ n. 1, or 0 where a diagonal element of R vanishes.

    R is left above the diagonal of ``a`` (m, n) with its own diagonal in ``diagonal`` (n,); the reflectors
    I − β v vᵀ on and below it with β in ``beta`` (n,). ``w`` (n,) is scratch.
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
    """Qᵀ b in place of ``b`` (m,)."""
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
def bidiagonalise(
    a: Float, left: Float, diagonal: Float, upper: Float, across: Float, down: Float, w: Float
) -> None:
    """A = P Bᵀ Qᵀ for A (n, m), n ≤ m, with orthogonal P and Q and B upper bidiagonal (n, n).

    ``a`` (n + 3, whole lanes of m) is A with zeros around it: four rows at a time and whole vectors then need
    no special cases. B is left in ``diagonal`` (n,) and ``upper`` (n,), whose last element is 0; the
    reflectors I − β v vᵀ of Q in the rows of ``a`` with β in ``across`` (n,), those of P in the rows of
    ``left`` (n, whole lanes of n + 3) with β in ``down`` (n,). ``w`` is scratch as long as a row of ``a``.
    Squares of the elements must not overflow (Golub & Van Loan, 5.4.8, with rows for columns).
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
        for i in range(k + 1, n, 4):  # reflect the rows, and sum up what the column's reflector needs of them
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
    """(I − β v vᵀ) b in place of ``b`` with reflector ``k`` of :func:`bidiagonalise`."""
    row, end, along = rows[k], b.size, splat(0.0)
    first = k - k % LANES
    for j in range(first, end, LANES):
        along = fma(load(row, j, end - j), load(b, j, end - j), along)
    share = -beta[k] * total(along)
    for j in range(first, end, LANES):
        store(b, j, end - j, fma(share, load(row, j, end - j), load(b, j, end - j)))


@njit_part
def qr_inverse(a: Float, diagonal: Float, beta: Float, v: Float, inverse: Float) -> None:
    """J⁺ = R⁻¹ Qᵀ into the first n rows of ``inverse`` (≥ n, m); ``v`` (m,) is scratch."""
    m, n = a.shape
    for j in range(n):
        row = inverse[j]
        for i in range(m):
            row[i] = 0.0
        row[j] = 1.0
    for k in range(n - 1, -1, -1):
        for i in range(m):
            v[i] = a[i, k] if i >= k else 0.0
        for j in range(k, n):  # the rows above do not meet this reflector
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


@njit_part
def damped_solve(
    diagonal: Float, upper: Float, b: Float, lam: float, inverse: Float, ru: Float, x: Float
) -> None:
    """Least squares of [B; √lam I] x = [``b``; 0], B as of :func:`bidiagonalise`, by Givens rotations (Eldén,
    Algorithms for the regularization of ill-conditioned least squares problems, 1977).

    R of BᵀB + lam = RᵀR is bidiagonal too: 1 / its diagonal is left in ``inverse`` (n,), what is above it in
    ``ru`` (n,). Squares of lam and B must not underflow together.
    """
    below, rest = lam, 0.0  # under row i of B: the square of its one element, and its right side
    for i in range(x.size):
        radius = 1.0 / (diagonal[i] * diagonal[i] + below)
        inverse[i] = math.sqrt(radius)
        root = math.sqrt(below)
        c, t = diagonal[i] * inverse[i], root * inverse[i]
        ru[i] = c * upper[i]
        x[i] = c * b[i] + t * rest
        filled = -t * upper[i]  # the row under it now, to be rotated into the next of the damping
        below = lam + below * radius * (upper[i] * upper[i])
        rest = (c * rest - t * b[i]) * (filled / math.sqrt(below))
    bidiagonal_solve(inverse, ru, x)


@njit_part
def bidiagonal_solve(inverse: Float, upper: Float, x: Float) -> None:
    """R⁻¹ x in place of ``x`` (n,); R has 1 / ``inverse`` on and ``upper`` above the diagonal."""
    last = 0.0
    for i in range(x.size - 1, -1, -1):
        last = (x[i] - upper[i] * last) * inverse[i]
        x[i] = last


@njit_part
def bidiagonal_solve_transposed(inverse: Float, upper: Float, x: Float) -> None:
    """R⁻ᵀ x in place of ``x`` (n,) for the same R."""
    carried = 0.0
    for i in range(x.size):
        value = (x[i] - carried) * inverse[i]
        carried = upper[i] * value
        x[i] = value
