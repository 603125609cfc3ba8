"""Crossed wires: two wires of a layer whose readings are exchanged.

If the wires were crossed before the readings at rest were measured, nothing shows it until the skin moves.
Then the field of one wire lies where that of its neighbour belongs. The log evidence of a frame with the
readings of two wires exchanged differs from that of the frame as it is by −αᵀδ − ½ δᵀPδ, with the precision
P, α = P z and the change δ. No parameter is fitted, so a difference of a few nats means something.

In 108 healthy frames of presses of six kinds (staggered, h = 0.5, noise 1e-4), the largest difference was
2.8 nats; with two upper or two lower wires crossed, its median was 125 and 43.
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
    """Two wires of a layer."""

    part: FaultyPart
    one: int
    other: int


def exchanged(z: Float, present: Mask, pair: WirePair) -> tuple[Float, Mask]:
    """Return readings (U, K), and which of them there are, with those of two wires exchanged."""
    here, there = [pair.one, pair.other], [pair.other, pair.one]
    z, present = z.copy(), present.copy()
    for values in (z, present):
        if pair.part is FaultyPart.UPPER:
            values[here] = values[there]
        else:
            values[:, here] = values[:, there]
    return z, present


def likeliest(
    p: Float, alpha: Float, z: Float, present: Mask, *, far: bool = False
) -> tuple[float, WirePair]:
    """Return the two wires whose exchange raises the log evidence of a frame most, and by how much.

    Args:
        p: (m, m) precision of the readings.
        alpha: (m,) P z.
        z: (U, K) changes of the readings since rest, in units of their noise.
        present: (U, K) readings that there are; others are not exchanged.
        far: Whether the wires need not be neighbours, which takes ten times as long.
    """
    upper_wires, lower_wires = z.shape
    longest = max(upper_wires, lower_wires)
    gain, upper, one, other = best_exchange(
        p, alpha, z.ravel(), present.ravel(), upper_wires, lower_wires, longest - 1 if far else 1,
        np.empty(longest),
    )  # fmt: skip
    return gain, WirePair(FaultyPart.UPPER if upper else FaultyPart.LOWER, int(one), int(other))


@njit
def best_exchange(  # noqa: PLR0913 - a kernel: arrays by name
    p: Float, alpha: Float, z: Float, present: Mask, upper: int, lower: int, reach: int, delta: Float
) -> tuple[float, bool, int, int]:
    """Return the largest gain in log evidence, whether the wires are upper ones, and the two wires.

    Wires up to ``reach`` apart are compared; the choice among n pairs costs ln n. ``delta`` (max(U, K),) is
    scratch.
    """
    best, is_upper, one, other, pairs = -math.inf, True, 0, 0, 0
    for apart in range(1, reach + 1):
        for u in range(upper - apart):
            pairs += 1
            gain = _gain(p, alpha, z, present, u * lower, apart * lower, 1, lower, best, delta)
            if gain > best:
                best, one, other, is_upper = gain, u, u + apart, True
        for k in range(lower - apart):
            pairs += 1
            gain = _gain(p, alpha, z, present, k, apart, lower, upper, best, delta)
            if gain > best:
                best, one, other, is_upper = gain, k, k + apart, False
    return best - math.log(max(pairs, 1)), is_upper, one, other


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
    """Return the gain of exchanging readings start, start + step, … with those ``across`` further on.

    The bound −αᵀδ comes first: if it is not above ``enough``, it is returned in place of the gain.
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
