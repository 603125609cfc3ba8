"""Gaussian covariance of the displacement of an upper wire, for a model of smooth rubber.

C_ij = s² exp(−d_ij² / 2ℓ²) for each coordinate, where d is the distance between two electrodes at rest.
Unlike an elastic model of the patch, this covariance requires no material constants. The covariance provides
starting points for solves (:mod:`skinnode.solve.starts`) and ranks two roots of one wire: the root with the
smaller roughness √(uᵀ C⁻¹ u) is likelier.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.wires.problem import PatchProblem

CORRELATION_PITCHES: Final = 1.0
"""Correlation length ℓ, pitches. In simulations of the staggered layout, the guided start found 3204 of 3209
roots with a correlation length of 1 pitch, and fewer roots with 0.7 or 1.5 pitches."""
ROUGH_SHARE: Final = 1e-3
"""Relative increase in the diagonal of C, to prevent C from being numerically singular."""


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
        """Return the roughness √(uᵀ C⁻¹ u) of each wire's displacement u.

        Args:
            x: (U, n) electrode positions, pitches.

        Returns:
            (U,) roughness, dimensionless.
        """
        displacement = (x - self._problem.rest).reshape(self._problem.layout.upper_m.shape)
        return np.asarray(np.sqrt(((self.whitening @ displacement) ** 2).sum(axis=(1, 2))))


@functools.lru_cache(maxsize=64)
def _covariance(layout: PatchLayout, size: float) -> tuple[Float, Float]:
    """Return C (U, n, n) for a standard deviation of ``size`` pitches, and C's whitening matrix (U, N, N)."""
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
