"""LU factorisation of a small square matrix, for the Jacobian of one wire.

These kernels replace LAPACK for two reasons. With 30 unknowns, the overhead of a LAPACK call exceeds the time
for the arithmetic, and ``numpy.linalg`` in compiled code adds seconds of compile time. The kernels factor Jᵀ,
so that inner loops run along contiguous rows, and vectorisation does not reorder sums (Golub & Van Loan,
Matrix Computations, 4th ed., section 3.4).
"""

from __future__ import annotations

import math

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES, drop, fma, load, store
from skinnode.model.layout import Float
from skinnode.solve.linalg.vectors import Index


@njit_part
def lu_factor(a: Float, pivot: Index) -> int:  # noqa: C901 - four rows at a time
    """Factor A (n, n) in place; return the sign of det A, or 0 if A is singular.

    Writes the row exchanges to ``pivot`` (n,). ``a`` is A padded with zeros to (n + 3, n), with the number of
    columns rounded up to whole SIMD vectors. The padding allows the loops to process four rows and whole
    vectors at a time.
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
    """Solve Aᵀ s = b, with A factored by :func:`lu_factor`; s replaces ``b`` (n,)."""
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
    """Write (Aᵀ)⁻¹, with A factored by :func:`lu_factor`, into ``inverse`` (n, n)."""
    n = pivot.size
    for i in range(n):
        row = inverse[i]
        for c in range(n):
            row[c] = 0.0
        row[i] = 1.0
    for c0 in range(0, n, 4 * LANES):  # four vectors at a time, so that their sums stay in registers
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
