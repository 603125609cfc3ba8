"""Vector operations for the kernels: products, norms, and rows padded to whole SIMD vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit_part
from skinnode.compiled.simd import LANES
from skinnode.model.layout import Float

Index = NDArray[np.int64]


def padded(rows: int, size: int) -> Float:
    """Return a zero array (rows, ≥ size), aligned to a cache line, with rows padded to whole SIMD vectors."""
    size = -(-size // LANES) * LANES
    room = np.zeros(rows * size + 8)
    first = (-room.ctypes.data // room.itemsize) % 8
    return room[first : first + rows * size].reshape(rows, size)


@njit_part
def dot(a: Float, b: Float) -> float:
    """Return a·b. Four independent partial sums hide the latency of the multiply-adds."""
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
    """Return max |a_i|, or NaN if any element is NaN."""
    top = 0.0
    for value in a:
        size = abs(value)
        if not size <= top:
            top = size
    return top
