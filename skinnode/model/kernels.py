"""Compiled twins of ``forward`` for one wire, in structure-of-arrays order.

The layout decides the speed, not the compiler's freedom: lower electrodes are (3, M, K) and the Jacobian is
kept as its transpose (3N, K), so that the inner loop runs over the lower wires k through contiguous rows and
every statement in it vectorises without reordering a sum. Lengths are in any one unit; F is in its inverse.
"""

from __future__ import annotations

import math

import numpy as np

from skinnode.jit import njit
from skinnode.model.layout import Float


def lower_rows(lower: Float) -> Float:
    """(K, M, 3) lower electrodes as the (3, M, K) rows the kernels read."""
    return np.ascontiguousarray(lower.transpose(2, 1, 0))


@njit
def potential(x: Float, lower: Float, f: Float) -> None:
    """F of one wire into ``f`` (K,): electrodes ``x`` (3N,) as x₁ y₁ z₁ x₂ …, ``lower`` (3, M, K)."""
    charges, wires = lower.shape[1], lower.shape[2]
    for k in range(wires):
        f[k] = 0.0
    for i in range(x.size // 3):
        x_i, y_i, z_i = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        for j in range(charges):
            x_j, y_j, z_j = lower[0, j], lower[1, j], lower[2, j]
            for k in range(wires):
                dx, dy, dz = x_i - x_j[k], y_i - y_j[k], z_i - z_j[k]
                f[k] += 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)


@njit
def potential_jacobian(x: Float, lower: Float, f: Float, jt: Float) -> None:
    """F and its Jacobian of one wire: ``f`` (K,) as in :func:`potential`, ``jt`` (3N, K) = (∂F/∂x)ᵀ."""
    charges, wires = lower.shape[1], lower.shape[2]
    for k in range(wires):
        f[k] = 0.0
    for i in range(x.size // 3):
        x_i, y_i, z_i = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        fx, fy, fz = jt[3 * i], jt[3 * i + 1], jt[3 * i + 2]
        for k in range(wires):
            fx[k] = 0.0
            fy[k] = 0.0
            fz[k] = 0.0
        for j in range(charges):
            x_j, y_j, z_j = lower[0, j], lower[1, j], lower[2, j]
            for k in range(wires):
                dx, dy, dz = x_i - x_j[k], y_i - y_j[k], z_i - z_j[k]
                inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
                cubed = inverse * inverse * inverse
                f[k] += inverse
                fx[k] -= dx * cubed
                fy[k] -= dy * cubed
                fz[k] -= dz * cubed
