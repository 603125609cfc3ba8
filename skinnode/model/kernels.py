"""Compiled forward model of one upper wire.

Lower electrodes are stored as (3, M, K), and the Jacobian is stored transposed as (3N, K). Values of
neighbouring lower wires are thus contiguous in memory, and the sums over electrodes stay in registers. Most
of the run time is spent on the inverse distances between electrodes. They are computed without square roots
or divisions, which are slow on all processors. Lengths may be in any unit; F has the inverse unit.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from skinnode.compiled.jit import njit, njit_body, njit_part
from skinnode.compiled.simd import LANES, Lanes, fma, load, rough_inverse_root, splat, store
from skinnode.model.layout import Float

_T = TypeVar("_T", float, Float)


def lower_rows(lower: Float) -> Float:
    """Transpose lower electrodes (K, M, 3) to the kernels' axis order (3, M, K)."""
    return np.ascontiguousarray(lower.transpose(2, 1, 0))


def relative_residual(a: _T, f: _T) -> _T:
    """Return the relative residual ``a * f - 1`` of a resistance, where ``a`` is R/ρ and ``f`` is F."""
    return a * f - 1.0


relative_residual_part = njit_body(relative_residual)
"""Version of ``relative_residual`` that can be called from kernels."""


@njit_part
def _inverse_root(square: Lanes) -> Lanes:
    """Return 1 / √``square`` with an error below 1.5 ulp; NaN for subnormal numbers and inf.

    For an estimate y with e = 1 − square y², the inverse root is y (1 + e/2 + 3/8 e² + 5/16 e³ + …). Two
    iterations use the terms up to e³. The first reduces e from 0.07 to 1e-5, and the second to the level of
    rounding errors.
    """
    y = rough_inverse_root(square)
    for _ in range(2):
        e = fma(square * y, y * -1.0, 1.0)
        series = fma(fma(e, 0.3125, 0.375), e, 0.5)
        y = fma(e * y, series, y)
    return y


@njit
def potential(x: Float, lower: Float, f: Float) -> None:
    """Write F of one wire into ``f`` (K,).

    ``x`` (3N,) contains the coordinates of the wire's electrodes in the order x₁ y₁ z₁ x₂ …, and ``lower``
    (3, M, K) contains the lower electrodes.
    """
    charges, wires = lower.shape[1], lower.shape[2]
    for k in range(0, wires, LANES):
        count = wires - k
        sum_f = splat(0.0)
        for i in range(x.size // 3):
            x_i, y_i, z_i = splat(x[3 * i]), splat(x[3 * i + 1]), splat(x[3 * i + 2])
            for j in range(charges):
                dx = x_i - load(lower[0, j], k, count)
                dy = y_i - load(lower[1, j], k, count)
                dz = z_i - load(lower[2, j], k, count)
                sum_f += _inverse_root(fma(dz, dz, fma(dy, dy, dx * dx)))
        store(f, k, count, sum_f)


@njit
def potential_jacobian(x: Float, lower: Float, f: Float, jt: Float) -> None:
    """Write F of one wire into ``f`` (K,), as :func:`potential` does, and (∂F/∂x)ᵀ into ``jt`` (3N, K)."""
    charges, wires = lower.shape[1], lower.shape[2]
    for k in range(0, wires, LANES):
        count = wires - k
        sum_f = splat(0.0)
        for i in range(x.size // 3):
            x_i, y_i, z_i = splat(x[3 * i]), splat(x[3 * i + 1]), splat(x[3 * i + 2])
            sum_x, sum_y, sum_z = splat(0.0), splat(0.0), splat(0.0)
            for j in range(charges):
                dx = load(lower[0, j], k, count) - x_i
                dy = load(lower[1, j], k, count) - y_i
                dz = load(lower[2, j], k, count) - z_i
                inverse = _inverse_root(fma(dz, dz, fma(dy, dy, dx * dx)))
                cubed = inverse * inverse * inverse
                sum_f += inverse
                sum_x = fma(dx, cubed, sum_x)
                sum_y = fma(dy, cubed, sum_y)
                sum_z = fma(dz, cubed, sum_z)
            store(jt[3 * i], k, count, sum_x)
            store(jt[3 * i + 1], k, count, sum_y)
            store(jt[3 * i + 2], k, count, sum_z)
        store(f, k, count, sum_f)


@njit
def surface_laplacian(x: Float, lower: Float, normal: Float, out: Float, slope_t: Float) -> None:
    """Write the surface Laplacian of F, −∂²F/∂n², into ``out`` (K,), and its derivative into ``slope_t``.

    ``x`` and ``lower`` are as in :func:`potential`. ``normal`` (3N,) contains the unit normal at each
    electrode. ``slope_t`` (3N, K) receives the derivative with respect to ``x``, transposed.
    """
    charges, wires = lower.shape[1], lower.shape[2]
    for k in range(0, wires, LANES):
        count = wires - k
        total = splat(0.0)
        for i in range(x.size // 3):
            x_i, y_i, z_i = splat(x[3 * i]), splat(x[3 * i + 1]), splat(x[3 * i + 2])
            n_x, n_y, n_z = splat(normal[3 * i]), splat(normal[3 * i + 1]), splat(normal[3 * i + 2])
            sum_x, sum_y, sum_z, sum_n = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
            for j in range(charges):
                dx = x_i - load(lower[0, j], k, count)
                dy = y_i - load(lower[1, j], k, count)
                dz = z_i - load(lower[2, j], k, count)
                inverse = _inverse_root(fma(dz, dz, fma(dy, dy, dx * dx)))
                cosine = fma(dz, n_z, fma(dy, n_y, dx * n_x)) * inverse
                cubed = inverse * inverse * inverse
                total += fma(cosine * -3.0, cosine, 1.0) * cubed
                radial = fma(cosine * 15.0, cosine, -3.0) * cubed * inverse * inverse
                sum_x = fma(dx, radial, sum_x)
                sum_y = fma(dy, radial, sum_y)
                sum_z = fma(dz, radial, sum_z)
                sum_n = fma(cosine * -6.0, cubed * inverse, sum_n)
            store(slope_t[3 * i], k, count, fma(n_x, sum_n, sum_x))
            store(slope_t[3 * i + 1], k, count, fma(n_y, sum_n, sum_y))
            store(slope_t[3 * i + 2], k, count, fma(n_z, sum_n, sum_z))
        store(out, k, count, total)
