"""Gaussian covariance of an upper wire's displacement, which models the smoothness of rubber.

C_ij = s² exp(−d_ij² / 2ℓ²) for each coordinate, where d is the distance between two electrodes at rest. This
model makes fewer assumptions than an elastic model of the patch, and requires no material constants. The
covariance provides starting points for solves (:mod:`skinnode.solve.starts`) and ranks two roots of one wire:
the root with the smaller roughness √(uᵀ C⁻¹ u) is likelier.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.wires.problem import PatchProblem

CORRELATION_PITCHES: Final = 1.0
"""Correlation length ℓ, pitches. At a value of 1.0, the guided start finds 3204 of the 3209 roots on the
branch of the rest position. These roots come from four sets of 82 random presses on the staggered layout:
presses of 70 % at h = 0.5, and of 10, 30 and 50 % at h = 1. At 0.7 and 1.5, the guided start finds fewer
roots."""
ROUGH_SHARE: Final = 1e-3
"""Relative increase in the diagonal of C, which makes C invertible in floating point."""


class Smoothness:
    """Smoothness model of every upper wire of a patch.

    Args:
        problem: The patch.

    Attributes:
        covariance: (U, n, n) C, pitches², with n = 3N coordinates per wire.
        whitening: (U, N, N) inverse of the Cholesky factor of one coordinate's C, 1/pitch.
    """

    def __init__(self, problem: PatchProblem) -> None:
        self._problem = problem
        self.covariance, self.whitening = _covariance(problem.layout, problem.step_limit)

    def roughness(self, x: Float) -> Float:
        """Return the roughness √(uᵀ C⁻¹ u) of each wire.

        Args:
            x: (U, n) positions, pitches.

        Returns:
            (U,) roughness, in standard deviations.
        """
        displacement = (x - self._problem.rest).reshape(self._problem.layout.upper_m.shape)
        return np.asarray(np.sqrt(((self.whitening @ displacement) ** 2).sum(axis=(1, 2))))


@functools.lru_cache(maxsize=64)
def _covariance(layout: PatchLayout, size: float) -> tuple[Float, Float]:
    """Return C (U, n, n) for displacements of roughly ``size`` pitches, and C's whitening matrix."""
    electrodes: Float = layout.upper_m / layout.pitch_m
    wires, most = electrodes.shape[:2]
    gaps = electrodes[:, :, None, :] - electrodes[:, None, :, :]
    smooth = np.exp(-(gaps**2).sum(axis=-1) / (2.0 * CORRELATION_PITCHES**2))
    smooth += ROUGH_SHARE * np.eye(most)
    covariance = size**2 * np.einsum("uij,cd->uicjd", smooth, np.eye(3)).reshape(wires, 3 * most, -1)
    whitening = np.linalg.inv(np.linalg.cholesky(smooth)) / size
    covariance.setflags(write=False)
    whitening.setflags(write=False)
    return covariance, whitening
