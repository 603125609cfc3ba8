"""Dense kernels for a few hundred unknowns: Cholesky factorisation, triangular solves, products.

Identical frames must yield identical fields, but the last bits of an OpenBLAS result depend on the number of
threads. These kernels therefore replace LAPACK. They always add the terms of an element in the same order,
regardless of the number of threads and of how the columns are split.

The inner loop of all kernels keeps a tile of the result (6 rows of 2 vectors) in registers, so 12
multiply-adds require only 8 loads (Goto & van de Geijn, Anatomy of high-performance matrix multiplication,
2008). Arrays are C-ordered float64. A buffer may be larger than the problem; the kernels then use its leading
n rows and columns. No kernel allocates memory.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from skinnode.compiled.jit import njit, njit_part
from skinnode.compiled.simd import LANES, fma, load, splat, store, total
from skinnode.model.layout import Float

ROWS: Final = 6
"""Number of rows in a tile.

With 6 rows, 15 of the 16 AVX2 registers are in use: 12 for sums (2 vectors per row), 2 for loaded vectors,
and 1 for a factor.
"""
TILE: Final = 2 * LANES
"""Number of columns in a tile."""


@njit_part
def _tile(  # noqa: PLR0913 - the bounds of a tile
    c: Float, r: int, rows: int, a: Float, b: Float, low: int, high: int, col: int, count: int, subtract: bool
) -> None:
    """Compute Σ_k ``a``[r:r+rows, k] ``b``[k, col:col+count] for low ≤ k < high.

    The result replaces ``c``[r:r+rows, col:col+count], or is subtracted from it if ``subtract`` is true.
    rows ≤ ROWS and count ≤ TILE.
    """
    zero = splat(0.0)
    right = col + LANES
    more = count - LANES
    if rows < ROWS:
        for i in range(r, r + rows):
            c0, c1 = zero, zero
            factors = a[i]
            for k in range(low, high):
                row = b[k]
                c0 = fma(factors[k], load(row, col, count), c0)
                c1 = fma(factors[k], load(row, right, more), c1)
            row = c[i]
            if subtract:
                c0 = load(row, col, count) - c0
                c1 = load(row, right, more) - c1
            store(row, col, count, c0)
            store(row, right, more, c1)
        return
    a0, a1, a2, a3, a4, a5 = a[r], a[r + 1], a[r + 2], a[r + 3], a[r + 4], a[r + 5]
    c00, c10, c20, c30, c40, c50 = zero, zero, zero, zero, zero, zero
    c01, c11, c21, c31, c41, c51 = zero, zero, zero, zero, zero, zero
    for k in range(low, high):
        row = b[k]
        b0 = load(row, col, count)
        b1 = load(row, right, more)
        c00, c01 = fma(a0[k], b0, c00), fma(a0[k], b1, c01)
        c10, c11 = fma(a1[k], b0, c10), fma(a1[k], b1, c11)
        c20, c21 = fma(a2[k], b0, c20), fma(a2[k], b1, c21)
        c30, c31 = fma(a3[k], b0, c30), fma(a3[k], b1, c31)
        c40, c41 = fma(a4[k], b0, c40), fma(a4[k], b1, c41)
        c50, c51 = fma(a5[k], b0, c50), fma(a5[k], b1, c51)
    t0, t1, t2, t3, t4, t5 = c[r], c[r + 1], c[r + 2], c[r + 3], c[r + 4], c[r + 5]
    if subtract:
        c00, c01 = load(t0, col, count) - c00, load(t0, right, more) - c01
        c10, c11 = load(t1, col, count) - c10, load(t1, right, more) - c11
        c20, c21 = load(t2, col, count) - c20, load(t2, right, more) - c21
        c30, c31 = load(t3, col, count) - c30, load(t3, right, more) - c31
        c40, c41 = load(t4, col, count) - c40, load(t4, right, more) - c41
        c50, c51 = load(t5, col, count) - c50, load(t5, right, more) - c51
    store(t0, col, count, c00)
    store(t1, col, count, c10)
    store(t2, col, count, c20)
    store(t3, col, count, c30)
    store(t4, col, count, c40)
    store(t5, col, count, c50)
    store(t0, right, more, c01)
    store(t1, right, more, c11)
    store(t2, right, more, c21)
    store(t3, right, more, c31)
    store(t4, right, more, c41)
    store(t5, right, more, c51)


@njit_part
def _forward(  # noqa: PLR0913 - the bounds of a tile
    l: Float, b: Float, r: int, rows: int, low: int, col: int, count: int
) -> None:
    """Replace rows r to r + rows − 1 of a tile of ``b`` with the same rows of L⁻¹ B.

    Rows ``low`` to r − 1 of the tile must already have been replaced.
    """
    _tile(b, r, rows, l, b, low, r, col, count, True)
    right = col + LANES
    more = count - LANES
    for i in range(r, r + rows):
        factors, row = l[i], b[i]
        b0 = load(row, col, count)
        b1 = load(row, right, more)
        for k in range(r, i):
            above = b[k]
            b0 = fma(-factors[k], load(above, col, count), b0)
            b1 = fma(-factors[k], load(above, right, more), b1)
        inverse = 1.0 / factors[i]
        store(row, col, count, b0 * inverse)
        store(row, right, more, b1 * inverse)


@njit
def cholesky(a: Float, n: int) -> int:
    """Replace the symmetric matrix ``a`` (n, n) with its Cholesky factor.

    Reads only the diagonal and the upper triangle. Writes L on and below the diagonal, and Lᵀ above it.
    Returns 1, or 0 if ``a`` is not positive definite.
    """
    first: Any = np.int64(0)  # with a literal 0, numba would compile the callee a second time
    for r in range(0, n, ROWS):
        rows = min(ROWS, n - r)
        end = r + rows
        _tile(a, r, rows, a, a, first, r, r, rows, True)
        for i in range(r, end):
            upper = a[i]
            for k in range(r, i):
                factor = a[k, i]
                for j in range(i, end):
                    upper[j] -= factor * a[k, j]
            pivot = upper[i]
            if not (pivot > 0.0 and pivot < math.inf):
                return 0
            root = math.sqrt(pivot)
            upper[i] = root
            for j in range(i + 1, end):
                upper[j] /= root
                a[j, i] = upper[j]
        for col in range(end, n, TILE):
            _forward(a, a, r, rows, first, col, min(TILE, n - col))
        for j in range(end, n):
            lower = a[j]
            for i in range(r, end):
                lower[i] = a[i, j]
    return 1


@njit
def solve_lower(l: Float, b: Float, n: int, cols: int) -> None:
    """Replace the leading (n, cols) of ``b`` with L⁻¹ B; reads only the lower triangle of ``l``."""
    first: Any = np.int64(0)
    for col in range(0, cols, TILE):
        for r in range(0, n, ROWS):
            _forward(l, b, r, min(ROWS, n - r), first, col, min(TILE, cols - col))


@njit_part
def _backward(  # noqa: PLR0913 - the bounds of a tile
    l: Float, b: Float, r: int, rows: int, n: int, col: int, count: int
) -> None:
    """Replace rows r to r + rows − 1 of a tile of ``b`` with the same rows of L⁻ᵀ B.

    All later rows of the tile must already have been replaced.
    """
    _tile(b, r, rows, l, b, r + rows, n, col, count, True)
    right = col + LANES
    more = count - LANES
    for i in range(r + rows - 1, r - 1, -1):
        factors, row = l[i], b[i]
        b0 = load(row, col, count)
        b1 = load(row, right, more)
        for k in range(i + 1, r + rows):
            below = b[k]
            b0 = fma(-factors[k], load(below, col, count), b0)
            b1 = fma(-factors[k], load(below, right, more), b1)
        inverse = 1.0 / factors[i]
        store(row, col, count, b0 * inverse)
        store(row, right, more, b1 * inverse)


@njit
def solve_lower_transposed(l: Float, b: Float, n: int, cols: int) -> None:
    """Replace the leading (n, cols) of ``b`` with L⁻ᵀ B; reads Lᵀ in the upper triangle of ``l``."""
    for col in range(0, cols, TILE):
        for r in range((n - 1) // ROWS * ROWS, -1, -ROWS):
            _backward(l, b, r, min(ROWS, n - r), n, col, min(TILE, cols - col))


@njit
def solve_lower_vector(l: Float, v: Float, n: int) -> None:
    """Replace the leading n elements of ``v`` with L⁻¹ v."""
    for i in range(n):
        row = l[i]
        even, odd = splat(0.0), splat(0.0)
        for k in range(0, i, TILE):
            right, left, more = k + LANES, i - k, i - k - LANES
            even = fma(load(row, k, left), load(v, k, left), even)
            odd = fma(load(row, right, more), load(v, right, more), odd)
        v[i] = (v[i] - total(even + odd)) / row[i]


@njit
def solve_lower_transposed_vector(l: Float, v: Float, n: int) -> None:
    """Replace the leading n elements of ``v`` with L⁻ᵀ v."""
    for i in range(n - 1, -1, -1):
        row = l[i]
        value = v[i] / row[i]
        v[i] = value
        for k in range(0, i, LANES):
            store(v, k, i - k, fma(-value, load(row, k, i - k), load(v, k, i - k)))


@njit
def solve_positive(a: Float, b: Float, n: int) -> bool:
    """Replace the leading n elements of ``b`` with A⁻¹ b and the symmetric ``a`` (n, n) with its factor.

    Returns whether ``a`` is positive definite; if it is not, ``b`` does not change.
    """
    if not cholesky(a, n):
        return False
    solve_lower_vector(a, b, n)
    solve_lower_transposed_vector(a, b, n)
    return True


@njit
def multiply(a: Float, b: Float, c: Float) -> None:
    """Write ``a`` (m, k) · ``b`` (k, n) into ``c`` (m, n)."""
    (rows, inner), cols = a.shape, b.shape[1]
    first: Any = np.int64(0)
    for col in range(0, cols, TILE):
        for r in range(0, rows, ROWS):
            _tile(c, r, min(ROWS, rows - r), a, b, first, inner, col, min(TILE, cols - col), False)


@njit
def subtract_product(a: Float, b: Float, c: Float) -> None:
    """Subtract ``a`` (m, k) · ``b`` (k, n) from ``c`` (m, n)."""
    (rows, inner), cols = a.shape, b.shape[1]
    first: Any = np.int64(0)
    for col in range(0, cols, TILE):
        for r in range(0, rows, ROWS):
            _tile(c, r, min(ROWS, rows - r), a, b, first, inner, col, min(TILE, cols - col), True)


@njit
def multiply_vector(a: Float, v: Float, out: Float) -> None:
    """Write ``a`` (m, n) · ``v`` (n,) into ``out`` (m,)."""
    n = v.size
    for i in range(out.size):
        row = a[i]
        even, odd = splat(0.0), splat(0.0)
        for k in range(0, n, TILE):
            right, left, more = k + LANES, n - k, n - k - LANES
            even = fma(load(row, k, left), load(v, k, left), even)
            odd = fma(load(row, right, more), load(v, right, more), odd)
        out[i] = total(even + odd)


@njit
def inverse_diagonal(l: Float, work: Float, out: Float, n: int) -> None:
    """Write the diagonal of (L Lᵀ)⁻¹ into the leading n elements of ``out``: out_j = Σ_i (L⁻¹)_ij².

    Writes L⁻¹ into the lower triangle of ``work`` (n, n).
    """
    for col in range(0, n, TILE):
        count = min(TILE, n - col)
        right, more = col + LANES, count - LANES
        s0, s1 = splat(0.0), splat(0.0)
        for r in range(col, n, ROWS):
            rows = min(ROWS, n - r)
            for i in range(r, r + rows):
                row = work[i]
                store(row, col, count, splat(0.0))
                store(row, right, more, splat(0.0))
                if i < col + count:
                    row[i] = 1.0
            _forward(l, work, r, rows, col, col, count)
            for i in range(r, r + rows):
                row = work[i]
                b0, b1 = load(row, col, count), load(row, right, more)
                s0, s1 = fma(b0, b0, s0), fma(b1, b1, s1)
        store(out, col, count, s0)
        store(out, right, more, s1)
