"""Actual electrode positions of a simulated patch, including manufacturing errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.errors import ConfigError, Shown
from skinnode.model.layout import Float, PatchLayout
from vcan_sim.skin.imperfections import Imperfections

CLIPPED_AT: Final = 3.0
"""Limit at which draws from a normal distribution are clipped, in standard deviations."""
_LEAST_LEFT: Final = 0.1
"""Minimum gap between an upper electrode and its nearest lower electrode, relative to the nominal gap."""


@dataclass(frozen=True, eq=False)
class Body:
    """Actual positions of a patch's electrodes at rest."""

    upper_m: Float
    """(U, N, 3) float64, m: upper electrodes."""
    lower_m: Float
    """(K, M, 3) float64, m: lower electrodes."""


class Draws:
    """Random draws for one patch, with an independent stream for each imperfection.

    Args:
        seed: Random seed for the imperfections.
        number: Number of the patch in the hand.
    """

    def __init__(self, seed: int, number: int) -> None:
        self._seed, self._number = seed, number

    def stream(self, name: str, *more: int) -> np.random.Generator:
        """Return the random generator for an imperfection; each value of ``more`` has its own generator."""
        return np.random.default_rng([self._seed, self._number, *name.encode(), *more])

    def normal(self, name: str, *shape: int) -> Float:
        """Return an array of draws from the standard normal distribution, clipped at :data:`CLIPPED_AT`."""
        drawn = self.stream(name).standard_normal(shape)
        return np.asarray(np.clip(drawn, -CLIPPED_AT, CLIPPED_AT))


def made(layout: PatchLayout, imperfections: Imperfections, draws: Draws) -> Body:
    """Return the electrode positions of a patch, including manufacturing errors.

    On flat and curved patches alike, thickness and tilt errors move each upper electrode along z by a
    fraction of its height above the nearest lower electrode.

    Args:
        layout: Layout of the patch.
        imperfections: Sizes of the errors.
        draws: Random draws for the patch.

    Returns:
        Actual electrode positions; the layout's own arrays if no imperfection moves the electrodes.

    Raises:
        ConfigError: If the random errors make the gap between an upper and a lower electrode too small.
    """
    sizes, upper, lower = imperfections, layout.upper_m, layout.lower_m
    if not (sizes.placement or sizes.along or sizes.thickness or sizes.tilt):
        return Body(upper, lower)
    nearest = _nearest(layout)
    gap = upper - lower.reshape(-1, 3)[nearest]
    if sizes.thickness or sizes.tilt:
        rise = sizes.thickness * float(draws.normal("thickness", 1)[0])
        slope = sizes.tilt * draws.normal("tilt", 2)
        across = _from_middle(layout.upper_m)
        upper = upper.copy()
        upper[..., 2] += gap[..., 2] * (rise + across @ slope)
    if sizes.along:
        size_m = sizes.along * layout.pitch_m
        upper = upper + size_m * draws.normal("along upper", *upper.shape[:2], 1) * _direction(layout.upper_m)
        lower = lower + size_m * draws.normal("along lower", *lower.shape[:2], 1) * _direction(layout.lower_m)
    if sizes.placement:
        size_m = sizes.placement * layout.pitch_m
        upper = upper + size_m * draws.normal("placement upper", len(upper), 1, 3)
        lower = lower + size_m * draws.normal("placement lower", len(lower), 1, 3)
    left = ((upper - lower.reshape(-1, 3)[nearest]) * gap).sum(axis=-1) / (gap**2).sum(axis=-1)
    if left.min() < _LEAST_LEFT:
        raise ConfigError(
            "placement, along, thickness, tilt",
            Shown(f"random errors that leave {left.min():.0%} of the gap at an electrode"),
            f"at least {_LEAST_LEFT:.0%}; use smaller sizes or another seed",
        )
    return Body(upper, lower)


def _from_middle(points_m: Float) -> Float:
    """Return x and y (U, N, 2) of points (U, N, 3), scaled to −1 to 1 across the patch."""
    plane = points_m[..., :2]
    low, high = plane.min(axis=(0, 1)), plane.max(axis=(0, 1))
    half = 0.5 * (high - low)
    return np.asarray((plane - 0.5 * (low + high)) / np.where(half > 0.0, half, 1.0))


def _nearest(layout: PatchLayout) -> NDArray[np.intp]:
    """Return the flat index (U, N) of the lower electrode nearest to each upper electrode."""
    gap = layout.upper_m[:, :, None] - layout.lower_m.reshape(-1, 3)
    return np.asarray(np.argmin((gap**2).sum(axis=-1), axis=-1))


def _direction(wires_m: Float) -> Float:
    """Return the unit vectors (W, E, 3) along wires (W, E, 3); zero for wires with a single electrode."""
    if wires_m.shape[1] == 1:
        return np.zeros_like(wires_m)
    steps = np.gradient(wires_m, axis=1)
    length = np.linalg.norm(steps, axis=2, keepdims=True)
    return np.asarray(steps / np.where(length > 0.0, length, 1.0))
