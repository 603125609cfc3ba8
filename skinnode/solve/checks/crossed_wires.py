"""Crossed wires: two wires of the same layer whose readings are exchanged.

If two wires were already crossed when the resistances at rest were measured, the error is invisible until the
skin moves. The displacements under one wire are then attributed to the other. To test a pair of wires, their
readings are exchanged in a frame. The log evidence of the frame changes by −αᵀδ − ½ δᵀPδ, where z are the
changes in the readings, P is their precision, α = P z, and δ is the change in z. No parameter is fitted to
the frame, so an increase of a few nats is significant.

In 108 healthy frames with six kinds of presses (staggered layout, h = 0.5, noise 1e-4), no exchange increased
the log evidence by more than 2.8 nats. If two wires were actually crossed, exchanging them increased the log
evidence by a median of 125 nats for upper wires and 43 nats for lower wires.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.jit import njit, njit_part
from skinnode.model.data_fault import FaultyPart
from skinnode.model.layout import Float

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class WirePair:
    """Two wires of the same layer."""

    part: FaultyPart
    one: int
    other: int


def exchanged(z: Float, present: Mask, pair: WirePair) -> tuple[Float, Mask]:
    """Return copies of the readings ``z`` and of the mask ``present``, with the two wires exchanged."""
    here, there = [pair.one, pair.other], [pair.other, pair.one]
    z, present = z.copy(), present.copy()
    for values in (z, present):
        if pair.part is FaultyPart.UPPER:
            values[here] = values[there]
        else:
            values[:, here] = values[:, there]
    return z, present


def likeliest(  # noqa: PLR0913 - the frame, and which pairs to test
    p: Float, alpha: Float, z: Float, present: Mask, *, far: bool = False, enough: float = -math.inf
) -> tuple[float, WirePair]:
    """Return the largest gain in log evidence (nats) from exchanging two wires, and these wires.

    Args:
        p: (m, m) precision of the readings.
        alpha: (m,) P z.
        z: (U, K) changes in the readings since rest, in units of their noise.
        present: (U, K) mask of the available readings. Two readings are exchanged only if both are available.
        far: Whether to test all pairs of wires rather than only neighbours. Testing all pairs takes ten times
            as long.
        enough: Gain that must be exceeded; if no exchange does, it is returned in place of the largest gain,
            with an arbitrary pair.
    """
    upper_wires, lower_wires = z.shape
    longest = max(upper_wires, lower_wires)
    gain, upper, one, other = best_exchange(
        p, alpha, z.ravel(), present.ravel(), upper_wires, lower_wires, longest - 1 if far else 1,
        enough, np.empty(longest),
    )  # fmt: skip
    return gain, WirePair(FaultyPart.UPPER if upper else FaultyPart.LOWER, int(one), int(other))


@njit
def best_exchange(  # noqa: PLR0913 - a kernel: arrays by name
    p: Float,
    alpha: Float,
    z: Float,
    present: Mask,
    upper: int,
    lower: int,
    reach: int,
    enough: float,
    delta: Float,
) -> tuple[float, bool, int, int]:
    """Return the gain (nats), the layer and the wire numbers of the best exchange of two wires.

    The layer is True for upper wires. Only wires whose numbers differ by at most ``reach`` are tested. The
    gain is reduced by ln n, because the best of n pairs is chosen. If it does not exceed ``enough``,
    ``enough`` is returned. ``delta`` (max(U, K),) is a work array.
    """
    pairs = 0
    for apart in range(1, reach + 1):
        pairs += max(upper - apart, 0) + max(lower - apart, 0)
    choice = math.log(max(pairs, 1))
    best, is_upper, one, other = enough + choice, True, 0, 0
    for apart in range(1, reach + 1):
        for u in range(upper - apart):
            gain = _gain(p, alpha, z, present, u * lower, apart * lower, 1, lower, best, delta)
            if gain > best:
                best, one, other, is_upper = gain, u, u + apart, True
        for k in range(lower - apart):
            gain = _gain(p, alpha, z, present, k, apart, lower, upper, best, delta)
            if gain > best:
                best, one, other, is_upper = gain, k, k + apart, False
    return best - choice, is_upper, one, other


@njit_part
def _gain(  # noqa: PLR0913 - a kernel: arrays by name
    p: Float,
    alpha: Float,
    z: Float,
    present: Mask,
    start: int,
    across: int,
    step: int,
    count: int,
    enough: float,
    delta: Float,
) -> float:
    """Return the gain in log evidence from exchanging the ``count`` readings of two wires.

    The readings of the first wire have the indices ``start``, ``start + step``, …. Adding ``across`` gives
    the indices for the second wire. The function first computes the upper bound −αᵀδ. If the bound is at most
    ``enough``, it is returned in place of the gain. The gain is −inf if fewer than half of the pairs of
    readings are available.
    """
    linear, both = 0.0, 0
    for i in range(count):
        a = start + i * step
        delta[i] = 0.0
        if present[a] and present[a + across]:
            both += 1
            delta[i] = z[a + across] - z[a]
            linear -= (alpha[a] - alpha[a + across]) * delta[i]
    if 2 * both < count:
        return -math.inf
    if linear <= enough:
        return linear
    square = 0.0
    for i in range(count):
        a = start + i * step
        one, other, part = p[a], p[a + across], 0.0
        for j in range(i):
            c = start + j * step
            part += delta[j] * (one[c] - one[c + across] - other[c] + other[c + across])
        own = one[a] - one[a + across] - other[a] + other[a + across]
        square += delta[i] * (2.0 * part + delta[i] * own)
    return linear - 0.5 * square
