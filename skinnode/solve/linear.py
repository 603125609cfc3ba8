"""Small dense factorisations for the step loops: LU of a square Jacobian, QR of a tall one.

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

from skinnode.jit import njit_part
from skinnode.model.layout import Float

Index = NDArray[np.int64]


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
    """LU of ``a`` (n, n) in place with row exchanges in ``pivot``; sign of det ``a``, 0 where it is
    singular."""
    n = a.shape[0]
    sign = 1
    for j in range(n):
        p = j
        top = abs(a[j, j])
        for i in range(j + 1, n):
            size = abs(a[i, j])
            if size > top:
                top = size
                p = i
        pivot[j] = p
        if not (top > 0.0 and top < math.inf):
            return 0
        row = a[j]
        if p != j:
            sign = -sign
            other = a[p]
            for k in range(n):
                row[k], other[k] = other[k], row[k]
        if row[j] < 0.0:
            sign = -sign
        inverse = 1.0 / row[j]
        i = j + 1
        while i + 4 <= n:  # four rows share the loads of the pivot row: a third faster than one by one
            t0, t1, t2, t3 = a[i], a[i + 1], a[i + 2], a[i + 3]
            f0, f1, f2, f3 = t0[j] * inverse, t1[j] * inverse, t2[j] * inverse, t3[j] * inverse
            t0[j], t1[j], t2[j], t3[j] = f0, f1, f2, f3
            for k in range(j + 1, n):
                value = row[k]
                t0[k] -= f0 * value
                t1[k] -= f1 * value
                t2[k] -= f2 * value
                t3[k] -= f3 * value
            i += 4
        while i < n:
            target = a[i]
            factor = target[j] * inverse
            target[j] = factor
            for k in range(j + 1, n):
                target[k] -= factor * row[k]
            i += 1
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
    """(aᵀ)⁻¹ of the ``a`` of :func:`lu_factor` into ``inverse`` (n, n)."""
    n = lu.shape[0]
    for i in range(n):
        row = inverse[i]
        for c in range(n):
            row[c] = 0.0
        row[i] = 1.0
        k = 0
        while k + 2 <= i:
            f0, f1, r0, r1 = lu[k, i], lu[k + 1, i], inverse[k], inverse[k + 1]
            for c in range(k + 2):
                row[c] -= f0 * r0[c] + f1 * r1[c]
            k += 2
        if k < i:
            f0, r0 = lu[k, i], inverse[k]
            for c in range(k + 1):
                row[c] -= f0 * r0[c]
        scale = 1.0 / lu[i, i]
        for c in range(i + 1):
            row[c] *= scale
    for i in range(n - 2, -1, -1):
        row = inverse[i]
        k = i + 1
        while k + 2 <= n:
            f0, f1, r0, r1 = lu[k, i], lu[k + 1, i], inverse[k], inverse[k + 1]
            for c in range(n):
                row[c] -= f0 * r0[c] + f1 * r1[c]
            k += 2
        if k < n:
            f0, r0 = lu[k, i], inverse[k]
            for c in range(n):
                row[c] -= f0 * r0[c]
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
def r_solve_transposed(a: Float, diagonal: Float, b: Float) -> None:
    """Solve Rᵀ s = b; s replaces the first n elements of ``b``."""
    for i in range(diagonal.size):
        row = a[i]
        value = b[i] / diagonal[i]
        b[i] = value
        for j in range(i + 1, diagonal.size):
            b[j] -= value * row[j]


@njit_part
def damped_solve(
    a: Float, diagonal: Float, qtb: Float, damping: Float, s: Float, sd: Float, d: Float, x: Float
) -> None:
    """Least squares of [R; diag(``damping``)] x = [``qtb``; 0] by Givens rotations (Moré 1978).

    ``s`` (n, n) with diagonal ``sd`` receives the triangle of RᵀR + damping²; ``d`` (n,) is scratch.
    """
    n = diagonal.size
    for i in range(n):
        for j in range(i, n):
            s[i, j] = a[i, j]
        s[i, i] = diagonal[i]
        x[i] = qtb[i]
    for j in range(n):
        if damping[j] == 0.0:
            continue
        for k in range(j, n):
            d[k] = 0.0
        d[j] = damping[j]
        rest = 0.0
        for k in range(j, n):  # rotate row k of the triangle against the row of the damping
            if d[k] == 0.0:
                continue
            row = s[k]
            radius = math.hypot(row[k], d[k])
            c, t = row[k] / radius, d[k] / radius
            for i in range(k, n):
                kept = row[i]
                row[i] = c * kept + t * d[i]
                d[i] = c * d[i] - t * kept
            kept = x[k]
            x[k] = c * kept + t * rest
            rest = c * rest - t * kept
    for i in range(n):
        sd[i] = s[i, i]
    r_solve(s, sd, x)
