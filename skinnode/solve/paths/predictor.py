"""Predictors for a path tracker: estimate the next point on a path from points already solved."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.layout import Float

SQUARE_FLOOR: Final = 1e-300
"""Lower limit on divisors, to prevent division by zero."""


def euler(x: Float, inverse: Float, a_solved: Float, a: Float) -> Float:
    """Predict positions by an Euler step along ∂x/∂R.

    Args:
        x: (U, n) last solution of each wire, in pitches.
        inverse: (U, n, K) ∂x/∂r at ``x``.
        a_solved: (U, K) R · gain at ``x``.
        a: (U, K) R · gain at the next point.

    Returns:
        (U, n) positions, in pitches.
    """
    change = a / a_solved - 1.0
    return np.asarray(x - np.einsum("ujk,uk->uj", inverse, change))


@njit
def secant(  # noqa: PLR0913 - a kernel: two points, the next resistances, the limit and the output
    x_before: Float, a_before: Float, x: Float, a: Float, a_next: Float, reach: float, out: Float
) -> None:
    """Predict positions along the secant through the last two solved points.

    The predicted step is a multiple of the last step. The multiple is the next relative change in ``a``,
    projected onto the last relative change and divided by it. A coordinate whose prediction is not finite
    keeps its value in ``x``.

    Args:
        x_before: (U, n) positions at the second-to-last point, in pitches.
        a_before: (U, K) R · gain at ``x_before``.
        x: (U, n) positions at the last point, in pitches.
        a: (U, K) R · gain at ``x``.
        a_next: (U, K) R · gain at the next point.
        reach: Maximum change in a coordinate, in pitches.
        out: (U, n) output: predicted positions, in pitches.
    """
    for u in range(x.shape[0]):
        along, square, longest = 0.0, SQUARE_FLOOR, reach
        for k in range(a.shape[1]):
            change = a[u, k] / a_before[u, k] - 1.0
            along += change * (a_next[u, k] / a[u, k] - 1.0)
            square += change * change
        share = along / square
        for j in range(x.shape[1]):
            longest = max(longest, abs(share * (x[u, j] - x_before[u, j])))
        for j in range(x.shape[1]):
            move = share * (x[u, j] - x_before[u, j]) * (reach / longest)
            out[u, j] = x[u, j] + (move if math.isfinite(move) else 0.0)
