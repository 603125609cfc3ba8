"""Cramér-Rao bound J⁺ diag(σ²) J⁺ᵀ on the covariance of a wire's position at rest.

J is the Jacobian of the relative residual a F − 1, and σ is the relative noise of each resistance. Standard
deviations are in clearances. The clearance is the smallest distance at rest between an upper and a lower
electrode.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.forward import jacobian
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.wires.problem import PatchProblem


def patch_std(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> float:
    """Return the RMS of :func:`wire_std` over the wires; inf if a Jacobian is singular."""
    return math.sqrt(float((wire_std(layout, relative_noise, normal_only) ** 2).mean()))


def wire_std(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> Float:
    """Return the standard deviation of the exact inverse at rest for each wire.

    Args:
        layout: The patch.
        relative_noise: Relative standard deviation of R, scalar or (U, K).
        normal_only: Whether to solve for z only.

    Returns:
        (U,) RMS of the standard deviations of each wire's coordinates, in clearances; inf if the Jacobian of
        the wire is singular.
    """
    if np.ndim(relative_noise) == 0:
        return np.asarray(relative_noise) * _unit_std(layout, normal_only)
    return _std(layout, np.broadcast_to(relative_noise, layout.shape), normal_only)


@functools.lru_cache(maxsize=64)  # computing the Jacobians of a layout takes 3 ms
def _unit_std(layout: PatchLayout, normal_only: bool) -> Float:
    return _std(layout, np.ones(layout.shape), normal_only)


def _std(layout: PatchLayout, relative_noise: Float, normal_only: bool) -> Float:
    problem = PatchProblem.of(layout)
    slopes = jacobian(layout, layout.upper_m) * layout.pitch_m**2 * problem.a_rest[..., None, None]
    slopes = slopes[..., 2:] if normal_only else slopes
    weighted = slopes.reshape(*layout.shape, -1) / relative_noise[..., None]
    singular = np.linalg.svd(weighted, compute_uv=False)
    with np.errstate(divide="ignore"):
        variance = (1.0 / singular**2).sum(axis=1) / weighted.shape[2]
    return np.asarray(np.sqrt(variance) / problem.clearance.min())
